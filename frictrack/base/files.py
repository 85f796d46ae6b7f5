"""Write files atomically, lock folders, and hash what is in files.

A gigabyte takes about half a second. The hash of a large file is therefore kept in the user's cache folder with the
state of the file (size, times of modification and change, inode), and is valid while that state remains. A file system
that damages a byte leaves the state as it is: `frictrack verify` reads every file again.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from io import RawIOBase
from pathlib import Path
from typing import Any

import psutil
from filelock import FileLock, Timeout
from platformdirs import user_cache_path

from frictrack.base.errors import FrictrackError, UsageError, os_errors_as

MAX_NAME_LENGTH = 100  # characters; a word and a suffix are appended
_NAME = re.compile(r"[^\W_](?:[\w .,+=()#-]*[\w)+])?")
_RESERVED = re.compile(r"(?:con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])(?:\..*)?", re.IGNORECASE)  # Windows's own
_HOST = re.sub(r"\W", "", platform.node()) or "here"
_TEMPORARY = re.compile(r"\..+_([^\W_]\w*)-(\d+)_[^.]+\.part(?:\.\w+)?")  # of `atomic_write`
DAY_S = 86400.0
INTERNAL_FOLDER = ".frictrack"  # in a folder of results: what only frictrack reads
LOCK_TIMEOUT_S = 60.0  # that a writer waits for another one; each takes a fraction of a second


def is_file_name(name: str) -> bool:
    """Return whether a name can be a file name on every operating system, and cannot lead out of the folder.

    Examples
    --------
    >>> is_file_name("run 3"), is_file_name("../run"), is_file_name("nul")
    (True, False, False)

    """
    fits = len(name.encode(errors="replace")) <= 2 * MAX_NAME_LENGTH and len(name) <= MAX_NAME_LENGTH
    return fits and _NAME.fullmatch(name) is not None and not _RESERVED.fullmatch(name)


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock a folder of results for a short change; the block may be nested. Readers never wait.

    Temporary files of writers that were killed are removed first.

    Parameters
    ----------
    folder
        The folder; it is created if it does not exist.

    Raises
    ------
    FrictrackError
        If the folder cannot be written, or another process does not release it within `LOCK_TIMEOUT_S`.

    """
    inside = make_internal_folder(folder)
    try:
        lock = FileLock(inside / "lock", timeout=LOCK_TIMEOUT_S, is_singleton=True)
        lock.acquire()
    except Timeout as e:
        raise FrictrackError(f"another frictrack holds {folder}; wait for it or stop it") from e
    except OSError as e:
        raise FrictrackError(f"cannot write results into {folder}: {e.strerror or e}") from e
    try:
        if lock.lock_counter == 1:
            _remove_leftovers(folder, inside / "lock")
        yield
    finally:
        lock.release()


@contextmanager
def lock_work(folder: Path, waits: Callable[[], None]) -> Iterator[None]:
    """Lock a folder of results for a long computation; the block may be nested. Readers and short changes do not wait.

    Parameters
    ----------
    folder
        The folder.
    waits
        Called once if another process has the lock.

    """
    lock = FileLock(folder / INTERNAL_FOLDER / "work", is_singleton=True)
    with suppress(OSError, FrictrackError):  # a folder that cannot be written is reported when something is written
        make_internal_folder(folder)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            waits()
            lock.acquire(timeout=-1)
    try:
        yield
    finally:
        lock.release()


def is_busy(folder: Path) -> bool:
    """Return whether another process is writing into a folder of results, or computing for it."""
    return any(is_held(folder / INTERNAL_FOLDER / name) for name in ("lock", "work"))


def make_internal_folder(folder: Path) -> Path:
    """Create the hidden folder in a folder of results, for locks, logs and jobs; return its path.

    Parameters
    ----------
    folder
        The folder of results; it is created if it does not exist.

    Raises
    ------
    FrictrackError
        If it cannot be created, or there is a link of its name.

    """
    return make_subfolder(folder, INTERNAL_FOLDER)


def is_held(path: Path) -> bool:
    """Return whether another process holds the lock of a file."""
    if not path.exists():
        return False
    lock = FileLock(path, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        return True
    except OSError:
        return False  # a lock file without write permission
    lock.release()
    return False


def make_subfolder(folder: Path, name: str) -> Path:
    """Create a folder inside a folder of results; return its path.

    Parameters
    ----------
    folder, name
        The folder of results, and the name of the new folder, which may exist.

    Raises
    ------
    FrictrackError
        If it cannot be created, or there is a link of that name.

    """
    path = folder / name
    if path.is_symlink():
        raise FrictrackError(f"expected a folder {path} but it is a link to another place; remove the link")
    with os_errors_as(f"cannot write results into {path}"):
        path.mkdir(parents=True, exist_ok=True)
    return path


@contextmanager
def atomic_write(path: Path, mode: int = 0o644) -> Iterator[Path]:
    """Yield a temporary file that replaces `path` if the block succeeds; a power cut leaves the old or the new file.

    Parameters
    ----------
    path
        The file to be replaced or created.
    mode
        Its permissions.

    Yields
    ------
    Path
        The temporary file.

    Raises
    ------
    FrictrackError
        If it cannot be written; the old file is left unchanged.

    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        start = f".{path.stem}_{_HOST}-{os.getpid()}_"
        handle, name = tempfile.mkstemp(prefix=start, suffix=f".part{path.suffix}", dir=path.parent)
    except OSError as e:
        raise FrictrackError(f"cannot write into {path.parent}: {e.strerror}") from e
    os.close(handle)
    part = Path(name)
    try:
        _remove_leftovers(path.parent, part)
        yield part
        _commit(part, path, mode)
    except OSError as e:
        raise FrictrackError(f"cannot write {path}: {e.strerror or e}; the old file is unchanged") from e
    finally:
        with suppress(FileNotFoundError):
            part.unlink()


def _remove_leftovers(folder: Path, mine: Path) -> None:
    """Remove temporary files of writers that were killed: those of this host, and of others a day older than `mine`."""
    for part in folder.glob(".*.part*"):
        found = _TEMPORARY.fullmatch(part.name)
        if found is None or part == mine:
            continue
        with suppress(OSError):  # times of one file system: the clock of this machine may jump
            old = mine.stat().st_mtime - part.stat().st_mtime > DAY_S
            if old if found[1] != _HOST else not psutil.pid_exists(int(found[2])):
                part.unlink()


def _commit(part: Path, path: Path, mode: int) -> None:
    part.chmod(mode)
    with part.open("rb") as f:
        os.fsync(f.fileno())
    part.replace(path)
    with suppress(OSError):  # some systems cannot open a folder
        folder = os.open(path.parent, os.O_RDONLY)
        os.fsync(folder)
        os.close(folder)


def write_at(file: RawIOBase, start: int, content: Any) -> None:
    """Write all bytes at a position of an unbuffered file, which alone would leave the rest out on a full disk.

    Parameters
    ----------
    file
        The file.
    start
        Position of the first byte.
    content
        The bytes, or an array.

    Raises
    ------
    OSError
        If not all can be written.

    """
    file.seek(start)
    rest = memoryview(content).cast("B")
    while rest:
        rest = rest[file.write(rest) or 0 :]


def append_line(path: Path, line: str) -> None:
    """Append a line to a log, safe on the disk when this returns; what a power cut left of a line is cut off."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab+") as file:
        if file.seek(0, os.SEEK_END):
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                file.seek(0)
                file.truncate(file.read().rfind(b"\n") + 1)
        file.write(line.encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def read_small_text(path: Path, max_bytes: int, what: str) -> str:
    """Return the text of a small file that a user named, `what` it should be; raise `UsageError` if it is no such."""
    try:
        if (size := path.stat().st_size) > max_bytes:
            most = f"{path.name}: expected {what} of at most {max_bytes >> 10} kB"
            raise UsageError(f"{most} but got {size / 1e3:.0f} kB")
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as e:
        raise UsageError(f"{path.name} is not a text in UTF-8 (byte {e.start}); save it as UTF-8") from e
    except OSError as e:
        raise UsageError(f"expected {what} {path} but cannot read it ({e.strerror})") from e


def replace_text(path: Path, text: str) -> Path:
    """Write a text in UTF-8 as a whole, with its line ends as they are; return the path.

    Parameters
    ----------
    path
        The file.
    text
        Its new content.

    Raises
    ------
    FrictrackError
        If it cannot be written; the old file is left unchanged.

    """
    with atomic_write(path) as part:
        part.write_bytes(text.encode())
    return path


CACHE_VARIABLE = "FRICTRACK_CACHE"  # environment: the user's folder for fetched recordings and kept hashes
MIN_BYTES_KEPT = 16 << 20  # smaller files are hashed in milliseconds
MIN_AGE_S = 2.0  # of a file's last change: within the resolution of a clock, it may change again without a trace


def hash_file(path: Path, *, reread: bool = False) -> str:
    """Return the SHA-256 of all bytes of a file.

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
