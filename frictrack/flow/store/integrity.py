"""Write and check the header of a results file, and find the faults of what is inside."""

from __future__ import annotations

import hashlib
import hmac
import io
import json
import re
import secrets
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import h5py
from platformdirs import user_data_path

from frictrack.base.errors import FrictrackError
from frictrack.base.files import atomic_write
from frictrack.base.workers import limit_memory
from frictrack.flow.store.encoding import members, read_array

SCHEMA = 3  # of the layout; 1 had no checksums, 2 also one in each group
HEADER_BYTES = 512  # bytes before the HDF5 part
# First byte that the checksum covers. The 48 bytes before it are HDF5's superblock: a viewer that opens the file for
# editing sets a flag there, and HDF5 protects the superblock by its own checksum.
CHECKSUM_START = HEADER_BYTES + 48
_FIRST_LINE = re.compile(r"frictrack results, schema (\d+), written by (.+?)(?:, mark ([0-9a-f]{64}))?")
_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_SECRET_BYTES = 32


@dataclass(frozen=True)
class FileHeader:
    """What the header of a file says, and whether it is true."""

    schema: int
    version: str  # of frictrack that wrote it; "" where HDF5 begins at the first byte: schema 1, or another program
    is_intact: bool  # whether the file holds the bytes that were written
    is_signed: bool  # whether this user wrote it


def header_of(hdf5: bytes | memoryview, version: str, sign: Callable[[memoryview], str] | None = None) -> bytes:
    """Return the header of a finished HDF5 part."""
    checked = memoryview(hdf5)[CHECKSUM_START - HEADER_BYTES :]
    signature = sign(checked) if sign else ""
    first = f"frictrack results, schema {SCHEMA}, written by {version}" + (f", mark {signature}" if signature else "")
    digest = hashlib.sha256(f"{first}\n".encode())
    digest.update(checked)
    return _header_bytes(first, digest.hexdigest())


def read_header(path: Path, *, reread: bool = False) -> FileHeader:
    """Read the header of a file and compare it with all bytes; one state of a file is compared once."""
    read = _read_header.__wrapped__ if reread else _read_header
    return read(path, *file_state(path))


def file_state(path: Path) -> tuple[int, int, int]:
    """Return what identifies one version of a file: inode, modification time in ns, size in bytes."""
    found = path.stat()
    return found.st_ino, found.st_mtime_ns, found.st_size


@lru_cache(maxsize=4096)
def _read_header(path: Path, *_: int) -> FileHeader:
    """Read the header of one state of a file, opened once: between two calls of `open`, another may replace it."""
    with path.open("rb") as file:
        written = file.read(HEADER_BYTES)
        first = written.split(b"\n")[0].decode(errors="replace")
        said = _FIRST_LINE.fullmatch(first)
        if said is None:
            return FileHeader(1, "", written.startswith(_HDF5_MAGIC), False)
        file.seek(CHECKSUM_START)
        digest = hashlib.file_digest(file, lambda: hashlib.sha256(f"{first}\n".encode()))
        file.seek(CHECKSUM_START)
        is_signed = said[3] is not None and hmac.compare_digest(said[3], sign(file))
    return FileHeader(int(said[1]), said[2], written == _header_bytes(first, digest.hexdigest()), is_signed)


def _header_bytes(first: str, digest: str) -> bytes:
    """Return the header of an intact file."""
    text = f"{first}\nsha256 of this line and all after byte {CHECKSUM_START}: {digest}\n"
    return text.encode().ljust(HEADER_BYTES - 1) + b"\n"


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


@cache
def _secret() -> bytes:
    """Return the user's secret, created when first needed; empty if it cannot be stored."""
    path = user_data_path("frictrack", appauthor=False) / "mark"
    with suppress(OSError, FrictrackError):
        if not path.exists() or path.stat().st_size != _SECRET_BYTES:
            with atomic_write(path, mode=0o600) as part:
                part.write_bytes(secrets.token_bytes(_SECRET_BYTES))
        return path.read_bytes()
    return b""


START_TIMEOUT_S = 60.0  # for the process to start, beside whatever else the machine does
MIN_TIMEOUT_S = 5.0  # for one file, and one second more for every `BYTES_PER_EXTRA_SECOND`
BYTES_PER_EXTRA_SECOND = 2e6
MAX_MEMORY_BYTES = 2 << 30  # of the separate process
MAX_FILES_TOGETHER = 32  # that one process checks
_CHILD = "from frictrack.flow.store.integrity import run_check_process; run_check_process()"
Found = tuple[str, str, str] | None
"""What is wrong, what to do and the kind of the fault; None if nothing is wrong."""
_CHECKED: dict[tuple[Path, tuple[int, int, int]], Found] = {}  # by file and its state


@dataclass(frozen=True)
class Fault:
    """One fault: what is wrong, where, and what to do."""

    file: Path
    group: str  # "/motion/x"; "" where it is the file
    what: str
    do: str
    kind: str = "damage"  # or "foreign", "changed", "outdated", "missing", "leftover"

    @property
    def words(self) -> str:
        """The fault in one line."""
        return f"{', '.join(filter(None, (str(self.file), self.group)))}: {self.what}; {self.do}"


REMEDY = "delete it and run again, the recordings are untouched"


_HDF5_FAILS = ("HDF5 itself fails on it: it is damaged, or made to do harm", REMEDY, "damage")


def fault_inside(path: Path) -> Fault | None:
    """Find what is wrong inside a file whose header was checked."""
    found = _inside(path) if read_header(path).is_signed else _found_in_sandbox(path)
    return Fault(path, "", *found) if found else None


def opens_safely(path: Path) -> bool:
    """Return whether this user wrote a file, or HDF5 can read all of it in a separate process."""
    return read_header(path).is_signed or (fault := fault_inside(path)) is None or fault.kind == "foreign"


def _inside(path: Path, *, untrusted: bool = False) -> Found:
    """Find what is wrong inside a file; all of an untrusted one is read, and copied as when it is written to."""
    try:
        with h5py.File(path, "r", locking=False) as file:
            if "schema" not in file.attrs:
                return "another program wrote it", "move it away", "foreign"
            if untrusted:
                _read_all(file, set())
                with h5py.File(io.BytesIO(), "w") as new:
                    copy_groups(file, new)
            return None
    except Exception as e:  # noqa: BLE001 - h5py raises any exception on a damaged file
        return f"is damaged or is not HDF5 ({' '.join(str(e).split())})", REMEDY, "damage"


def _read_all(group: h5py.Group, met: set[int]) -> None:
    """Read everything in a group; `met` are the addresses of groups that were read."""
    address = h5py.h5o.get_info(group.id).addr
    if address in met:  # groups inside themselves or each other would never end
        raise ValueError(f"expected every group in one place but {group.name} is in several")
    met.add(address)
    dict(group.attrs)
    for _, item in members(group):
        if isinstance(item, h5py.Group):
            _read_all(item, met)
        else:
            read_array(item)
            dict(item.attrs)


def copy_groups(old: h5py.File, new: h5py.File) -> None:
    """Copy all groups of a file into another one; links stay links."""
    new.attrs.update(old.attrs)
    for name in old:
        link = old.get(name, getlink=True)
        if isinstance(link, h5py.ExternalLink | h5py.SoftLink):
            new[name] = link
        else:
            old.copy(name, new)


def _found_in_sandbox(path: Path) -> Found:
    """Return what the separate process finds wrong in a file, also if it crashes or exceeds its time.

    One process checks many files of the folder that are still to be checked, since they are opened together.
    """
    key = path, file_state(path)
    if key not in _CHECKED:
        keys = [key, *islice(_other_keys(path), MAX_FILES_TOGETHER - 1)]
        found = _run_check_process([one for one, _ in keys])  # it ended at the file after the last of these
        _CHECKED.update(zip(keys, [*found, _HDF5_FAILS], strict=False))
    return _CHECKED[key]


def _other_keys(path: Path) -> Iterator[tuple[Path, tuple[int, int, int]]]:
    """Yield the other files of a folder, and their states, that the separate process has to check."""
    for other in sorted(path.parent.glob("[!.]*.h5")):
        with suppress(OSError):  # it is gone, or cannot be read
            key, header = (other, file_state(other)), read_header(other)
            if other != path and key not in _CHECKED and header.is_intact and not header.is_signed:
                yield key


def _run_check_process(paths: Sequence[Path]) -> list[Any]:
    """Return what is wrong in files in their order, in those before the first one that the process fails on."""
    asked = "".join(f"{json.dumps(str(path.absolute()))}\n" for path in paths).encode()
    call, timeout = [sys.executable, "-P", "-c", _CHILD], START_TIMEOUT_S + sum(map(_timeout, paths))
    try:
        said = subprocess.run(call, input=asked, timeout=timeout, check=False, capture_output=True).stdout
    except subprocess.TimeoutExpired as e:
        said = e.stdout or b""
    first, *lines = said.split(b"\n")
    if first != b"ready":
        raise FrictrackError(
            f"expected to open a file of another user in a separate process, but {sys.executable} starts none"
        )
    return [json.loads(line) for line in lines[:-1]]


def _timeout(path: Path) -> float:
    """Return the time that the check of a file may take, s."""
    return MIN_TIMEOUT_S + path.stat().st_size / BYTES_PER_EXTRA_SECOND


def run_check_process() -> None:
    """Check files for the parent process: paths in lines on stdin, what is wrong in each in a line on stdout."""
    limit_memory(MAX_MEMORY_BYTES)
    _say("ready")
    for line in sys.stdin:
        path = Path(json.loads(line))
        if hasattr(signal, "setitimer"):  # not on Windows; SIGALRM ends a process also within HDF5, and without parent
            signal.setitimer(signal.ITIMER_REAL, _timeout(path))
        _say(json.dumps(_inside(path, untrusted=True)))


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
