"""Write and check the file header: the checksum of the whole file, and the signature of the user who wrote it.

Damage must be known before HDF5 opens a file: on one flipped byte in a heap of strings its library may crash or never
return. This checksum also finds a flipped bit in the structure between the data, which nothing else would find.

The signature is an HMAC under the user's secret. HDF5 may crash on malicious bytes, and a checksum does not tell who
wrote them. A separate process therefore opens files without this user's signature first.
"""

from __future__ import annotations

import atexit
import hashlib
import hmac
import json
import re
import secrets
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache, lru_cache
from pathlib import Path
from threading import Lock, Timer
from typing import Any, BinaryIO

from platformdirs import user_data_path

from frictrack.base.errors import FrictrackError
from frictrack.base.files import atomic_write
from frictrack.base.workers import limit_memory

SCHEMA = 2  # of the layout; 1 had no checksums
HEADER_BYTES = 512  # bytes before the HDF5 part
# First byte that the checksum covers. The 48 bytes before it are HDF5's superblock: a viewer that opens the file for
# editing sets a flag there, and HDF5 protects the superblock by its own checksum.
CHECKSUM_START = HEADER_BYTES + 48
_FIRST_LINE = re.compile(r"frictrack results, schema (\d+), written by (.+?)(?:, mark ([0-9a-f]{64}))?")
_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"


def header_of(hdf5: bytes | memoryview, version: str, sign: Callable[[memoryview], str] | None = None) -> bytes:
    """Return the header of a finished HDF5 part."""
    checked = memoryview(hdf5)[CHECKSUM_START - HEADER_BYTES :]
    signature = sign(checked) if sign else ""
    first = f"frictrack results, schema {SCHEMA}, written by {version}" + (f", mark {signature}" if signature else "")
    digest = hashlib.sha256(f"{first}\n".encode())
    digest.update(checked)
    return _header_bytes(first, digest.hexdigest())


def read_header(path: Path) -> tuple[int, str] | None:
    """Return schema and frictrack version of a file; None without a header (schema 1, or another program)."""
    with path.open("rb") as file:
        match = _FIRST_LINE.fullmatch(_first_line_of(file.read(HEADER_BYTES)))
    return None if match is None else (int(match[1]), match[2])


def read_signature(file: BinaryIO) -> str:
    """Return the signature of a file, empty if there is none, and move on to the bytes that it signs."""
    match = _FIRST_LINE.fullmatch(_first_line_of(file.read(HEADER_BYTES)))
    file.seek(CHECKSUM_START)
    return "" if match is None else match[3] or ""


def lacks_header(path: Path) -> bool:
    """Return whether HDF5 starts at the first byte, as in files without a header."""
    with path.open("rb") as file:
        return file.read(len(_HDF5_MAGIC)) == _HDF5_MAGIC


def is_intact(path: Path, *, reread: bool = False) -> bool:
    """Return whether a file holds the bytes that were written."""
    check = _is_intact.__wrapped__ if reread else _is_intact
    return check(path, *file_state(path))


def file_state(path: Path) -> tuple[int, int, int]:
    """Return what identifies one version of a file: inode, modification time in ns, size in bytes."""
    found = path.stat()
    return found.st_ino, found.st_mtime_ns, found.st_size


@lru_cache(maxsize=4096)
def _is_intact(path: Path, *_: int) -> bool:
    """Check one state of a file. It is opened once: between two calls of `open`, another version may replace it."""
    with path.open("rb") as file:
        room = file.read(HEADER_BYTES)
        first = _first_line_of(room)
        file.seek(CHECKSUM_START)
        digest = hashlib.file_digest(file, lambda: hashlib.sha256(f"{first}\n".encode()))
        return _FIRST_LINE.fullmatch(first) is not None and room == _header_bytes(first, digest.hexdigest())


def _first_line_of(header: bytes) -> str:
    return header.split(b"\n")[0].decode(errors="replace")


def _header_bytes(first: str, digest: str) -> bytes:
    """Return the header of an intact file."""
    text = f"{first}\nsha256 of this line and all after byte {CHECKSUM_START}: {digest}\n"
    return text.encode().ljust(HEADER_BYTES - 1) + b"\n"


_BYTES = 32


def sign(checked: bytes | memoryview | BinaryIO) -> str:
    """Return the signature of the bytes of a file from `CHECKSUM_START` on; empty if the secret cannot be stored.

    References
    ----------
    Krawczyk, Bellare & Canetti (1997), RFC 2104 (HMAC), here with SHA-256.

    """
    secret = _secret()
    made = hmac.new(secret, digestmod="sha256")
    if isinstance(checked, bytes | memoryview):
        made.update(checked)
    else:
        hashlib.file_digest(checked, lambda: made)  # type: ignore[arg-type] # an HMAC is no hash in types
    return made.hexdigest() if secret else ""


def is_signed_by_user(path: Path) -> bool:
    """Return whether a file bears this user's signature."""
    return _is_signed_by_user(path, *file_state(path))


@lru_cache(maxsize=4096)
def _is_signed_by_user(path: Path, *_: int) -> bool:
    """Check one state of a file."""
    with path.open("rb") as file:
        signature = read_signature(file)
        return signature != "" and hmac.compare_digest(signature, sign(file))


@cache
def _secret() -> bytes:
    """Return the user's secret, created when first needed; empty if it cannot be stored."""
    path = user_data_path("frictrack", appauthor=False) / "mark"
    with suppress(OSError, FrictrackError):
        if not path.exists() or path.stat().st_size != _BYTES:
            with atomic_write(path, mode=0o600) as part:
                part.write_bytes(secrets.token_bytes(_BYTES))
        return path.read_bytes()
    return b""


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
    """Check files for the parent process: paths in lines on stdin, faults in lines on stdout, until stdin closes."""
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
