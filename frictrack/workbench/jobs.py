"""Start, list and cancel long jobs. Each runs in a process of its own and reports through files.

The files lie in the hidden folder of the results:

jobs/0007/spec.json       the command, its arguments, and who started it
jobs/0007/progress.jsonl  progress, one line per step
jobs/0007/alive           locked by the process while it runs
jobs/0007/began           created by the process once it holds that lock
jobs/0007/cancel          created to cancel the job; the process ends at once
jobs/0007/result.json     the result or the error
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock, Thread
from typing import Any

from frictrack import flow
from frictrack.base import files
from frictrack.base.errors import FrictrackError
from frictrack.workbench import BusyError

MAX_START_SECONDS = 20.0  # until the process holds its lock
MAX_CANCEL_SECONDS = 3.0  # until a cancelled process has ended
MAX_JOBS_KEPT = 30
LAST_LINE_BYTES = 4096  # of the file of progress
CHAINED = ("add_and_diagnose", "remove_and_diagnose", "add", "remove")
REPEATED = ("run", "measure", "diagnose", "report")  # the later one does all that the earlier one would do
MODEL_CHANGES = (*CHAINED, "fit", "run", "measure")
WORDS = {  # of the others, the first part of their name
    "measure": "Measure the runs",
    "attempt": "Try",
    "report": "Write the report",
    "background": "Complete the diagnosis and the report",
}
STEPS = {  # first word of what a step says when it begins
    "measuring": "Measure the runs",
    "fitting": "Fit the model",
    "diagnosing": "Find what is missing",
    "writing": "Write the report",
}
POLL_S = 0.01  # between two looks at a job that is to end
BACKGROUND = "background"  # phase of a job whose result is stored already
RUNNING, DONE, FAILED, CANCELLED, INTERRUPTED = "running", "done", "failed", "cancelled", "interrupted"


@dataclass(frozen=True)
class Job:
    """One job of a study, given by its folder."""

    folder: Path

    @property
    def spec(self) -> dict[str, Any]:
        """Content of ``spec.json``.

        Returns
        -------
        dict
            ``do`` (command), ``told`` (arguments), ``study``, ``seen`` (revision), ``who``, and ``at``, the start
            time in s since 1970.

        Raises
        ------
        FrictrackError
            If the file is damaged.

        """
        return _read_json(self.folder / "spec.json", "do", "at", "study")

    @property
    def result(self) -> dict[str, Any]:
        """The result; empty while the job runs. A failure is under ``error``."""
        try:
            return _read_json(self.folder / "result.json")
        except FileNotFoundError:
            return {}

    @property
    def progress(self) -> dict[str, Any]:
        """The newest line of progress.

        Returns
        -------
        dict
            ``done`` of ``total``, the text ``what``, the ``step`` that it belongs to, and ``phase``, which is
            "background" once the result that the user waits for is stored. Empty before the first line; an incomplete
            last line is ignored.

        """
        try:
            with (self.folder / "progress.jsonl").open("rb") as file:
                file.seek(max(0, file.seek(0, os.SEEK_END) - LAST_LINE_BYTES))
                lines = file.read().split(b"\n")[:-1]
            return dict(json.loads(lines[-1])) if lines else {}
        except (OSError, ValueError):
            return {}

    @property
    def words(self) -> str:
        """What the job does, in a few words."""
        spec = self.spec
        more = [spec["told"].get(key) for key in ("effect", "model")]
        what = WORDS.get(spec["do"], spec["do"].partition("_")[0].capitalize())
        return " ".join((what, *(str(one) for one in more if one)))

    @property
    def summary(self) -> dict[str, Any]:
        """The job as the page shows it: id, do, words, step, progress, state, error and warnings."""
        spec, state, progress = self.spec, self.state, self.progress
        result = self.result if state in (DONE, FAILED) else {}
        made = result.get("done")
        warnings = made.get("warnings", []) if isinstance(made, dict) else []
        return {
            "id": self.folder.name,
            "do": spec["do"],
            "words": self.words,
            "arguments": spec["told"],
            "done": progress.get("done", 0),
            "total": progress.get("total", 0),
            "what": progress.get("what", "starts"),
            "step": STEPS.get(progress.get("step", "").partition(" ")[0], ""),
            "background": progress.get("phase") == BACKGROUND,
            "state": state,
            "error": result.get("error"),
            "warnings": [one["words"] if isinstance(one, dict) else str(one) for one in warnings],
        }

    @property
    def state(self) -> str:
        """State of the job.

        Returns
        -------
        str
            `RUNNING`, `DONE`, `FAILED`, `CANCELLED`, or `INTERRUPTED` if its process was ended from outside.

        """
        # read before the lock: the process takes the lock first and creates this file after it
        began = (self.folder / "began").exists()
        new = not began and abs(time.time() - self.spec["at"]) < MAX_START_SECONDS
        if not self.result and (new or files.is_held(self.folder / "alive")):
            return RUNNING
        if result := self.result:  # also one that was written after the first look
            return FAILED if "error" in result else DONE
        return CANCELLED if (self.folder / "cancel").exists() else INTERRUPTED

    def cancel(self) -> None:
        """End the job at once; finished steps are kept."""
        with suppress(FileNotFoundError):  # the results were removed
            (self.folder / "cancel").touch()

    def wait(self, seconds: float) -> str:
        """Wait until the job has ended, at most for some time; return its state."""
        until = time.monotonic() + seconds
        while (state := self.state) == RUNNING and time.monotonic() < until:
            time.sleep(POLL_S)
        return state


@dataclass(frozen=True)
class JobSpec:
    """What a job is to do.

    Parameters
    ----------
    do : str
        A change of the study, or "run", "measure", "diagnose", "attempt", "report" or "background".
    arguments : dict
        Arguments of the command.
    expected_revision : int, optional
        Revision of the study for which the command was given; the job fails if the study has changed since.
    author : str
        Author of the change in the study's history.

    """

    do: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    expected_revision: int | None = None
    author: str = "page"


def start(path: Path, output: Path, spec: JobSpec, launch: Callable[[Path], None] | None = None) -> Job:
    """Start a job in a process of its own; another job that it makes useless is cancelled.

    Parameters
    ----------
    path : Path
        Study file.
    output : Path
        Folder of its results.
    spec : JobSpec
        What to do.
    launch : callable, optional
        Starts the process of a job, given the folder of the job; a new process by default.

    Returns
    -------
    Job
        The started job.

    Raises
    ------
    BusyError
        If another job of this study is running that is still of use.

    """
    with files.lock_folder(output):
        folder = files.make_subfolder(files.make_internal_folder(output), "jobs")
        earlier, busy = list_jobs(output), running_job(output)
        if busy is not None:
            if not is_superseded(busy, spec.do, flow.CommandHistory(output).revision):
                raise BusyError(f"{busy.words} is still running; wait until it ends or cancel it")
            busy.cancel()
            busy.wait(MAX_CANCEL_SECONDS)
        taken = [int(one.name) for one in (*folder.iterdir(), *(job.folder for job in earlier)) if one.name.isdecimal()]
        number = max(taken, default=0) + 1
        made = folder / f"{number:04d}"
        made.mkdir(parents=True)
        told = {"do": spec.do, "told": dict(spec.arguments), "seen": spec.expected_revision, "who": spec.author}
        files.replace_text(made / "spec.json", json.dumps(told | {"study": str(path.resolve()), "at": time.time()}))
    (launch or launch_process)(made)
    _remove_old(earlier)
    return Job(made)


def is_superseded(job: Job, do: str, revision: int) -> bool:
    """Whether a running job becomes useless by a new one. Its finished steps are stored and are not lost."""
    old, seen = job.spec["do"], job.spec.get("seen")
    if job.summary["background"] or old in ("attempt", "background") or old == do in REPEATED:
        return True
    if do in CHAINED and old in CHAINED:
        return seen is not None and revision > seen
    if do in MODEL_CHANGES:
        return old in ("diagnose", "report", "fit", "run") or (old in CHAINED and seen is not None and revision > seen)
    return False


def list_jobs(output: Path) -> list[Job]:
    """List all jobs of a study.

    Parameters
    ----------
    output : Path
        Folder of the results.

    Returns
    -------
    list of Job
        The jobs, oldest first.

    """
    folders = sorted((output / files.INTERNAL_FOLDER / "jobs").glob("[0-9]*"))
    return [Job(one) for one in folders if one.name.isdecimal() and (one / "spec.json").exists()]


def running_job(output: Path) -> Job | None:
    """The running job of a study, if there is one."""
    return next((job for job in reversed(list_jobs(output)) if job.state == RUNNING), None)


def _remove_old(earlier: Sequence[Job]) -> None:
    """Remove the oldest jobs; a folder that cannot be removed stays."""
    for job in earlier[:-MAX_JOBS_KEPT]:
        if job.state != RUNNING:
            shutil.rmtree(job.folder, ignore_errors=True)


def _read_json(path: Path, *keys: str) -> dict[str, Any]:
    """Read a JSON object that contains at least the given keys."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict) or not found.keys() >= set(keys):
        raise FrictrackError(f"{path} is damaged; delete its folder (it holds no results)")
    return found


# --- following jobs


@dataclass(frozen=True)
class JobsNow:
    """The running job and the one that ended last, as the page shows them; see `Job.summary`."""

    running: dict[str, Any] | None = None
    last: dict[str, Any] | None = None


class JobFollower:
    """Find the running and the last ended job; one that ended before the server started counts only if interrupted."""

    def __init__(self) -> None:
        self._began = time.time()
        self._ended: set[Path] = set()
        self._output: Path | None = None
        self._last: dict[str, Any] | None = None

    def look(self, output: Path) -> JobsNow:
        """Look at the jobs as they are now."""
        if output != self._output:
            self._output, self._ended, self._last = output, set(), None
        running = None
        for job in list_jobs(output):
            if job.folder in self._ended:
                continue
            try:
                found = job.summary
            except (FrictrackError, OSError, KeyError):  # damaged, or removed meanwhile
                self._ended.add(job.folder)
                continue
            if found["state"] == RUNNING:
                running = found
            else:
                self._ended.add(job.folder)
                self._last = found if found["state"] == INTERRUPTED or self._is_new(job) else None
        return JobsNow(running, self._last)

    def _is_new(self, job: Job) -> bool:
        """Whether a job ended since the server started."""
        times = []
        for file in ("result.json", "cancel"):
            with suppress(OSError):
                times.append((job.folder / file).stat().st_mtime)
        return max(times, default=-math.inf) >= self._began


# --- the processes

PREPARE_S = 2.0  # from the start of the server, or of a job, to the next process that waits
COMMAND = (sys.executable, "-P", "-m", "frictrack.workbench.job_process")  # -P: import nothing from this folder


def launch_process(folder: Path) -> None:
    """Start a new process for a job."""
    with (folder / "output.txt").open("wb") as output:
        _start_process(str(folder), subprocess.DEVNULL, output)


def _start_process(argument: str, source: int, output: Any) -> subprocess.Popen[bytes]:
    """Start a process; its exit status is collected in a thread, so that no zombie process remains."""
    process = subprocess.Popen([*COMMAND, argument], stdin=source, stdout=output, stderr=output, start_new_session=True)
    Thread(target=process.wait, daemon=True).start()
    return process


class WarmLauncher:
    """Start jobs in a process that waits with its imports done.

    The process ends by itself when the server does, even if that is killed: its standard input ends.
    """

    def __init__(self) -> None:
        self._spare: subprocess.Popen[bytes] | None = None
        self._lock = Lock()
        self._closed, self._used = False, time.monotonic()

    @property
    def is_needed(self) -> bool:
        """Whether no process waits. After a start there is a pause: the page or the job needs the processor."""
        return self._spare is None and not self._closed and time.monotonic() - self._used >= PREPARE_S

    def prepare(self) -> None:
        """Start the process that waits, unless there is one."""
        with self._lock:
            if self._closed or (self._spare is not None and self._spare.poll() is None):
                return
            if self._spare is not None and self._spare.stdin is not None:
                self._spare.stdin.close()
            self._spare = _start_process("--wait", subprocess.PIPE, subprocess.DEVNULL)

    def launch(self, folder: Path) -> None:
        """Give a job to the process that waits; without one, start a new process."""
        with self._lock:
            spare, self._spare, self._used = self._spare, None, time.monotonic()
        if spare is None or not _write_line(spare, json.dumps(str(folder))):
            launch_process(folder)

    def close(self) -> None:
        """End the input of the process that waits, and so the process."""
        with self._lock:
            spare, self._spare, self._closed = self._spare, None, True
        if spare is not None and spare.stdin is not None:
            spare.stdin.close()


def _write_line(process: subprocess.Popen[bytes], line: str) -> bool:
    """Write a line to a process; return whether it is still there to read it."""
    assert process.stdin is not None
    try:
        with process.stdin as pipe:
            pipe.write(f"{line}\n".encode())
    except OSError:
        return False
    return process.poll() is None
