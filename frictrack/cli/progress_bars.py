"""Show progress on stderr: bars and tables on a terminal, elsewhere one line per step."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID
    from rich.table import Table

    from frictrack.flow.batch import BatchState

MAX_SILENCE_S = 5.0  # between two lines, if the work reports progress
MAX_SILENCE_OF_BATCH_S = 15.0  # between two lines in a log file: a study takes minutes
MAX_LINES = 8  # of current tasks, and of failures
OWN_BAR = ("studies", "runs")  # each has its own bar; one more bar shows the current work


def _write(line: str) -> None:
    sys.stderr.write(f"{line}\n")
    sys.stderr.flush()


class ProgressDisplay:
    """Progress of a command; call it as ``progress(done, total, what)``, with 0 of 0 for a new step."""

    def __init__(self) -> None:
        self._last_line = time.monotonic()

    def clear(self) -> None:
        """Remove what is drawn, before something is printed; the next call draws it again."""

    def __call__(self, done: int, total: int, what: str) -> None:
        """Write one line for a new step, for example into a log file; within a long step one every few seconds."""
        if not total or time.monotonic() - self._last_line >= MAX_SILENCE_S:
            _write(f"{what}: {done} of {total}" if total else what)
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

    def __call__(self, done: int, total: int, what: str) -> None:
        """Draw the bar of a step; one of unknown length moves to and fro."""
        self._drawn.start()
        bar = what if what in OWN_BAR else "now"
        if bar not in self._tasks:
            self._tasks[bar] = self._drawn.add_task(what, total=total or None)
        now = self._tasks[bar]
        if total == 0:
            self._drawn.reset(now, total=None, description=what)
        visible = done < total or not total
        self._drawn.update(now, description=what, completed=done, total=total or None, visible=visible)


@contextmanager
def progress_bars() -> Iterator[ProgressDisplay]:
    """Yield a callable ``progress(done, total, what)``; bars disappear when the block ends."""
    if not sys.stderr.isatty():
        yield ProgressDisplay()
        return
    from rich import progress as bars  # noqa: PLC0415 - `--help` does without
    from rich.console import Console  # noqa: PLC0415

    columns = (bars.TextColumn("{task.description}"), bars.BarColumn(), bars.MofNCompleteColumn())
    console = Console(stderr=True)
    with bars.Progress(*columns, bars.TimeRemainingColumn(), console=console, transient=True) as drawn:
        yield ProgressBars(drawn)


@contextmanager
def watch_batch() -> Iterator[Callable[[BatchState], None]]:
    """Yield a callable that shows the state of a batch: a table on a terminal, else one line per study."""
    if not sys.stderr.isatty():
        yield LinePrinter()
        return
    from rich.console import Console  # noqa: PLC0415
    from rich.live import Live  # noqa: PLC0415

    with Live(console=Console(stderr=True), transient=True, auto_refresh=False) as live:
        yield lambda state: live.update(progress_table(state), refresh=True)


class LinePrinter:
    """Print a line for every study that has ended, and in between one on the current tasks every few seconds."""

    def __init__(self) -> None:
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
        is_silent = not new and self._last_line is not None and now - self._last_line > MAX_SILENCE_OF_BATCH_S
        if is_silent and state.under_way:
            (first, since), *others = state.under_way.items()
            more = f" and {len(others)} more" if others else ""
            new.append(f"working on {relative_path(first)}{more}, {_clock(now - since)}")
        for line in new:
            _write(line)
            self._last_line = now


def progress_table(state: BatchState) -> Table:
    """Return the table of one state of a batch."""
    from rich.markup import escape  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    ended = state.kept + len(state.done)
    pace = 60.0 * state.runs / max(state.seconds, 1e-9)
    table.add_row("studies", f"{ended} of {state.studies}" + f", {state.kept} of them before" * bool(state.kept))
    table.add_row("runs", f"{state.runs}, {pace:.3g} a minute" if state.runs else "0")
    table.add_row("time", _clock(state.seconds) + (f", {_clock(state.left)} left" if state.left is not None else ""))
    now = time.monotonic()
    for name, since in list(state.under_way.items())[:MAX_LINES]:
        table.add_row("working on", f"{escape(relative_path(name))}, {_clock(now - since)}")
    if state.failures:
        table.add_row("[bold]failed[/bold]", f"{len(state.failures)}")
    for one in state.failures[-MAX_LINES:]:
        table.add_row("", escape(f"{_where(one)}: {one['reason']}"))
    return table


def relative_path(path: str) -> str:
    """Return a path relative to the current folder if it lies below it."""
    return path.removeprefix(f"{Path.cwd()}/")


def _where(failure: Mapping[str, str]) -> str:
    return ", ".join(part for part in (relative_path(failure["study"]), failure["run"]) if part)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
