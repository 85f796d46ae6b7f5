"""What all commands share: the program, the words that many of them take, how a result is told."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

if TYPE_CHECKING:
    from frictrack.flow import Session

app = typer.Typer(
    help="From a film of a sliding mass to a friction law, and to the physical effect that it lacks.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
Study = Annotated[Path, typer.Argument(metavar="STUDY", help="study file (.toml), or a folder with a study.toml")]
Json = Annotated[bool, typer.Option("--json", help="one JSON object on stdout, nothing else")]
Seed = Annotated[int, typer.Option(help="of everything that is drawn at random")]
Workers = Annotated[int | None, typer.Option(min=1, help="processes (all processors)")]
Effect = Annotated[str, typer.Argument(metavar="EFFECT", help="as `frictrack effects` names it")]
Search = Literal["varpro", "ga", "mga", "sa", "sga", "de", "da", "cmaes"]


@contextmanager
def open_session(study: Path) -> Iterator[Session]:
    """A study at work, its progress on stderr."""
    from frictrack.cli.progress_bars import progress_bars  # noqa: PLC0415 - `--help` need not wait for the science
    from frictrack.flow import Session, open_study  # noqa: PLC0415

    opened = open_study(study)
    with progress_bars() as progress:
        yield Session(opened, progress, author="cli")


def print_result(result: dict[str, Any], as_json: bool, show: str, where: str | Path = "") -> None:
    """Print a result for a machine or a person; a person is told where it lies."""
    if as_json:
        sys.stdout.write(json.dumps(result, allow_nan=False, ensure_ascii=False) + "\n")
        return
    from rich.console import Console  # noqa: PLC0415

    from frictrack.cli import output  # noqa: PLC0415

    out = Console(highlight=False)
    if show:
        getattr(output, show)(out, result)
    if where:
        out.print(f"results: {where}", soft_wrap=True, markup=False)
