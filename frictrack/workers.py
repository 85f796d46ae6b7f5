"""Run independent tasks in worker processes of this machine; `frictrack.cluster` runs them on a Dask cluster.

    with local_workers(workers) as pool:
        future = pool.submit(function, *arguments)  # a concurrent.futures.Future

A process that dies takes only its own task with it, and another process starts that task again. The standard library's
`ProcessPoolExecutor` cannot do this: one dead process breaks the pool and fails all tasks, so pebble is used here.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Protocol

import psutil

from frictrack.errors import FrictrackError
from frictrack.threads import processors

WORKER_ENVIRONMENT = {  # one thread of linear algebra; no import from the current folder
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "PYTHONSAFEPATH": "1",
}
MAX_ATTEMPTS = 3  # of one task whose process dies
MEMORY_PER_TASK_BYTES = 0.5e9  # until a task has shown how much it needs
CGROUP = Path("/sys/fs/cgroup")


class WorkerPool(Protocol):
    """The interface of a pool of workers."""

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Start `function(*arguments)` in a worker."""

    def capacity(self) -> int:
        """Return how many tasks may run at the same time."""


@contextmanager
def local_workers(workers: int | None = None) -> Iterator[WorkerPool]:
    """Open a pool of processes of this machine, one thread of linear algebra each.

    Tasks wait until the free memory is enough for one more.

    Parameters
    ----------
    workers
        Number of processes; as many as there are processors if None.

    Yields
    ------
    WorkerPool
        The pool. It is closed when the block ends, and its processes are stopped when the block raises.

    """
    from pebble import ProcessPool  # noqa: PLC0415 - only needed for several processes

    workers = workers or processors()
    with _worker_environment():
        pool = ProcessPool(
            workers, context=get_context("spawn"), initializer=_exit_with_parent, initargs=(os.getpid(),)
        )
        try:
            yield _LocalPool(pool, workers)
            pool.close()
        except BaseException:
            pool.stop()
            raise
        finally:
            pool.join()


def run_parallel(work: Mapping[str, Callable[[], Any]], workers: int | None = None) -> Iterator[tuple[str, Any]]:
    """Run independent tasks and yield each result as soon as it is there.

    Parameters
    ----------
    work
        Functions without arguments, by name.
    workers
        Number of processes; as many as there are processors if None. With 1, all runs in this process, in order.

    Yields
    ------
    tuple of (str, object)
        Name and result of one task. What a task raises is raised here, and no further task is started.

    Examples
    --------
    >>> from functools import partial
    >>> dict(run_parallel({"a": partial(pow, 2, 3), "b": partial(pow, 2, 4)}, workers=1))
    {'a': 8, 'b': 16}

    """
    workers = min(workers or processors(), max(len(work), 1))
    if workers == 1:
        yield from ((name, job()) for name, job in work.items())
        return
    with local_workers(workers) as pool:
        names = {pool.submit(job): name for name, job in work.items()}
        while names:
            done, _ = wait(names, return_when=FIRST_COMPLETED)
            for future in done:
                yield names.pop(future), future.result()


def limit_memory(size: int) -> None:
    """Limit the memory of this process, so that a greedy file fails here and does not exhaust the machine.

    Parameters
    ----------
    size
        Bytes that the process may take in addition to what it has; not on Windows.

    """
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ModuleNotFoundError:
        return
    with suppress(OSError, ValueError):
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + size, used + size))


def max_parallel(free: float, taken: float, need: float) -> int:
    """Return how many tasks fit into memory at the same time, at least one.

    Parameters
    ----------
    free, taken
        Memory that is free, and memory that the running tasks hold, bytes.
    need
        Memory of one task, bytes.

    Examples
    --------
    >>> max_parallel(free=3e9, taken=1e9, need=1.5e9)
    2

    """
    return max(1, int((free + taken) / max(need, 1.0)))


def free_memory(group: Path = CGROUP) -> float:
    """Return the memory that may still be used, bytes: of the machine, or of the container if its limit is lower.

    Parameters
    ----------
    group
        Folder of the container's limits (Linux control group, version 2).

    """
    free = float(psutil.virtual_memory().available)
    try:
        most = (group / "memory.max").read_text().strip()
        used = float((group / "memory.current").read_text())
        cached = dict(line.split() for line in (group / "memory.stat").read_text().splitlines()).get("inactive_file", 0)
    except (OSError, ValueError):
        return free
    return free if most == "max" else min(free, float(most) - used + float(cached))


class _LocalPool:
    """Processes of this machine. A task waits until there is memory for it."""

    def __init__(self, pool: Any, workers: int) -> None:
        self._pool = pool
        self._workers = workers
        self._need = MEMORY_PER_TASK_BYTES

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        found: Future[Any] = Future()
        self._begin(found, MAX_ATTEMPTS, function, arguments)
        return found

    def capacity(self) -> int:
        return min(self._workers, max_parallel(free_memory(), _memory_of_children(), self._need))

    def _begin(self, found: Future[Any], tries: int, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        def ended(future: Any) -> None:
            if future.cancelled():
                found.cancel()
                return
            died = future.exception()
            if died is None:
                took, value = future.result()
                self._need = max(self._need, took)
                found.set_result(value)
            elif isinstance(died, OSError) and hasattr(died, "exitcode"):  # pebble's ProcessExpired
                if tries > 1:
                    self._begin(found, tries - 1, function, arguments)
                else:
                    found.set_exception(FrictrackError(_describe_exit(died.exitcode)))
            else:
                found.set_exception(died)

        self._pool.schedule(_with_peak_memory, args=(function, arguments)).add_done_callback(ended)


def _with_peak_memory(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[float, Any]:
    """Run a task; return the peak memory of its process so far, bytes, and the result."""
    value = function(*arguments)
    return float(_peak_memory()), value


def _peak_memory() -> float:
    """Return the peak memory of this process, bytes."""
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ModuleNotFoundError:
        return float(psutil.Process().memory_info().peak_wset)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)


def _memory_of_children() -> float:
    """Return the memory that our processes hold, bytes."""
    total = 0.0
    for child in psutil.Process().children(recursive=True):
        try:
            total += child.memory_info().rss
        except psutil.Error:  # it has ended meanwhile
            continue
    return total


def _describe_exit(code: int) -> str:
    """Describe how a process died."""
    how = f"was ended by signal {-code}" if code < 0 else f"ended with code {code}"
    hint = "; was memory short? try fewer --workers" if code == -9 else ""
    return f"the process that worked on it {how}, {MAX_ATTEMPTS} times{hint}"


def _exit_with_parent(parent: int) -> None:
    """End this process when its parent ends, in any way: nobody would use the result."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _worker_environment() -> Iterator[None]:
    """Set the environment of the processes that share the processors."""
    before = {name: os.environ.get(name) for name in WORKER_ENVIRONMENT}
    os.environ.update(WORKER_ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})
