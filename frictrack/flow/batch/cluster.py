"""Run independent tasks on the workers of a Dask cluster, with the interface of `frictrack.base.workers`.

Dask gives a task to another worker when its worker dies. A task that is lost with the scheduler is cancelled.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Any
from uuid import uuid4

from frictrack.base import __version__
from frictrack.base.errors import FrictrackError
from frictrack.base.workers import WorkerPool

SCHEDULER_TIMEOUT_S = 20.0  # s to wait for the first answer
RESTART_TIMEOUT_S = 300.0  # s to wait for a scheduler that was lost
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
    """Workers of a Dask cluster. `_run` runs in the loop of the client."""

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._address = client, address

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
        try:
            return 2 * max(1, sum(self._client.nthreads().values())) if self._client.status == "running" else 0
        except (OSError, RuntimeError):  # it is being lost; the client finds out
            return 0

    async def _run(self, found: Future[Any], function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        """Compute a task. What is neither its result nor its error happened on the way to us: it is lost."""
        key = f"{function.__name__}-{uuid4()}"  # Dask learns durations by the first part
        future = self._client.submit(function, *arguments, pure=False, key=key)
        try:
            found.set_result(await self._client.gather(future, asynchronous=True))
        except Exception as e:  # noqa: BLE001 - a task may raise anything
            if future.status == "error":
                found.set_exception(e)
            else:
                found.cancel()
                found.set_running_or_notify_cancel()


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
