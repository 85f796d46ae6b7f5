"""Start the processes of jobs. One process waits with everything imported, so that a job starts at once."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from threading import Lock, Thread

MODULE = "frictrack.workbench.job_process"
PREPARE_S = 1.0  # from one job to the next process that waits
COMMAND = (sys.executable, "-P", "-m", MODULE)  # -P: import nothing from this folder


def launch_process(folder: Path) -> None:
    """Start a new process for a job.

    Parameters
    ----------
    folder : Path
        Folder of the job.

    """
    with (folder / "output.txt").open("wb") as output:
        process = subprocess.Popen(
            [*COMMAND, str(folder)], stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
        )
    _collect(process)


def _collect(process: subprocess.Popen[bytes]) -> None:
    """Collect the exit status in a thread, so that no zombie process remains."""
    Thread(target=process.wait, daemon=True).start()


class WarmLauncher:
    """Start jobs in a process that waits with its imports done.

    The process ends by itself when the server does, even if that is killed: its standard input ends.
    """

    def __init__(self) -> None:
        self._spare: subprocess.Popen[bytes] | None = None
        self._lock = Lock()
        self._closed, self._used = False, -PREPARE_S

    @property
    def is_needed(self) -> bool:
        """Whether no process waits. After a job was started there is a pause: it needs the processor."""
        return self._spare is None and not self._closed and time.monotonic() - self._used >= PREPARE_S

    def prepare(self) -> None:
        """Start the process that waits, unless there is one."""
        with self._lock:
            if self._closed or (self._spare is not None and self._spare.poll() is None):
                return
            if self._spare is not None and self._spare.stdin is not None:
                self._spare.stdin.close()
            self._spare = subprocess.Popen(
                [*COMMAND, "--wait"],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
            _collect(self._spare)

    def launch(self, folder: Path) -> None:
        """Give a job to the process that waits; without one, start a new process.

        Parameters
        ----------
        folder : Path
            Folder of the job.

        """
        with self._lock:
            spare, self._spare, self._used = self._spare, None, time.monotonic()
        if spare is None or not _write_line(spare, json.dumps(str(folder))):
            launch_process(folder)

    def close(self) -> None:
        """End the process that waits."""
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
