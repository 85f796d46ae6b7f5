"""The seal of a file: its checksum stands in the 512 bytes before the HDF5 part, which HDF5 leaves to us.

A damaged file must be known as such before HDF5 looks into it: on one flipped byte in a heap of strings its library
may crash or never return. The seal also finds a flip where nothing else would, in the structure between the data.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

SCHEMA = 2  # of the layout; 1 had no checksums
ROOM = 512  # bytes before the HDF5 part
# Where sealed bytes begin. Before that stand the 48 of HDF5's superblock: a viewer that has the file open for editing
# marks it there for as long, and HDF5 guards them by a checksum of its own, which it looks at first.
START = ROOM + 48
_FIRST = re.compile(r"frictrack results, schema (\d+), written by (.+?)(?:, mark ([0-9a-f]{64}))?")
_HDF5 = b"\x89HDF\r\n\x1a\n"


def sealed(hdf5: bytes, version: str, mark: Callable[[memoryview], str] | None = None) -> bytes:
    """A finished HDF5 part as the whole file: before it its checksum, beside schema, what wrote it and whose mark."""
    told = memoryview(hdf5)[START - ROOM :]
    by = mark(told) if mark else ""
    first = f"frictrack results, schema {SCHEMA}, written by {version}" + (f", mark {by}" if by else "")
    digest = hashlib.sha256(f"{first}\n".encode())
    digest.update(told)
    return _room(first, digest.hexdigest()) + hdf5


def head(path: Path) -> tuple[int, str] | None:
    """Schema and version that a seal names; None of a file without a seal: of schema 1, or another program's."""
    told = _FIRST.fullmatch(_first(path))
    return None if told is None else (int(told[1]), told[2])


def marked(path: Path) -> str:
    """The mark that a seal bears; "" of one without."""
    told = _FIRST.fullmatch(_first(path))
    return "" if told is None else told[3] or ""


def content(path: Path) -> bytes:
    """The bytes that a seal is about."""
    with path.open("rb") as file:
        file.seek(START)
        return file.read()


def is_bare(path: Path) -> bool:
    """Whether HDF5 begins with the first byte, as in files without a seal."""
    with path.open("rb") as file:
        return file.read(len(_HDF5)) == _HDF5


def intact(path: Path, *, anew: bool = False) -> bool:
    """Whether a file holds the bytes that were written.

    One that was looked at is not read again as long as it is the same file; `anew` reads it in any case.
    """
    look = _intact.__wrapped__ if anew else _intact
    return look(path, *state(path))


def state(path: Path) -> tuple[int, int, int]:
    """What tells one version of a file from another: its number in the file system, time and size."""
    found = path.stat()
    return found.st_ino, found.st_mtime_ns, found.st_size


@lru_cache(maxsize=4096)
def _intact(path: Path, *_: int) -> bool:
    """The answer for one state of a file."""
    first = _first(path)
    with path.open("rb") as file:
        room = file.read(ROOM)
        file.seek(START)
        digest = hashlib.file_digest(file, lambda: hashlib.sha256(f"{first}\n".encode()))
        return _FIRST.fullmatch(first) is not None and room == _room(first, digest.hexdigest())


def _first(path: Path) -> str:
    """The first line of a file."""
    with path.open("rb") as file:
        return file.read(ROOM).split(b"\n")[0].decode(errors="replace")


def _room(first: str, digest: str) -> bytes:
    """What stands before the HDF5 part of a sound file."""
    return f"{first}\nsha256 of this line and all after byte {START}: {digest}\n".encode().ljust(ROOM - 1) + b"\n"
