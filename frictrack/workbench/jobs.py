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
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any

from filelock import FileLock, Timeout

from frictrack.errors import FrictrackError
from frictrack.files import INTERNAL_FOLDER, lock_folder, make_internal_folder, make_subfolder, replace_text
from frictrack.study import Study

MAX_START_SECONDS = 20.0  # until the process holds its lock
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
    def progress(self) -> list[dict[str, Any]]:
        """Progress of the job so far.

        Returns
        -------
        list of dict
            Steps ``done`` of ``total`` and the text ``what``, oldest first, without an incomplete last line.

        """
        try:
            lines = (self.folder / "progress.jsonl").read_bytes().split(b"\n")[:-1]
        except FileNotFoundError:
            return []
        return [json.loads(line) for line in lines]

    @property
    def state(self) -> str:
        """State of the job.

        Returns
        -------
        str
            `RUNNING`, `DONE`, `FAILED`, `CANCELLED`, or `INTERRUPTED` if its process was ended from outside.

        """
        if result := self.result:
            return FAILED if "error" in result else DONE
        # read before the lock: the process takes the lock first and creates this file after it
        began = (self.folder / "began").exists()
        if self._is_locked() or (not began and abs(time.time() - self.spec["at"]) < MAX_START_SECONDS):
            return RUNNING
        if result := self.result:  # written after the first check
            return FAILED if "error" in result else DONE
        return CANCELLED if (self.folder / "cancel").exists() else INTERRUPTED

    def _is_locked(self) -> bool:
        if not (self.folder / "alive").exists():
            return False
        lock = FileLock(self.folder / "alive", timeout=0)
        try:
            lock.acquire()
        except Timeout:
            return True
        lock.release()
        return False

    def cancel(self) -> None:
        """End the job at once; finished steps are kept."""
        (self.folder / "cancel").touch()


def start(
    study: Study, do: str, *, expected_revision: int | None = None, author: str = "page", **arguments: Any
) -> Job:
    """Start a job in its own process.

    Parameters
    ----------
    study : Study
        The study.
    do : str
        The command: a change of the study, or "run", "measure", "diagnose", "attempt" or "report".
    expected_revision : int, optional
        Revision of the study for which the command was given; the job fails if the study has changed since.
    author : str
        Author of the change in the study's history.
    **arguments
        Arguments of the command.

    Returns
    -------
    Job
        The started job.

    Raises
    ------
    FrictrackError
        If another job of this study is running.

    """
    with lock_folder(study.output):
        folder = make_subfolder(make_internal_folder(study.output), "jobs")
        earlier = list_jobs(study)
        busy = next((job for job in earlier if job.state == RUNNING), None)
        if busy is not None:
            raise FrictrackError(f"{busy.spec['do']} is still running; wait until it ends or cancel it")
        number = max((int(job.folder.name) for job in earlier), default=0) + 1
        made = folder / f"{number:04d}"
        made.mkdir(parents=True)
        spec = {
            "do": do,
            "told": arguments,
            "study": str(study.path.resolve()),
            "seen": expected_revision,
            "who": author,
            "at": time.time(),
        }
        replace_text(made / "spec.json", json.dumps(spec))
    with (made / "output.txt").open("wb") as output:
        process = subprocess.Popen(
            [
                sys.executable,
                "-P",
                "-m",
                "frictrack.workbench.job_process",
                str(made),
            ],  # -P: import nothing from this folder
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )
    Thread(target=process.wait, daemon=True).start()  # collect the exit status, so that no zombie process remains
    return Job(made)


def list_jobs(study: Study) -> list[Job]:
    """List all jobs of a study.

    Returns
    -------
    list of Job
        The jobs, oldest first.

    """
    homes = (study.output / "jobs", study.output / INTERNAL_FOLDER / "jobs")  # the first: of earlier versions
    folders = (one for home in homes for one in sorted(home.glob("[0-9]*")) if one.name.isdecimal())
    return [Job(one) for one in folders if (one / "spec.json").exists()]


def _read_json(path: Path, *keys: str) -> dict[str, Any]:
    """Read a JSON object that contains at least the given keys."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict) or not found.keys() >= set(keys):
        raise FrictrackError(f"{path} is damaged; delete its folder (it holds no results)")
    return found
