"""Follow the files of one study: read them when they change, and send the new state to every open tab.

The files are the only state. A change made by the command line, by a job or by another tab is noticed in the same way.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import secrets
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from frictrack.base.errors import FrictrackError
from frictrack.base.files import INTERNAL_FOLDER
from frictrack.workbench import jobs
from frictrack.workbench.films import Films

POLL_S = 0.1  # between two checks of the files
RESUME_S = 2.0  # without a job: the user may try the next candidate
MAX_POLL_S = 0.5  # when a check takes long, as on a network drive
T = TypeVar("T")


class LiveStudy:
    """The state of one study as its files are, and the tabs that show it.

    Parameters
    ----------
    path : Path
        Study file, which need not exist yet.

    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.server = secrets.token_hex(8)  # tells the tabs that another process answers
        self.version = 0
        self.snapshot: Any = None
        self._snapshots: Any = None  # their reader
        self.state: dict[str, Any] = {}
        self._text = "{}"
        self.output = path.parent / f"{path.stem}_results"  # until the study file is read
        self.launcher = jobs.WarmLauncher()
        self.resumes_background = False  # the fit of a candidate has interrupted it
        self._idle_since = time.monotonic()
        self._seen: object = None
        self.jobs, self._follower = jobs.JobsNow(), jobs.JobFollower()
        self._listeners: set[Callable[[str], object]] = set()
        self.films = Films()
        self._reader, self._writer, self._drawer = (ThreadPoolExecutor(1, name) for name in ("read", "write", "draw"))
        self._wake, self._ready, self._checked = asyncio.Event(), asyncio.Event(), asyncio.Condition()
        self._asked = self._answered = 0  # requests of the state, and how many of them the last check came after

    # --- what the tabs get

    async def state_json(self) -> str:
        """The state as the files are now, as JSON: a change that was made before is in it."""
        await self._ready.wait()
        self._asked += 1
        mine = self._asked
        self.look_now()
        async with self._checked:
            await self._checked.wait_for(lambda: self._answered >= mine)
        return self._whole

    def listen(self, call: Callable[[str], object]) -> Callable[[], None]:
        """Call a function with every message to the tabs, as JSON; return a function that ends this."""
        self._listeners.add(call)
        return lambda: self._listeners.discard(call)

    def _send(self, message: str) -> None:
        for call in tuple(self._listeners):
            call(message)

    # --- following the files

    def look_now(self) -> None:
        """Check the files at once, because they have just been changed."""
        self._wake.set()

    async def read(self, call: Callable[..., T], *arguments: Any) -> T:
        """Run a function in the only thread that reads the files of the study."""
        return await asyncio.get_running_loop().run_in_executor(self._reader, call, *arguments)

    async def read_snapshot(self) -> Any:
        """The study and its results as they were read last; waits for the first time."""
        await self._ready.wait()
        return self.snapshot

    async def draw(self, call: Callable[..., T], *arguments: Any) -> T:
        """Run a function in the only thread that draws figures."""
        return await asyncio.get_running_loop().run_in_executor(self._drawer, call, *arguments)

    async def write(self, call: Callable[..., T], *arguments: Any) -> T:
        """Run a function that changes the study, given this object first; changes are made one after the other."""
        done = await asyncio.get_running_loop().run_in_executor(self._writer, call, self, *arguments)
        self.look_now()
        return done

    async def watch(self) -> None:
        """Follow the files until cancelled."""
        while True:
            began, asked = time.monotonic(), self._asked
            try:
                await self._check()
                await self._use_idle_time()
            except FrictrackError:  # the files changed meanwhile; the next check tells it
                await asyncio.sleep(POLL_S)
            except Exception:
                logging.getLogger(__name__).exception("the files of the study cannot be followed")
                await asyncio.sleep(1.0)
            async with self._checked:
                self._answered = asked
                self._checked.notify_all()
            pause = min(max(POLL_S, time.monotonic() - began), MAX_POLL_S)
            with suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), pause)
            self._wake.clear()

    async def _use_idle_time(self) -> None:
        """Prepare the process of the next job; continue background work that was interrupted."""
        if self.launcher.is_needed:
            await asyncio.to_thread(self.launcher.prepare)
        if self.resumes_background and time.monotonic() - self._idle_since > RESUME_S:
            await self.write(LiveStudy._resume_background)

    def _resume_background(self) -> None:
        """Start the background work again that the fit of a candidate has interrupted."""
        self.resumes_background = False
        if self.running_job() is None and self.path.exists():
            jobs.start(self.path, self.output, jobs.JobSpec("background"), self.launcher.launch)

    async def _check(self) -> None:
        """Read the files if they have changed. The marks are taken first: a change while they are read is seen next."""
        marks, now = await self.read(self._look)
        ended = now.last is not None and now.last != self.jobs.last
        self._idle_since = time.monotonic() if now.running else self._idle_since
        if now != self.jobs:
            self.jobs = now
            self._send(f'{{"type":"job",{self._job_json}}}')
        if marks != self._seen or ended:
            self._seen = marks
            self.version += 1
            self._text = await self.read(self._read_state, self.version)
            self._ready.set()
            self._send(f'{{"type":"state","state":{self._whole}}}')

    def _look(self) -> tuple[object, jobs.JobsNow]:
        """Marks of the files, and the jobs."""
        with suppress(OSError, FrictrackError):  # a study file that cannot be read: the folder known last
            self.output = _output_folder(self.path, self.path.stat().st_mtime_ns)
        return file_marks(self.path, self.output), self._follower.look(self.output)

    @property
    def _job_json(self) -> str:
        return f'"job":{to_json(self.jobs.running)},"last_job":{to_json(self.jobs.last)}'

    @property
    def _whole(self) -> str:
        """The state with the jobs, as JSON."""
        return f"{self._text[:-1]},{self._job_json}}}"

    def running_job(self) -> jobs.Job | None:
        """The running job, as the files are now."""
        return jobs.running_job(self.output)

    def _read_state(self, version: int) -> str:
        """Read the study and describe it; what cannot be read is said in `error`."""
        from frictrack.workbench.summaries import SnapshotReader, state_of  # noqa: PLC0415 - loads NumPy and more

        try:
            self._snapshots = self._snapshots or SnapshotReader(self.path)
            self.snapshot = self._snapshots.read()
            self.state = {**state_of(self.snapshot)}
        except Exception as e:
            if not isinstance(e, OSError | FrictrackError):
                logging.getLogger(__name__).exception("the study cannot be described")
            words = f"{self.path.name} cannot be read now ({e}); undo the last change or run it again"
            self.state = {**self.state, "error": words}
        self.state |= {"version": version, "server": self.server}
        return to_json(self.state)

    def close(self) -> None:
        """Close the films, and end the threads and the process that waits for a job."""
        self.launcher.close()
        self.films.close()
        for thread in (self._reader, self._writer, self._drawer):
            thread.shutdown(wait=False, cancel_futures=True)


def file_marks(path: Path, output: Path) -> list[tuple[str, int, int, int]]:
    """Marks of all files from which the state of a study is made; they differ when a file has changed.

    Parameters
    ----------
    path, output : Path
        Study file, and folder of its results.

    Returns
    -------
    list of tuple
        Path, time of change, size and inode of the study file, of what lies beside it, and of results and history.

    """
    folders = (path.parent, output, output / INTERNAL_FOLDER, output / INTERNAL_FOLDER / "attempts")
    return sorted(mark for folder in folders for mark in _marks_in(folder) if mark[0] != str(output))


def _marks_in(folder: Path) -> list[tuple[str, int, int, int]]:
    """Marks of the files of one folder, without temporary and lock files; empty if there is no such folder."""
    out = []
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith(".") or entry.name in ("lock", "work"):
                continue
            with suppress(OSError):  # vanished meanwhile
                is_folder, stat = entry.is_dir(), entry.stat()
                if is_folder and folder.name == INTERNAL_FOLDER:
                    continue
                out.append((entry.path, stat.st_mtime_ns, 0 if is_folder else stat.st_size, stat.st_ino))
    return out


@lru_cache(8)
def _output_folder(path: Path, changed: int) -> Path:
    """Folder of the results of a study file of some time of change."""
    from frictrack.study import results_folder  # noqa: PLC0415 - loads pydantic

    return results_folder(path)


def to_json(value: Any) -> str:
    """Convert to JSON as browsers read it: numbers that are not finite become null.

    Examples
    --------
    >>> to_json({"a": float("nan")})
    '{"a":null}'

    """
    from frictrack.results import to_builtins  # noqa: PLC0415 - loads NumPy

    return json.dumps(to_builtins(value), separators=(",", ":"), default=list)  # sets become lists
