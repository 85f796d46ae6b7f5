"""Run independent tasks on the workers of a Dask cluster, with the interface of `frictrack.base.workers`.

A task is submitted again where what ran it is lost: Dask does so when a worker dies, this module when the scheduler was
lost, when the disk of a worker is full, and once more where Dask gave up because workers died. Dask counts the death of
a worker against all tasks that were there; the second time, a task runs alone, so that its deaths are its own.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any
from uuid import uuid4

from frictrack.base.errors import DiskFullError, FrictrackError
from frictrack.base.version import __version__
from frictrack.base.workers import WorkerPool

MAX_ATTEMPTS = 3  # of one task that is lost with the scheduler
SCHEDULER_TIMEOUT_S = 20.0  # s to wait for the first answer
RESTART_TIMEOUT_S = 300.0  # s to wait for a scheduler that was lost
_CLIENT_LOGGERS = ("distributed.batched", "distributed.client")  # their tracebacks of a lost scheduler are no news


@contextmanager
def cluster_workers(address: str) -> Iterator[WorkerPool]:
    """Open a pool of the workers of a Dask scheduler.

    The workers must see the same files and have the same version of frictrack.

    Parameters
    ----------
    address
        Address of the scheduler, such as ``"tcp://10.0.0.1:8786"``.

    Yields
    ------
    WorkerPool
        The pool. Its `capacity` raises `FrictrackError` when the scheduler was lost and none answers at the address
        within `RESTART_TIMEOUT_S`.

    Raises
    ------
    FrictrackError
        If no scheduler answers, or a worker lacks frictrack or has another version.

    """
    try:
        from distributed import Client  # noqa: PLC0415
    except ModuleNotFoundError as e:
        raise FrictrackError('--scheduler needs distributed; pip install "frictrack[cluster]"') from e
    for name in _CLIENT_LOGGERS:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        with Client(address, timeout=SCHEDULER_TIMEOUT_S, name="frictrack") as client:
            _check_versions(client)
        client = Client(address, timeout=RESTART_TIMEOUT_S, name="frictrack")  # how long it looks for a lost scheduler
    except FrictrackError:
        raise
    except (OSError, ValueError, TypeError) as e:
        raise FrictrackError(
            f"expected a Dask scheduler at {address} but none answers; start one, as `dask scheduler` does, and give "
            "the address that it prints"
        ) from e
    with client:
        yield _ClusterPool(client, address)


@dataclass(frozen=True)
class _ClusterTask:
    """A task and what happened to it so far."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    found: Future[Any] = field(default_factory=Future)
    losses: int = 0  # times that it was lost with the scheduler
    is_suspect: bool = False  # whether workers died while they had it
    workers: tuple[str, ...] = ()  # those with space on the disk, if one had none


class _ClusterPool:
    """Workers of a Dask cluster. Everything but `submit` and `capacity` runs in the thread of the client.

    Tasks run together until workers died of one of them. Such suspects wait until the others have ended, or fill all
    of the capacity, and run one by one; tasks that are submitted meanwhile are held.
    """

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._address = client, address
        self._threads: dict[str, int] = {}  # by address of the worker
        self._pinned: dict[Any, tuple[str, ...]] = {}  # by future of Dask
        self._together = 0  # tasks that are no suspects and under way
        self._alone = False  # whether a suspect is under way
        self._suspects: deque[_ClusterTask] = deque()  # that wait
        self._held: deque[_ClusterTask] = deque()  # other tasks, submitted while a suspect is under way

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        task = _ClusterTask(function, arguments)
        self._client.loop.add_callback(self._enter, task)
        return task.found

    def capacity(self) -> int:
        """Return twice the number of threads, so that no worker waits for us; 0 while the scheduler is lost."""
        if self._client.status == "closed":
            raise FrictrackError(
                f"the Dask scheduler at {self._address} was lost and none answered there for {RESTART_TIMEOUT_S:g} s; "
                "start it and run the batch again: studies that were finished are kept"
            )
        if self._client.status != "running":
            return 0
        try:
            self._threads = dict(self._client.nthreads())
        except (OSError, RuntimeError):  # it is being lost; the client finds out
            return 0
        for future, workers in list(self._pinned.items()):
            if not set(workers) & set(self._threads):  # it would wait for workers that have died
                future.cancel()
        return 2 * max(1, sum(self._threads.values()))

    def _enter(self, task: _ClusterTask) -> None:
        """Begin a task as soon as it may run."""
        if task.is_suspect:
            self._suspects.append(task)
        elif self._alone:
            self._held.append(task)
        else:
            self._together += 1
            self._begin(task)
        self._begin_suspect()

    def _leave(self, task: _ClusterTask) -> None:
        """Begin what waited for a task that has ended."""
        if task.is_suspect:
            self._alone, held = False, [*self._held]
            self._held.clear()
            for one in held:
                self._enter(one)
        else:
            self._together -= 1
        self._begin_suspect()

    def _begin_suspect(self) -> None:
        """Begin the first suspect if nothing else is under way."""
        if self._suspects and not self._alone and not self._together:
            self._alone = True
            self._begin(self._suspects.popleft())

    def _begin(self, task: _ClusterTask) -> None:
        how: dict[str, Any] = {"key": f"{task.function.__name__}-{uuid4()}"}  # Dask learns durations by the first part
        if task.workers:
            how["workers"] = list(task.workers)
        future = self._client.submit(_call, task.function, task.arguments, pure=False, **how)
        if task.workers:
            self._pinned[future] = task.workers
        self._client.loop.add_callback(self._follow, task, future)

    async def _follow(self, task: _ClusterTask, future: Any) -> None:
        """Wait for a task. What is neither its result nor its own error happened on the way to us: it is lost."""
        value: Any = None
        error: Exception | None = None
        try:
            value = await self._client.gather(future, asynchronous=True)
        except Exception as e:  # noqa: BLE001 - a task may raise anything
            error = e
        self._pinned.pop(future, None)
        if error is None or future.status == "error":
            self._ended(task, value, error)
        else:
            self._lost(task)

    def _ended(self, task: _ClusterTask, value: Any, error: Exception | None) -> None:
        """Give the result of a task on, or submit it again."""
        from distributed import KilledWorker  # noqa: PLC0415 - optional

        if isinstance(error, KilledWorker) and not task.is_suspect:
            self._enter(replace(task, is_suspect=True))
            self._leave(task)
        elif isinstance(error, DiskFullError) and not task.workers and (others := self._others(error.worker)):
            self._begin(replace(task, workers=others))
        elif isinstance(error, KilledWorker):
            self._finish(task, FrictrackError(_describe_deaths(error)))
        else:
            self._finish(task, error, value)

    def _lost(self, task: _ClusterTask) -> None:
        """Submit a task again that was lost with the scheduler, or that waited for workers which have died."""
        if self._client.status in ("closing", "closed"):
            return  # `capacity` says so
        if task.losses + 1 < MAX_ATTEMPTS:
            self._begin(replace(task, losses=task.losses + 1, workers=()))
            return
        what = f"the Dask scheduler was lost {MAX_ATTEMPTS} times while this was computed; run the batch again"
        self._finish(task, FrictrackError(what))

    def _finish(self, task: _ClusterTask, error: BaseException | None, value: Any = None) -> None:
        self._leave(task)
        if error is not None:
            task.found.set_exception(error)
        else:
            task.found.set_result(value)

    def _others(self, full: str) -> tuple[str, ...]:
        """Return the workers on other hosts than this one; the other ones on this host if there is no other host."""
        others = [worker for worker in self._threads if worker != full]
        elsewhere = [worker for worker in others if _host(worker) != _host(full)]
        return tuple(elsewhere or others)


def _host(address: str) -> str:
    """The host of an address such as ``tcp://10.0.0.1:8786``."""
    return address.rpartition(":")[0]


def _call(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Run a task in a worker; an error of a full disk says in which one."""
    try:
        return function(*arguments)
    except DiskFullError as e:
        from distributed import get_worker  # noqa: PLC0415 - optional

        e.worker = get_worker().address
        raise


def _describe_deaths(error: Any) -> str:
    """Describe why Dask gave a task up."""
    return (
        f"the workers that computed it died, {2 * (error.allowed_failures + 1)} times, the last one at "
        f"{error.last_worker.address}; their logs say why, often a lack of memory"
    )


def _check_versions(client: Any) -> None:
    """Raise `FrictrackError` unless every worker has this version of frictrack."""
    found = client.run(_version, on_error="return")
    if not found:
        raise FrictrackError("expected workers at the scheduler but there are none; start some, as `dask worker` does")
    for worker, theirs in found.items():
        if theirs != __version__:
            raise FrictrackError(
                f"expected frictrack {__version__} on every worker but {worker} says: {theirs}; update it"
            )


def _version() -> str:
    return __version__
