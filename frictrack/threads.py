"""One thread of linear algebra for matrices that are many and small: more threads would only wait for each other.

On two cores a diagnosis takes ten times as long with two threads of OpenBLAS as with one. Large pieces of work that do
not need each other are dealt out by hand.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from threadpoolctl import threadpool_limits

MAX_THREADS = 2  # threads of Python that large products keep busy; more only wait for the interpreter

One = TypeVar("One")
Made = TypeVar("Made")


@contextmanager
def one_thread() -> Iterator[None]:
    """Hold the process to one thread of linear algebra; also a decorator, `@one_thread()`."""
    with threadpool_limits(1, user_api="blas"):
        yield


def map_in_threads(of: Callable[[One], Made], items: Sequence[One]) -> list[Made]:
    """Results for every item in order, worked out in as many threads as there are processors to spare."""
    workers = min(_max_threads(), MAX_THREADS, len(items))
    if workers < 2:
        return [of(item) for item in items]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(of, items))


def _max_threads() -> int:
    """Processors for threads: one where this process is told to keep to one, as a worker among others is."""
    return 1 if os.environ.get("OMP_NUM_THREADS") == "1" else processors()


def processors() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
