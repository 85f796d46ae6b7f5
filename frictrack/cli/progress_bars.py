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

    from frictrack.flow.batch import BatchState

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
        """Write one line for a new step, for example into a log file; within a long step one every few seconds."""
        if not total or time.monotonic() - self._last_line >= MAX_SILENCE_S:
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

    def __call__(self, done: int, total: int, what: str) -> None:
        """Draw the bar of a step."""
        self.draw(done, total, what)

    def draw(self, done: int, total: int, what: str) -> bool:
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


@contextmanager
def watch_batch() -> Iterator[Callable[[BatchState], None]]:
    """Yield a callable that shows the state of a batch: a line per study that has ended, and bars on a terminal."""
    with progress_bars() as progress:
        yield BatchPrinter(progress)


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
