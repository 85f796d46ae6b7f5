"""Sign results files, to know which ones this user's frictrack wrote: an HMAC under the user's secret.

HDF5 may crash on malicious bytes, and a checksum does not tell who wrote them. A separate process therefore opens files
without this user's signature first (`frictrack.flow.store.sandbox`).
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from contextlib import suppress
from functools import cache, lru_cache
from pathlib import Path
from typing import BinaryIO

from platformdirs import user_data_path

from frictrack.base.errors import FrictrackError
from frictrack.base.files import atomic_write
from frictrack.flow.store.file_header import file_state, read_signature

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
