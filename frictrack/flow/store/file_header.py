"""Write and check the file header: the checksum of the whole file, in the 512 bytes before the HDF5 part.

Damage must be known before HDF5 opens a file: on one flipped byte in a heap of strings its library may crash or never
return. This checksum also finds a flipped bit in the structure between the data, which nothing else would find.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

SCHEMA = 2  # of the layout; 1 had no checksums
HEADER_BYTES = 512  # bytes before the HDF5 part
# First byte that the checksum covers. The 48 bytes before it are HDF5's superblock: a viewer that opens the file for
# editing sets a flag there, and HDF5 protects the superblock by its own checksum.
CHECKSUM_START = HEADER_BYTES + 48
_FIRST_LINE = re.compile(r"frictrack results, schema (\d+), written by (.+?)(?:, mark ([0-9a-f]{64}))?")
_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"


def header_of(hdf5: bytes | memoryview, version: str, sign: Callable[[memoryview], str] | None = None) -> bytes:
    """Return the header of a finished HDF5 part.

    Parameters
    ----------
    hdf5
        What follows the header in the file.
    version
        Version of frictrack that writes it.
    sign
        Returns the signature of the checked bytes, or "" for none.

    """
    checked = memoryview(hdf5)[CHECKSUM_START - HEADER_BYTES :]
    signature = sign(checked) if sign else ""
    first = f"frictrack results, schema {SCHEMA}, written by {version}" + (f", mark {signature}" if signature else "")
    digest = hashlib.sha256(f"{first}\n".encode())
    digest.update(checked)
    return _header_bytes(first, digest.hexdigest())


def read_header(path: Path) -> tuple[int, str] | None:
    """Return schema and frictrack version of a file; None without a header (schema 1, or another program)."""
    match = _FIRST_LINE.fullmatch(_first_line(path))
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
    """Return whether a file holds the bytes that were written.

    Parameters
    ----------
    path
        The file. A state of it that was checked before is not read again.
    reread
        Read it in any case.

    """
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


def _first_line(path: Path) -> str:
    """Return the first line of a file."""
    with path.open("rb") as file:
        return _first_line_of(file.read(HEADER_BYTES))


def _first_line_of(header: bytes) -> str:
    return header.split(b"\n")[0].decode(errors="replace")


def _header_bytes(first: str, digest: str) -> bytes:
    """Return the header of an intact file."""
    return (
        f"{first}\nsha256 of this line and all after byte {CHECKSUM_START}: {digest}\n".encode().ljust(HEADER_BYTES - 1)
        + b"\n"
    )
