"""Who does pieces of work that do not need each other: processes of this machine, or an existing Dask cluster.

with here(workers) as crew:
    future = crew.submit(function, *arguments)  # a concurrent.futures.Future

A process that dies takes only its own piece of work with it; that piece is begun again by another one.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Protocol

import psutil

from frictrack.errors import FrictrackError
from frictrack.threads import processors
from frictrack.version import __version__

ALIKE = {  # of every process: one thread of linear algebra, and no Python files of the folder that we are in
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "PYTHONSAFEPATH": "1",
}
TRIES = 3  # of one piece of work whose process dies
NEED = 0.5e9  # bytes that a piece of work takes, until one has shown what it takes
GROUP = Path("/sys/fs/cgroup")
PATIENCE = 20.0  # s until a scheduler that does not answer is none


class Crew(Protocol):
    """Takes pieces of work."""

    def submit(self, of: Callable[..., Any], *told: Any) -> Future[Any]:
        """Begin a piece of work."""

    def room(self) -> int:
        """How many pieces of work may be under way at once."""


@contextmanager
def here(workers: int | None = None) -> Iterator[Crew]:
    """Processes of this machine, as many as there are processors and as the free memory takes; one thread each."""
    from pebble import ProcessPool  # noqa: PLC0415 - only who works side by side needs it

    workers = workers or processors()
    with _alike():
        pool = ProcessPool(workers, context=get_context("spawn"), initializer=_follow, initargs=(os.getpid(),))
        try:
            yield _Here(pool, workers)
            pool.close()
        except BaseException:
            pool.stop()
            raise
        finally:
            pool.join()


@contextmanager
def cluster(address: str) -> Iterator[Crew]:
    """The workers of the Dask scheduler at an address; they must see the files, and have this version of frictrack.

    Raises `FrictrackError` where no scheduler answers, or a worker lacks frictrack or has another version.
    """
    try:
        from distributed import Client  # noqa: PLC0415
    except ModuleNotFoundError as e:
        raise FrictrackError('--scheduler needs distributed; pip install "frictrack[cluster]"') from e
    try:
        client = Client(address, timeout=PATIENCE, name="frictrack")
    except (OSError, ValueError, TypeError) as e:
        raise FrictrackError(
            f"expected a Dask scheduler at {address} but none answers; start one, as `dask scheduler` does, and give "
            "the address that it prints"
        ) from e
    with client:
        _check(client)
        yield _There(client)


def spread(work: Mapping[str, Callable[[], Any]], workers: int | None = None) -> Iterator[tuple[str, Any]]:
    """Names and results of independent pieces of work, as they come; a single worker is this very process.

    What a piece of work raises is raised here, and the rest is not begun.
    """
    workers = min(workers or processors(), max(len(work), 1))
    if workers == 1:
        yield from ((name, job()) for name, job in work.items())
        return
    with here(workers) as crew:
        names = {crew.submit(job): name for name, job in work.items()}
        while names:
            done, _ = wait(names, return_when=FIRST_COMPLETED)
            for future in done:
                yield names.pop(future), future.result()


def fitting(free: float, taken: float, need: float) -> int:
    """How many pieces of work fit beside each other: memory still `free` and `taken` by ours over the `need` of one."""
    return max(1, int((free + taken) / max(need, 1.0)))


def free_memory(group: Path = GROUP) -> float:
    """Bytes that may still be taken: what the machine has, or the container that we are in."""
    free = float(psutil.virtual_memory().available)
    try:
        most = (group / "memory.max").read_text().strip()
        used = float((group / "memory.current").read_text())
        cached = dict(line.split() for line in (group / "memory.stat").read_text().splitlines()).get("inactive_file", 0)
    except (OSError, ValueError):
        return free
    return free if most == "max" else min(free, float(most) - used + float(cached))


class _Here:
    """Processes of this machine. A piece of work waits until the memory takes it."""

    def __init__(self, pool: Any, workers: int) -> None:
        self._pool = pool
        self._workers = workers
        self._need = NEED

    def submit(self, of: Callable[..., Any], *told: Any) -> Future[Any]:
        found: Future[Any] = Future()
        self._begin(found, TRIES, of, told)
        return found

    def room(self) -> int:
        return min(self._workers, fitting(free_memory(), _taken(), self._need))

    def _begin(self, found: Future[Any], tries: int, of: Callable[..., Any], told: tuple[Any, ...]) -> None:
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
                    self._begin(found, tries - 1, of, told)
                else:
                    found.set_exception(FrictrackError(_end(died.exitcode)))
            else:
                found.set_exception(died)

        self._pool.schedule(_weighed, args=(of, told)).add_done_callback(ended)


class _There:
    """Workers of a cluster, which begins again by itself what a dead one had under way."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._executor = client.get_executor(pure=False)

    def submit(self, of: Callable[..., Any], *told: Any) -> Future[Any]:
        found: Future[Any] = self._executor.submit(of, *told)
        return found

    def room(self) -> int:
        """Twice what works at once, so that nobody waits for us."""
        return 2 * max(1, sum(self._client.nthreads().values()))


def _weighed(of: Callable[..., Any], told: tuple[Any, ...]) -> tuple[float, Any]:
    """A piece of work, and the most memory that its process has taken so far."""
    value = of(*told)
    return float(_peak()), value


def _peak() -> float:
    """Most bytes that this process has held."""
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ModuleNotFoundError:
        return float(psutil.Process().memory_info().peak_wset)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)


def _taken() -> float:
    """Bytes that our processes hold."""
    total = 0.0
    for child in psutil.Process().children(recursive=True):
        try:
            total += child.memory_info().rss
        except psutil.Error:  # it has ended meanwhile
            continue
    return total


def _end(code: int) -> str:
    """A process that died, in words."""
    how = f"was ended by signal {-code}" if code < 0 else f"ended with code {code}"
    hint = "; was memory short? try fewer --workers" if code == -9 else ""
    return f"the process that worked on it {how}, {TRIES} times{hint}"


def _follow(parent: int) -> None:
    """End with the process that began us, however it ends: nobody would take the result."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _check(client: Any) -> None:
    """Every worker has our version."""
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


@contextmanager
def _alike() -> Iterator[None]:
    """The environment of processes that share the processors."""
    before = {name: os.environ.get(name) for name in ALIKE}
    os.environ.update(ALIKE)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})
