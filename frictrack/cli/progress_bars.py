"""Show progress bars on stderr."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from frictrack.flow import Progress as Callback

OWN_BAR = ("studies", "runs")  # each has its own bar; one more bar shows the current work


@contextmanager
def progress_bars() -> Iterator[Callback]:
    """Yield a callable ``progress(done, total, what)`` that draws bars; they disappear when the block ends."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    tasks: dict[str, TaskID] = {}
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as drawn:

        def progress(done: int, total: int, what: str) -> None:
            bar = what if what in OWN_BAR else "now"
            if bar not in tasks:
                tasks[bar] = drawn.add_task(what, total=total)
            drawn.update(tasks[bar], description=what, completed=done, total=total, visible=done < total)

        yield progress
