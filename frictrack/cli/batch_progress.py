"""Show the progress of a batch: finished studies, current tasks, failures, speed."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

if TYPE_CHECKING:
    from frictrack.flow.batch import BatchState

MAX_SILENCE_S = 15.0  # between two lines in a log file: a study takes minutes
MAX_LINES = 8  # of current tasks, and of failures


@contextmanager
def watch_batch() -> Iterator[Callable[[BatchState], None]]:
    """Yield a callable that shows the state of a batch: a table on a terminal, else one line per study."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield LinePrinter()
        return
    with Live(console=console, transient=True, auto_refresh=False) as live:

        def show(state: BatchState) -> None:
            live.update(progress_table(state), refresh=True)

        yield show


class LinePrinter:
    """Print a line for every study that has ended, and in between one on the current tasks every few seconds."""

    def __init__(self) -> None:
        self._told = 0
        self._failed = 0
        self._last_line: float | None = None

    def __call__(self, state: BatchState) -> None:
        """Print what is new in the state of a batch."""
        if self._last_line is None:
            self._write(f"{state.studies} studies, {state.kept} of them finished before")
        for study in state.done[self._told :]:
            self._told += 1
            self._write(f"{state.kept + self._told} of {state.studies}: {relative_path(study)}")
        for one in state.failures[self._failed :]:
            self._failed += 1
            self._write(f"failed: {_where(one)}: {one['reason']}")
        now = time.monotonic()
        if self._last_line is not None and now - self._last_line > MAX_SILENCE_S and state.under_way:
            tasks = list(state.under_way.items())
            more = f" and {len(tasks) - 1} more" if len(tasks) > 1 else ""
            self._write(f"working on {relative_path(tasks[0][0])}{more}, {_clock(now - tasks[0][1])}")

    def _write(self, line: str) -> None:
        sys.stderr.write(f"{line}\n")
        sys.stderr.flush()
        self._last_line = time.monotonic()


def progress_table(state: BatchState) -> Table:
    """Return the table of one state of a batch.

    Parameters
    ----------
    state
        Progress of the batch.

    """
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
    """Return a path relative to the current folder if it lies below it.

    Parameters
    ----------
    path
        An absolute path.

    """
    return path.removeprefix(f"{Path.cwd()}/")


def _where(failure: Mapping[str, str]) -> str:
    return ", ".join(part for part in (relative_path(failure["study"]), failure["run"]) if part)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
