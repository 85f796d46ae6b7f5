"""Run independent tasks in worker processes of this machine; limit linear algebra to one thread.

    with local_workers(workers) as pool:
        future = pool.submit(function, *arguments)  # a concurrent.futures.Future

A process that dies takes only its own task with it, and a new process takes its place. The pools of the standard
library and of pebble cannot do this at every moment: their processes share queues and locks, which a dead process may
leave locked or half written. Here every process has a connection of its own.

The matrices here are many and small, and several threads only wait for each other: on two cores a diagnosis takes ten
times as long with two threads of OpenBLAS as with one.

`flow.batch.cluster` runs the same tasks on a Dask cluster.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any, Protocol, TypeVar

import psutil
from threadpoolctl import threadpool_limits

from frictrack.base.errors import FrictrackError

WORKER_ENVIRONMENT = {  # one thread of linear algebra; no import from the current folder
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "PYTHONSAFEPATH": "1",
}
MAX_ATTEMPTS = 2  # of one task whose process dies while it runs
MAX_STARTS = 20  # of processes for one task, most of which were killed before they had begun it
EXIT_TIMEOUT_S = 5.0  # for a process that has nothing left to do
MEMORY_PER_TASK_BYTES = 0.5e9  # until a task has shown how much it needs
CGROUP = Path("/sys/fs/cgroup")
Answer = tuple[float, Any, BaseException | None]  # of a process: its peak memory so far, bytes; result or error


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
    with _worker_environment():
        pool = _LocalPool(workers or processors())
        try:
            yield pool
        except BaseException:
            pool.stop()
            raise
        finally:
            pool.close()


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
    """Processes of this machine, each served by one thread. A task waits until there is memory for it."""

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._need = MEMORY_PER_TASK_BYTES
        self._threads = ThreadPoolExecutor(workers)
        self._own = threading.local()  # the process of a thread
        self._processes: list[_Process] = []
        self._lock = threading.Lock()
        self._is_stopped = False

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        return self._threads.submit(self._run, function, arguments)

    def capacity(self) -> int:
        return min(self._workers, max_parallel(free_memory(), _memory_of_children(), self._need))

    def stop(self) -> None:
        """End all processes; what was submitted is cancelled."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            self._is_stopped = True
            for process in self._processes:
                process.kill()

    def close(self) -> None:
        """Wait for what was submitted, and end the processes."""
        self._threads.shutdown()
        for process in self._processes:
            process.close()

    def _run(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        """Run a task in the process of this thread; in a new one if that dies."""
        attempts = starts = 0
        while attempts < MAX_ATTEMPTS and starts < MAX_STARTS:
            process = self._process()
            try:
                took, value, error = process.run(function, arguments)
            except EOFError:
                self._own.process, code = None, process.close()
                attempts += process.has_begun or code >= 0  # an exception while it starts will come again
                starts += 1
                with self._lock:
                    self._processes.remove(process)
                continue
            if error is not None:
                raise error
            self._need = max(self._need, took)
            return value
        raise FrictrackError(_describe_exit(code, starts))

    def _process(self) -> _Process:
        """Return the process of this thread; it is started if there is none."""
        if getattr(self._own, "process", None) is None:
            with self._lock:
                if self._is_stopped:
                    raise FrictrackError("its task was cancelled, as happens when workers are shut down; run it again")
                try:
                    self._own.process = _Process()
                except OSError as e:
                    raise FrictrackError(f"cannot start a process: {e.strerror or e}; try fewer --workers") from e
                self._processes.append(self._own.process)
        return self._own.process


class _Process:
    """A process that runs tasks one after the other; `has_begun` tells whether it had begun the last one."""

    def __init__(self) -> None:
        context = get_context("spawn")
        self.has_begun = False
        self._connection, theirs = context.Pipe()
        with theirs:  # when the process dies, nobody holds its end, and we read that it has ended
            self._process = context.Process(target=_serve, args=(theirs, os.getpid()))
            self._process.start()

    def run(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Answer:
        """Run a task; raise EOFError if the process dies."""
        self.has_begun = False
        try:
            self._connection.send((function, arguments))
            while (answer := self._connection.recv()) is None:
                self.has_begun = True
        except OSError as e:
            raise EOFError from e
        return answer

    def kill(self) -> None:
        self._process.kill()

    def close(self) -> int:
        """End the process when it is idle; return its exit code."""
        self._connection.close()
        self._process.join(EXIT_TIMEOUT_S)
        self._process.kill()
        self._process.join()
        return self._process.exitcode or 0


def _serve(connection: Connection, parent: int) -> None:
    """Run the tasks that come through a connection, until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C: our parent ends us
    _exit_with_parent(parent)
    with suppress(EOFError, OSError):
        while True:
            answer = _answer(connection)
            try:
                message = ForkingPickler.dumps(answer)
            except Exception as e:  # noqa: BLE001 - pickle may raise anything
                message = ForkingPickler.dumps((0.0, None, TypeError(f"the result of a task cannot be sent: {e}")))
            connection.send_bytes(message)


def _answer(connection: Connection) -> Answer:
    """Receive a task, say that it has begun, run it; return the peak memory, and its result or error."""
    data = connection.recv_bytes()
    try:
        function, arguments = pickle.loads(data)
        connection.send(None)
        value = function(*arguments)
        return float(_peak_memory()), value, None
    except BaseException as e:  # noqa: BLE001 - a task may raise anything
        return 0.0, None, e


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


def _describe_exit(code: int, times: int) -> str:
    """Describe how the processes of a task died."""
    how = f"was ended by signal {-code}" if code < 0 else f"ended with code {code}"
    hint = "; was memory short? try fewer --workers" if code == -9 else ""
    return f"the process that worked on it {how}, {times} times{hint}"


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


SAMPLES_AT_ONCE = 60_000  # of rows that are evaluated together, so that they fit into the cache of the processor
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


def rows_at_once(samples: int) -> int:
    """Return how many rows of a number of samples suit the cache.

    Examples
    --------
    >>> rows_at_once(1000), rows_at_once(10**6)
    (60, 1)

    """
    return max(1, SAMPLES_AT_ONCE // samples)


def map_in_threads(of: Callable[[One], Made], items: Sequence[One]) -> list[Made]:
    """Apply a function to every item, in as many threads as there are free processors.

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
