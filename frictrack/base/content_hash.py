"""Hash the content of files: SHA-256 over every byte, as ``sha256sum`` prints it.

A gigabyte takes about half a second. The hash of a large file is therefore kept in the user's cache folder with the
state of the file (size, times of modification and change, inode), and is valid while that state remains. A file system
that damages a byte leaves the state as it is: `frictrack verify` reads every file again.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from platformdirs import user_cache_path

from frictrack.base.errors import FrictrackError
from frictrack.base.files import atomic_write

CACHE_VARIABLE = "FRICTRACK_CACHE"  # environment: the user's folder for fetched recordings and kept hashes
MIN_BYTES_KEPT = 16 << 20  # smaller files are hashed in milliseconds
MIN_AGE_S = 2.0  # of a file's last change: within the resolution of a clock, it may change again without a trace


def hash_file(path: Path, *, reread: bool = False) -> str:
    """Return the SHA-256 of all bytes of a file.

    Parameters
    ----------
    path
        The file.
    reread
        Read it even if the hash of its present state is known.

    Returns
    -------
    str
        64 hexadecimal digits.

    Raises
    ------
    OSError
        If it cannot be read.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "v3.csv"
    >>> _ = path.write_bytes(b"abc")
    >>> hash_file(path)[:8]
    'ba7816bf'

    """
    started = time.time()
    before = path.stat()
    is_kept = before.st_size >= MIN_BYTES_KEPT
    if is_kept and not reread and (known := _known_hash(path, _state(before))):
        return known
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    is_settled = max(before.st_mtime, before.st_ctime) < started - MIN_AGE_S
    if is_kept and is_settled and _state(path.stat()) == _state(before):
        _keep(path, _state(before), found)
    return found


def hash_files(paths: Sequence[Path], *, reread: bool = False) -> str:
    """Return one hash of several files in their order, with their names; of a single file its own.

    Parameters
    ----------
    paths
        The files.
    reread
        See `hash_file`.

    Returns
    -------
    str
        SHA-256 of the lines that ``sha256sum`` prints for the files: hash, two spaces, name.

    Raises
    ------
    OSError
        If one cannot be read.

    """
    if len(paths) == 1:
        return hash_file(paths[0], reread=reread)
    lines = "".join(f"{hash_file(path, reread=reread)}  {path.name}\n" for path in paths)
    return hashlib.sha256(lines.encode()).hexdigest()


def cache_root(own: str = "") -> Path:
    """Return the folder that the environment names for the user's cache, else the folder `own` in that of frictrack."""
    folder = os.environ.get(CACHE_VARIABLE)
    return Path(folder) if folder else user_cache_path("frictrack") / own


def _state(found: os.stat_result) -> list[int]:
    """What changes when the content of a file changes."""
    return [found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino]


def _kept_in(path: Path) -> Path:
    """The file in which the hash of another one is kept."""
    return cache_root() / "hashes" / f"{hashlib.sha256(str(path.absolute()).encode()).hexdigest()[:32]}.json"


def _known_hash(path: Path, state: list[int]) -> str:
    """The kept hash of a state of a file; empty if there is none."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        kept = json.loads(_kept_in(path).read_text(encoding="utf-8"))
        if kept["state"] == state:
            return str(kept["sha256"])
    return ""


def _keep(path: Path, state: list[int], found: str) -> None:
    """Keep the hash of a state of a file; a cache that cannot be written is no fault."""
    with suppress(OSError, FrictrackError):
        kept = _kept_in(path)
        kept.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(kept) as part:
            part.write_text(json.dumps({"file": str(path.absolute()), "state": state, "sha256": found}), "utf-8")
