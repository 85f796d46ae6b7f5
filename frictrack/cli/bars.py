"""Progress bars on stderr, one per kind of work that reports itself."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from frictrack.flow import Progress as Callback


@contextmanager
def bars() -> Iterator[Callback]:
    """A callable ``progress(done, total, what)`` that draws a bar for every `what`; the bars go when done."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    tasks: dict[str, TaskID] = {}
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as drawn:

        def progress(done: int, total: int, what: str) -> None:
            if what not in tasks:
                tasks[what] = drawn.add_task(what, total=total)
            drawn.update(tasks[what], completed=done, total=total, visible=done < total)

        yield progress
