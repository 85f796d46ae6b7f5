"""Define what all commands share: the application, arguments, sessions, progress on stderr, results, what to look at.

On a terminal, progress is bars; elsewhere it is one line per step.
"""

from __future__ import annotations

import inspect
import json
import re
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import typer

from frictrack import flow

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from frictrack.flow.batch import BatchState

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


OPTION = re.compile(r"^(?P<name>\w+)(?P<flags>(?: -\S+)*)(?: (?P<metavar>\S.*?))? : (?P<help>.+(?:\n .+)*)", re.M)


def command(name: str | None = None, group: typer.Typer = app) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that makes a function a command; its docstring has the help, the options and the examples.

    A line of the section Options is `parameter --flag METAVAR : help`; flags and metavar may be left out.
    """

    def register(function: Callable[..., None]) -> Callable[..., None]:
        said, _, examples = inspect.cleandoc(function.__doc__ or "").partition("\n\nExamples\n--------\n")
        said, _, options = said.partition("\n\nOptions\n-------\n")
        hints, parameters = get_type_hints(function, include_extras=True), inspect.signature(function).parameters
        for found in OPTION.finditer(options):
            option, flags = found["name"], found["flags"].split()
            if parameters[option].default is False and not flags:
                flags = [f"--{option.replace('_', '-')}"]  # and no flag for the opposite
            how = typer.Option(*flags, metavar=found["metavar"], help=" ".join(found["help"].split()))
            hints[option] = Annotated[hints[option], how]
        function.__annotations__ = hints
        epilog = "\n  ".join(("\b\nExamples:", *examples.splitlines()))  # after \b, the line ends stay
        return group.command(name, help=said, epilog=epilog)(function)

    return register


def _print_version(wanted: bool) -> None:
    if wanted:
        from frictrack.base import __version__  # noqa: PLC0415

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
def open_session(study: Path, workers: int = 1) -> Iterator[flow.Session]:
    """Open a study for work; its progress is a `ProgressDisplay` on stderr, long films are shared by `workers`."""
    with progress_bars() as progress, ExitStack() as processes:
        progress(0, 0, f"reading {study}")
        from frictrack.base.workers import local_workers  # noqa: PLC0415 - the first bar does not wait for it

        opened = flow.open_study(study)
        count = "1 run" if len(opened.runs) == 1 else f"{len(opened.runs)} runs"
        progress(0, 0, f"study {opened.name}, {count}")
        pool = processes.enter_context(local_workers(workers)) if workers > 1 else None
        yield flow.Session(opened, progress, author="cli", pool=pool)


def print_first(session: flow.Session, as_json: bool, parts: list[str]) -> Callable[[Mapping[str, Any]], None]:
    """Return a function that prints the first part early and removes it from `parts`; JSON is printed as a whole."""
    progress: Any = session.progress

    def show(result: Mapping[str, Any]) -> None:
        if not as_json:
            progress.clear()
            print_result(result, False, parts.pop(0))
            sys.stdout.flush()

    return show


def print_result(result: Mapping[str, Any], as_json: bool, show: str, where: str | Path = "", look: str = "") -> None:
    """Print the result of a command, as JSON or as tables, and where the files are; `show` names functions."""
    if as_json:
        sys.stdout.write(json.dumps(result, allow_nan=False, ensure_ascii=False) + "\n")
        return
    from frictrack.cli import output  # noqa: PLC0415

    out = output.Terminal(highlight=False)
    for name in show.split():
        getattr(output, name)(out, result)
    if look:
        out.print(f"look at: {look}", markup=False)
    if where:
        out.print(f"results: {where}", soft_wrap=True, markup=False)


MAX_SILENCE_S = 5.0  # between two lines, if the work reports progress
MAX_SILENCE_OF_BATCH_S = 15.0  # between two lines in a log file: a study takes minutes
OWN_BAR = ("studies", "runs")  # each has its own bar; one more bar shows the current work


class ProgressDisplay:
    """Progress of a command; call it as ``progress(done, total, what)``, with 0 of 0 for a new step."""

    def __init__(self) -> None:
        self._last_line = time.monotonic()

    def clear(self) -> None:
        """Remove what is drawn, before something is printed; the next call draws it again."""

    def write(self, line: str) -> None:
        """Write one line."""
        sys.stderr.write(f"{line}\n")
        sys.stderr.flush()

    def draw(self, done: int, total: int, what: str) -> bool:
        """Draw the bar of a step, if there are bars; return whether there are."""
        return False

    def __call__(self, done: int, total: int, what: str) -> None:
        """Draw a bar; without bars, as in a log file, write a line for a new step, and one every few seconds."""
        if not self.draw(done, total, what) and (not total or time.monotonic() - self._last_line >= MAX_SILENCE_S):
            self.write(f"{what}: {done} of {total}" if total else what)
            self._last_line = time.monotonic()


class ProgressBars(ProgressDisplay):
    """Progress bars on a terminal."""

    def __init__(self, drawn: Progress) -> None:
        super().__init__()
        self._drawn = drawn
        self._tasks: dict[str, TaskID] = {}

    def clear(self) -> None:
        """Remove the bars until the next call."""
        self._drawn.stop()

    def write(self, line: str) -> None:
        """Write one line above the bars."""
        self._drawn.console.print(line, markup=False, highlight=False, soft_wrap=True)

    def draw(self, done: int, total: int, what: str) -> bool:
        """Draw the bar of a step; one of unknown length moves to and fro."""
        self._drawn.start()
        bar = what if what in OWN_BAR else "now"
        if not total and bar in self._tasks:  # a bar that is reset keeps the length of the step before
            self._drawn.remove_task(self._tasks.pop(bar))
        if bar not in self._tasks:
            self._tasks[bar] = self._drawn.add_task(what, total=total or None)
        visible = done < total or not total
        self._drawn.update(self._tasks[bar], description=what, completed=done, total=total or None, visible=visible)
        return True


@contextmanager
def progress_bars() -> Iterator[ProgressDisplay]:
    """Yield a callable ``progress(done, total, what)``; bars disappear when the block ends."""
    if not sys.stderr.isatty():
        yield ProgressDisplay()
        return
    from rich import progress as bars  # noqa: PLC0415 - `--help` does without
    from rich.console import Console  # noqa: PLC0415

    columns = (bars.TextColumn("{task.description}", markup=False), bars.BarColumn(), bars.MofNCompleteColumn())
    console = Console(stderr=True)
    with bars.Progress(*columns, bars.TimeRemainingColumn(), console=console, transient=True) as drawn:
        yield ProgressBars(drawn)


class BatchPrinter:
    """Print a line for every study that has ended; what is being worked on as a bar, or a line every few seconds."""

    def __init__(self, progress: ProgressDisplay) -> None:
        self._progress = progress
        self._told = self._failed = 0
        self._last_line: float | None = None

    def __call__(self, state: BatchState) -> None:
        """Print what is new in the state of a batch."""
        now = time.monotonic()
        new = [] if self._last_line is not None else [f"{state.studies} studies, {state.kept} of them finished before"]
        for study in state.done[self._told :]:
            self._told += 1
            new.append(f"{state.kept + self._told} of {state.studies}: {relative_path(study)}")
        new += [f"failed: {_where(one)}: {one['reason']}" for one in state.failures[self._failed :]]
        self._failed = len(state.failures)
        working = [f"{relative_path(task)}, {_clock(now - since)}" for task, since in state.under_way.items()]
        words = f"working on {working[0]}{f' and {len(working) - 1} more' * (len(working) > 1)}" if working else ""
        has_bars = self._progress.draw(state.kept + len(state.done), state.studies, "studies")
        if words and has_bars:
            self._progress.draw(0, 0, words)
        elif words and not new and self._last_line is not None and now - self._last_line > MAX_SILENCE_OF_BATCH_S:
            new.append(words)
        for line in new:
            self._progress.write(line)
            self._last_line = now


def relative_path(path: str) -> str:
    """Return a path relative to the current folder if it lies below it."""
    return path.removeprefix(f"{Path.cwd()}/")


def _where(failure: Mapping[str, str]) -> str:
    return ", ".join(part for part in (relative_path(failure["study"]), failure["run"]) if part)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


MIN_CHI2_MISFIT = 1.2  # reduced; below, what is left has the size of the noise, whether or not it is noise
_TEXTS = {
    "track": "{output}/<run>_track.png: the frame must lie on the slider in every picture. Then: frictrack run {study}",
    "motion": "v max: it must be a speed that you expect; otherwise scale or fps is wrong",
    "friction": "mean F N: divided by the normal load it is the friction coefficient; free from and free to must "
    "enclose the slide alone. Then: frictrack fit {study}",
    "compare": "held out: the best model has the smallest; a smaller error of the fit alone proves nothing",
    "plan": "the next run; plan.html shows further ones, what each separates and, as --details does, what stays open",
    "report": "the first screen of the page: the verdict, the misfit before and after, and what to do next",
    "export": "the files, opened by {opened_by}",
    "crate": "what is not included or missing, above. Then: frictrack reproduce {crate}, at best on another computer",
    "prior": "the deviations: they must be what you believe of the other set-up. There: prior = the file, in [study]",
    "batch": "the page: failures first, then verdicts and trends; frictrack_batch.csv has one row per run",
    "demo": "the first screen of the report; frictrack_demo/study.toml is an example",
    "render": "the films; truth.json holds the true motion and forces, which study.toml does not tell",
}


def look_at(command: str, **places: Any) -> str:
    """Return what to look at after a command."""
    typed = {name: shlex.quote(str(places[name])) for name in ("study", "crate") if name in places}
    return _TEXTS[command].format(**places | typed)


def after_fit(fit: Mapping[str, Any], study: Any) -> str:
    """Return what a fit leaves, and what to do next."""
    chi2 = fit.get("errors", {}).get("reduced_chi2")
    if chi2 is None:  # one fit per group
        return f"the parameters by group. frictrack compare {shlex.quote(str(study))} compares models"
    more = f"frictrack diagnose {shlex.quote(str(study))} names what is missing, if anything is"
    if chi2 > MIN_CHI2_MISFIT:
        return f"the model misses the data by {chi2**0.5:.3g} times their noise (square root of chi-squared). {more}"
    return f"what the model leaves is as large as the noise of the data. {more}"


def after_edit(result: Mapping[str, Any], study: Any) -> str:
    """Return what an added or removed effect makes of the held-out error."""
    from frictrack.results.candidates import describe_held_out  # noqa: PLC0415 - `--help` does without it

    change, study = describe_held_out(result["error_before"], result["error_after"]), shlex.quote(str(study))
    return f"{change}. frictrack diagnose {study} names what is missing, if anything is"


def after_diagnosis(diagnosis: Mapping[str, Any], study: Any, first: str = "the verdict above.") -> str:
    """Return what to look at first after a diagnosis, and what to do then; it depends on the verdict."""
    from frictrack.results.verdicts import CHECK_NEXT  # noqa: PLC0415 - `--help` does without it

    if diagnosis.get("warnings"):
        return f"{first} {CHECK_NEXT}"
    study, formulas = shlex.quote(str(study)), (diagnosis.get("unexplained") or {}).get("formulas") or [{}]
    if diagnosis["verdict"] == "unexplained" and formulas[0].get("toml"):  # a lead would be no cause
        return f"{first} Then: frictrack add {study} formula:1 adds its first formula, or write an effect of your own"
    if diagnosis["missing"]:
        return f"{first} Then: frictrack add {study} {diagnosis['missing'][0]} shows by how much the error falls"
    if (levels := diagnosis.get("levels")) and diagnosis["verdict"] != "undetermined":  # no answer to that
        return f"{first} Then: frictrack add {study} {levels[0]} lets friction differ from run to run as the data show"
    return f"{first} Then: frictrack plan {study} lists which runs would tell more"
