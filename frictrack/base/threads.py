"""Limit linear algebra to one thread, and map functions over items in a few threads of Python.

The matrices here are many and small, and several threads only wait for each other: on two cores a diagnosis takes ten
times as long with two threads of OpenBLAS as with one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from threadpoolctl import threadpool_limits

MAX_THREADS = 2  # of Python that large matrix products keep busy; more only wait for the interpreter

One = TypeVar("One")
Made = TypeVar("Made")


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit linear algebra to one thread, as a context manager or a decorator.

    Examples
    --------
    >>> with one_thread():
    ...     pass

    """
    with threadpool_limits(1, user_api="blas"):
        yield


def map_in_threads(of: Callable[[One], Made], items: Sequence[One]) -> list[Made]:
    """Apply a function to every item, in as many threads as there are free processors.

    Parameters
    ----------
    of
        The function; it must release the interpreter lock most of the time.
    items
        The items.

    Returns
    -------
    list
        The results, in the order of the items.

    Examples
    --------
    >>> map_in_threads(abs, [-1, 2])
    [1, 2]

    """
    workers = min(_max_threads(), MAX_THREADS, len(items))
    if workers < 2:
        return [of(item) for item in items]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(of, items))


def _max_threads() -> int:
    """Return the number of processors for threads: one if this process is a worker among others."""
    return 1 if os.environ.get("OMP_NUM_THREADS") == "1" else processors()


def processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
