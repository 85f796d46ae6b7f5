"""Open files of other users in a separate process first: on malicious bytes HDF5 may crash or never return."""

from __future__ import annotations

import atexit
import json
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from threading import Lock, Timer
from typing import Any

from frictrack.base.errors import FrictrackError
from frictrack.base.workers import limit_memory
from frictrack.flow.store.file_header import file_state

MIN_TIMEOUT_S = 5.0  # for one file, and one second more for every `BYTES_PER_EXTRA_SECOND`
BYTES_PER_EXTRA_SECOND = 2e6
MAX_MEMORY_BYTES = 2 << 30  # for checking files
READY = "ready\n"  # the first line of that process
_CHILD = "from frictrack.flow.store.integrity import run_check_process; run_check_process()"


class _Sandbox:
    """A process that checks files. It starts when it is first needed, and again after a file has crashed it."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[str] | None = None
        self._lock = Lock()

    def ask(self, path: Path) -> Any:
        """Return the faults that the process finds in a file, as JSON; None if it crashes or exceeds its time.

        Raises `FrictrackError` if the process cannot be started.
        """
        with self._lock:
            child = self._child or self._start()
            timer = Timer(_timeout(path), child.kill)
            timer.start()
            try:
                print(json.dumps(str(path.absolute())), file=child.stdin, flush=True)
                return json.loads(child.stdout.readline() if child.stdout else "")
            except (OSError, ValueError):  # the pipe is broken, or ended within a line
                self._stop()
                return None
            finally:
                timer.cancel()

    def _start(self) -> subprocess.Popen[str]:
        pipe, call = subprocess.PIPE, [sys.executable, "-P", "-c", _CHILD]
        self._child = child = subprocess.Popen(call, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True)
        atexit.register(self._stop)
        if child.stdout is None or child.stdout.readline() != READY:
            self._stop()
            raise FrictrackError(
                f"expected to open a file of another user in a separate process, but {sys.executable} starts none"
            )
        return child

    def _stop(self) -> None:
        atexit.unregister(self._stop)
        if self._child is not None:
            self._child.kill()
            with suppress(OSError):
                self._child.communicate()
        self._child = None


_SANDBOX = _Sandbox()


def check_in_sandbox(path: Path) -> Any:
    """Return the faults of a file as JSON, found in a separate process; None if HDF5 fails on the file."""
    return _SANDBOX.ask(path)


def opens_in_sandbox(path: Path) -> bool:
    """Return whether HDF5 can read a whole file without damage. One state of a file is checked once."""
    return _opens_in_sandbox(path, *file_state(path))


@lru_cache(maxsize=4096)
def _opens_in_sandbox(path: Path, *_: int) -> bool:
    """Check one state of a file."""
    found = check_in_sandbox(path)
    return found is not None and all(fault["kind"] != "damage" for fault in found)


def run_sandbox_process(found: Callable[[Path], Any]) -> None:
    """Check files for the parent process: paths in lines on stdin, faults in lines on stdout, until stdin closes.

    Parameters
    ----------
    found
        Returns the faults of a file as an object for JSON.

    """
    limit_memory(MAX_MEMORY_BYTES)
    sys.stdout.write(READY)
    sys.stdout.flush()
    for line in sys.stdin:
        path = Path(json.loads(line))
        _exit_after(2 * _timeout(path))
        sys.stdout.write(json.dumps(found(path)) + "\n")
        sys.stdout.flush()
        _exit_after(0.0)


def _timeout(path: Path) -> float:
    """Return the time that the check of a file may take, s."""
    return MIN_TIMEOUT_S + (path.stat().st_size / BYTES_PER_EXTRA_SECOND if path.exists() else 0.0)


def _exit_after(seconds: float) -> None:
    """End this process after so many seconds, 0 for never: the parent may have been killed meanwhile."""
    if hasattr(signal, "setitimer"):  # not on Windows
        signal.setitimer(signal.ITIMER_REAL, seconds)  # SIGALRM ends a process also within HDF5
