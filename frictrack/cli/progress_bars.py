"""Show progress on stderr: bars on a terminal, elsewhere one line per step."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

MAX_SILENCE_S = 5.0  # between two lines, if the work reports progress
OWN_BAR = ("studies", "runs")  # each has its own bar; one more bar shows the current work


class ProgressDisplay:
    """Progress of a command; call it as ``progress(done, total, what)``, with 0 of 0 for a new step."""

    def __init__(self) -> None:
        self._last_line = time.monotonic()

    def clear(self) -> None:
        """Remove what is drawn, before something is printed; the next call draws it again."""

    def __call__(self, done: int, total: int, what: str) -> None:
        """Write one line for a new step, for example into a log file; within a long step one every few seconds."""
        if total and time.monotonic() - self._last_line < MAX_SILENCE_S:
            return
        count = f": {done} of {total}" if total else ""
        sys.stderr.write(f"{what}{count}\n")
        sys.stderr.flush()
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
        self._drawn.update(
            now, description=what, completed=done, total=total or None, visible=done < total or not total
        )


@contextmanager
def progress_bars() -> Iterator[ProgressDisplay]:
    """Yield a callable ``progress(done, total, what)``; bars disappear when the block ends."""
    if not sys.stderr.isatty():
        yield ProgressDisplay()
        return
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import (  # noqa: PLC0415
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as drawn:
        yield ProgressBars(drawn)
