"""HDF5 in a process of its own, for files of others: on bytes made to do harm its library may crash or never return."""

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

from frictrack.errors import FrictrackError
from frictrack.store.seal import state

PATIENCE = 5.0  # s for one file, and a second more for every `PACE` bytes of it
PACE = 2e6
MEMORY = 2 << 30  # bytes that looking at files may take
READY = "ready\n"  # the first line of that process
_CHILD = "from frictrack.store.faults import answer; answer()"


class _Apart:
    """A process that answers what it finds in files; begun when first asked, and again where a file has ended it."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[str] | None = None
        self._lock = Lock()

    def ask(self, path: Path) -> Any:
        """What `frictrack.store.faults.answer` finds in a file; None where it crashes, or has not ended in time.

        Raises `FrictrackError` where such a process cannot be begun.
        """
        with self._lock:
            child = self._child or self._begin()
            late = Timer(_patience(path), child.kill)
            late.start()
            try:
                print(json.dumps(str(path.absolute())), file=child.stdin, flush=True)
                return json.loads(child.stdout.readline() if child.stdout else "")
            except (OSError, ValueError):  # the pipe is broken, or ended within a line
                self._end()
                return None
            finally:
                late.cancel()

    def _begin(self) -> subprocess.Popen[str]:
        pipe, call = subprocess.PIPE, [sys.executable, "-P", "-c", _CHILD]
        self._child = child = subprocess.Popen(call, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True)
        atexit.register(self._end)
        if child.stdout is None or child.stdout.readline() != READY:
            self._end()
            raise FrictrackError(
                f"a file of somebody else is opened by a process of its own, but {sys.executable} begins none"
            )
        return child

    def _end(self) -> None:
        atexit.unregister(self._end)
        if self._child is not None:
            self._child.kill()
            with suppress(OSError):
                self._child.communicate()
        self._child = None


_APART = _Apart()


def asked(path: Path) -> Any:
    """What a process of its own finds in a file, as JSON; None where HDF5 fails on it."""
    return _APART.ask(path)


def is_sound(path: Path) -> bool:
    """Whether HDF5 can go through a whole file, and finds no damage.

    One that was looked at is not asked about again as long as it is the same file.
    """
    return _is_sound(path, *state(path))


@lru_cache(maxsize=4096)
def _is_sound(path: Path, *_: int) -> bool:
    """The answer for one state of a file."""
    found = asked(path)
    return found is not None and all(fault["kind"] != "damage" for fault in found)


def serve(found: Callable[[Path], Any]) -> None:
    """Be that process: a path a line from stdin, what is found in it a line to stdout, until nobody asks any more."""
    _limit()
    sys.stdout.write(READY)
    sys.stdout.flush()
    for line in sys.stdin:
        path = Path(json.loads(line))
        _alarm(2 * _patience(path))
        sys.stdout.write(json.dumps(found(path)) + "\n")
        sys.stdout.flush()
        _alarm(0.0)


def _patience(path: Path) -> float:
    """Seconds that going through a file may take."""
    return PATIENCE + (path.stat().st_size / PACE if path.exists() else 0.0)


def _alarm(seconds: float) -> None:
    """End this very process after so long, 0 for never: who asked may have been killed meanwhile."""
    if hasattr(signal, "setitimer"):  # not on Windows
        signal.setitimer(signal.ITIMER_REAL, seconds)  # SIGALRM ends a process also within HDF5


def _limit() -> None:
    """Take no more memory than looking needs: what HDF5 asks for beyond fails there, and not the machine."""
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ModuleNotFoundError:
        return
    with suppress(OSError, ValueError):
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
