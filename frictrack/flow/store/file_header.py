"""Write and check the file header: the checksum of the whole file, and the signature of the user who wrote it.

Damage must be known before HDF5 opens a file: on one flipped byte in a heap of strings its library may crash or never
return. This checksum also finds a flipped bit in the structure between the data, which nothing else would find.

The signature is an HMAC under the user's secret. HDF5 may crash on malicious bytes, and a checksum does not tell who
wrote them. A separate process therefore opens files without this user's signature first; see `integrity`.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import BinaryIO

from platformdirs import user_data_path

from frictrack.base.errors import FrictrackError
from frictrack.base.files import atomic_write

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
