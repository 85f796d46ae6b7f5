"""Which files this user's frictrack wrote itself: they bear a mark that only who knows the user's secret can make.

HDF5 fails on bytes made to do harm, and a checksum does not tell who wrote them. Files without the mark, of colleagues
too, are first opened by a process of its own (`frictrack.store.apart`).
"""

from __future__ import annotations

import hmac
import secrets
from contextlib import suppress
from functools import cache, lru_cache
from pathlib import Path

from platformdirs import user_data_path

from frictrack.errors import FrictrackError
from frictrack.files import replaced
from frictrack.store.seal import content, marked, state

_BYTES = 32
_Buffer = bytes | memoryview


def mark(told: _Buffer) -> str:
    """The mark of this user for what stands in a file after byte `START` (HMAC-SHA256, RFC 2104); "" without a home."""
    secret = _secret()
    return hmac.new(secret, told, "sha256").hexdigest() if secret else ""


def is_ours(path: Path) -> bool:
    """Whether a file bears our mark."""
    return _is_ours(path, *state(path))


@lru_cache(maxsize=4096)
def _is_ours(path: Path, *_: int) -> bool:
    """The answer for one state of a file."""
    told = marked(path)
    return told != "" and hmac.compare_digest(told, mark(content(path)))


@cache
def _secret() -> bytes:
    """The user's secret, made when first asked for; empty where there is no place to keep it."""
    path = user_data_path("frictrack", appauthor=False) / "mark"
    with suppress(OSError, FrictrackError):
        if not path.exists() or path.stat().st_size != _BYTES:
            with replaced(path, mode=0o600) as part:
                part.write_bytes(secrets.token_bytes(_BYTES))
        return path.read_bytes()
    return b""
