"""Define what all commands share: the application, common arguments, sessions, printing of results."""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from frictrack.cli.progress_bars import progress_bars

if TYPE_CHECKING:
    from frictrack.base.workers import WorkerPool
    from frictrack.flow import Session

app = typer.Typer(
    help="Identify a friction law from films of a sliding mass, and find the physical effect that the law lacks.",
    no_args_is_help=True,
    epilog="""\b
Examples:
  frictrack demo                              the whole analysis on a sample
  frictrack init films                        a study file for your own films""",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
Study = Annotated[Path, typer.Argument(metavar="STUDY", help="study file (.toml), or a folder with a study.toml")]
STUDY_HERE = Path("study.toml")  # where no study is named
Json = Annotated[bool, typer.Option("--json", help="print one JSON object on stdout and nothing else")]
Seed = Annotated[int, typer.Option(help="seed of all random numbers")]
Workers = Annotated[int | None, typer.Option(min=1, help="number of processes (default: all processors)")]
FilmWorkers = Annotated[
    int, typer.Option("--workers", metavar="N", min=1, help="processes that share a long uncompressed film")
]
Effect = Annotated[
    str | None, typer.Argument(metavar="EFFECT", help="name of an effect, as `frictrack effects` lists them")
]
EffectOrFormula = Annotated[
    str | None,
    typer.Argument(metavar="EFFECT", help="name of an effect; or formula:1, the first formula of the last diagnosis"),
]
Search = Literal["varpro", "ga", "mga", "sa", "sga", "de", "da", "cmaes"]


def command(name: str | None = None, group: typer.Typer = app) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that makes a function a command; the examples of its docstring end the help."""

    def register(function: Callable[..., None]) -> Callable[..., None]:
        said, _, examples = inspect.cleandoc(function.__doc__ or "").partition("\n\nExamples\n--------\n")
        epilog = "\n  ".join(("\b\nExamples:", *examples.splitlines()))  # after \b, the line ends stay
        return group.command(name, help=said, epilog=epilog)(function)

    return register


def _print_version(wanted: bool) -> None:
    if wanted:
        from frictrack.base.version import __version__  # noqa: PLC0415

        sys.stdout.write(f"frictrack {__version__}\n")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", help="print the version and exit", is_eager=True, callback=_print_version)
    ] = False,
) -> None:
    """Define the options before the command."""


@contextmanager
def open_session(study: Path, workers: int = 1) -> Iterator[Session]:
    """Open a study for work; its progress is a `ProgressDisplay` on stderr."""
    with progress_bars() as progress, _film_workers(workers) as pool:
        progress(0, 0, f"reading {study}")
        from frictrack.flow import Session, open_study  # noqa: PLC0415 - the first bar does not wait for it

        opened = open_study(study)
        count = "1 run" if len(opened.runs) == 1 else f"{len(opened.runs)} runs"
        progress(0, 0, f"study {opened.name}, {count}")
        yield Session(opened, progress, author="cli", pool=pool)


@contextmanager
def _film_workers(workers: int) -> Iterator[WorkerPool | None]:
    """Open processes for the segments of long films; none for one. They start with the first segment."""
    if workers == 1:
        yield None
        return
    from frictrack.base.workers import local_workers  # noqa: PLC0415 - only needed for several processes

    with local_workers(workers) as pool:
        yield pool


class VerdictPrinter:
    """Print a verdict while the rest is being computed; not for JSON, which is one document."""

    def __init__(self, session: Session, as_json: bool, show: str) -> None:
        self._progress: Any = session.progress
        self._as_json, self._show = as_json, show
        self.has_printed = False

    def __call__(self, result: Mapping[str, Any]) -> None:
        """Print what is known so far."""
        if not self._as_json:
            self._progress.clear()
            print_result(result, False, self._show)
            sys.stdout.flush()
            self.has_printed = True


def print_result(result: Mapping[str, Any], as_json: bool, show: str, where: str | Path = "", look: str = "") -> None:
    """Print the result of a command, as JSON or as tables, and where the files are."""
    if as_json:
        sys.stdout.write(json.dumps(result, allow_nan=False, ensure_ascii=False) + "\n")
        return
    from rich.console import Console  # noqa: PLC0415

    from frictrack.cli import output, tables  # noqa: PLC0415

    out = Console(highlight=False)
    if show:
        getattr(output if hasattr(output, show) else tables, show)(out, result)
    if look:
        out.print(f"look at: {look}", markup=False)
    if where:
        out.print(f"results: {where}", soft_wrap=True, markup=False)
