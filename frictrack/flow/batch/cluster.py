"""Run independent tasks on the workers of a Dask cluster, with the interface of `frictrack.base.workers`.

A task is submitted again where what ran it is lost: Dask does so when a worker dies, this module when the scheduler was
lost, when the disk of a worker is full, and once more where Dask gave up because workers died. Dask counts the death of
a worker against all tasks that were there; the second time, a task runs alone, so that its deaths are its own.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import Future
from contextlib import asynccontextmanager, contextmanager
from typing import Any
from uuid import uuid4

from frictrack.base import __version__
from frictrack.base.errors import DiskFullError, FrictrackError
from frictrack.base.workers import WorkerPool

MAX_ATTEMPTS = 3  # of one task that is lost with the scheduler
SCHEDULER_TIMEOUT_S = 20.0  # s to wait for the first answer
RESTART_TIMEOUT_S = 300.0  # s to wait for a scheduler that was lost
LOST = f"the Dask scheduler was lost {MAX_ATTEMPTS} times while this was computed; run the batch again"
_CLIENT_LOGGERS = ("distributed.batched", "distributed.client")  # their tracebacks of a lost scheduler are no news


@contextmanager
def cluster_workers(address: str) -> Iterator[WorkerPool]:
    """Open a pool of the workers of a Dask scheduler.

    The workers must see the same files and have the same version of frictrack.
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


class _ClusterPool:
    """Workers of a Dask cluster. Everything but `submit` and `capacity` runs in the loop of the client."""

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._address = client, address
        self._threads: dict[str, int] = {}  # by address of the worker
        self._pinned: dict[Any, tuple[str, ...]] = {}  # by future of Dask: the workers that it waits for
        self._under_way = 0  # tasks
        self._is_alone = False  # whether the one under way runs alone
        self._changed = asyncio.Condition()  # of these two

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        found: Future[Any] = Future()
        self._client.loop.add_callback(self._run, found, function, arguments)
        return found

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

    async def _run(self, found: Future[Any], function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        """Compute a task, again if what ran it is lost: the scheduler, the worker, or the space on a disk."""
        from distributed import KilledWorker  # noqa: PLC0415 - optional

        losses, alone = 0, False
        workers: tuple[str, ...] = ()  # those with space on the disk, if one had none
        while not found.done():
            async with self._place(alone=alone):
                value, error = await self._attempt(function, arguments, workers)
            if isinstance(error, _LostError):
                if self._client.status in ("closing", "closed"):
                    return  # `capacity` says so
                losses, workers = losses + 1, ()
                if losses == MAX_ATTEMPTS:
                    found.set_exception(FrictrackError(LOST))
            elif isinstance(error, KilledWorker) and not alone:
                alone = True  # so that its deaths are its own
            elif isinstance(error, DiskFullError) and not workers and (others := self._others(error.worker)):
                workers = others
            elif error is not None:
                killed = isinstance(error, KilledWorker)
                found.set_exception(FrictrackError(_describe_deaths(error)) if killed else error)
            else:
                found.set_result(value)

    @asynccontextmanager
    async def _place(self, *, alone: bool) -> AsyncIterator[None]:
        """Wait until a task may run: one alone when nothing is under way, the others while none runs alone."""
        async with self._changed:
            await self._changed.wait_for(lambda: not (self._is_alone or (alone and self._under_way)))
            self._is_alone, self._under_way = alone, self._under_way + 1
        try:
            yield
        finally:
            async with self._changed:
                self._is_alone, self._under_way = False, self._under_way - 1
                self._changed.notify_all()

    async def _attempt(
        self, function: Callable[..., Any], arguments: tuple[Any, ...], workers: tuple[str, ...]
    ) -> tuple[Any, Exception | None]:
        """Return the result of a task, or its error. What is neither happened on the way to us: it is lost."""
        how: dict[str, Any] = {"key": f"{function.__name__}-{uuid4()}"}  # Dask learns durations by the first part
        if workers:
            how["workers"] = list(workers)
        future = self._client.submit(_call, function, arguments, pure=False, **how)
        if workers:
            self._pinned[future] = workers
        try:
            return await self._client.gather(future, asynchronous=True), None
        except Exception as e:  # noqa: BLE001 - a task may raise anything
            return None, e if future.status == "error" else _LostError()
        finally:
            self._pinned.pop(future, None)

    def _others(self, full: str) -> tuple[str, ...]:
        """Return the workers on other hosts than this one; the other ones on this host if there is no other host."""
        others = [worker for worker in self._threads if worker != full]
        elsewhere = [worker for worker in others if _host(worker) != _host(full)]
        return tuple(elsewhere or others)


class _LostError(Exception):
    """A task was lost with the scheduler, or waited for workers that have died."""


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
