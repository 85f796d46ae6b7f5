"""One thread of linear algebra for matrices that are many and small: more threads would only wait for each other.

On two cores a diagnosis takes ten times as long with two threads of OpenBLAS as with one. The number of threads is the
whole process's, so it is lowered when the first caller enters and put back when the last one has left. Large pieces of
work that do not need each other are dealt out by hand.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from threading import Lock
from typing import TypeVar

from threadpoolctl import threadpool_limits

MOST = 2  # threads of Python that large products keep busy; more only wait for the interpreter

One = TypeVar("One")
Made = TypeVar("Made")


class _Limit:
    """The limit in force and how many callers are under it."""

    def __init__(self) -> None:
        self._lock, self._held, self._inside = Lock(), ExitStack(), 0

    def enter(self) -> None:
        """Lower the number of threads unless it is lowered."""
        with self._lock:
            if not self._inside:
                self._held.enter_context(threadpool_limits(1, user_api="blas"))
            self._inside += 1

    def leave(self) -> None:
        """Put it back unless somebody still needs it low."""
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._held.close()


_LIMIT = _Limit()


@contextmanager
def one_thread() -> Iterator[None]:
    """Hold the process to one thread of linear algebra; also a decorator, `@one_thread()`."""
    _LIMIT.enter()
    try:
        yield
    finally:
        _LIMIT.leave()


def side_by_side(of: Callable[[One], Made], items: Sequence[One]) -> list[Made]:
    """Results for every item in order, worked out in as many threads as there are processors to spare."""
    workers = min(_processors(), MOST, len(items))
    if workers < 2:
        return [of(item) for item in items]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(of, items))


def _processors() -> int:
    """Processors that this process may use; one where it is told to keep to one, as a worker among others is."""
    if os.environ.get("OMP_NUM_THREADS") == "1":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
