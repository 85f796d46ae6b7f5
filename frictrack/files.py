"""Files that are replaced whole or not at all, and folders into which one writes at a time."""

from __future__ import annotations

import os
import platform
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
from filelock import FileLock, Timeout

from frictrack.errors import FrictrackError

MAX_NAME_LENGTH = 100  # characters; a word and a suffix stand behind it
_NAME = re.compile(r"[^\W_](?:[\w .,+=()#-]*[\w)+])?")
_RESERVED = re.compile(r"(?:con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])(?:\..*)?", re.IGNORECASE)  # Windows's own
_HOST = re.sub(r"\W", "", platform.node()) or "here"
DAY_S = 86400.0  # s
LOCK_TIMEOUT_S = 60.0  # s that a writer waits for another one; each of them takes a fraction of a second


def is_file_name(name: str) -> bool:
    """Whether files can be called so on every system; a path out of the folder cannot."""
    fits = len(name.encode(errors="replace")) <= 2 * MAX_NAME_LENGTH and len(name) <= MAX_NAME_LENGTH
    return fits and _NAME.fullmatch(name) is not None and not _RESERVED.fullmatch(name)


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Nobody else writes into this folder of results meanwhile; readers never wait. May be entered again inside.

    Raises `FrictrackError` when the folder cannot be written, or another frictrack does not let go of it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / ".lock", timeout=LOCK_TIMEOUT_S, is_singleton=True)
        lock.acquire()
    except Timeout as e:
        raise FrictrackError(f"another frictrack holds {folder}; wait for it or stop it") from e
    except OSError as e:
        raise FrictrackError(f"cannot write results into {folder}: {e.strerror or e}") from e
    try:
        yield
    finally:
        lock.release()


@contextmanager
def lock_work(folder: Path, waits: Callable[[], None]) -> Iterator[None]:
    """Nobody else works on this folder of results meanwhile; says that it `waits` for as long as another one does.

    Readers and short changes do not wait. May be entered again inside.
    """
    lock = FileLock(folder / ".work", is_singleton=True)
    with suppress(OSError):  # where nobody may write, who tries to will say so
        folder.mkdir(parents=True, exist_ok=True)
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
    """Whether somebody is writing into this folder of results just now, or works on what he will write."""
    return any(_is_held(folder / name) for name in (".lock", ".work"))


def _is_held(path: Path) -> bool:
    if not path.exists():
        return False
    lock = FileLock(path, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        return True
    except OSError:
        return False  # one that nobody may write
    lock.release()
    return False


def make_subfolder(folder: Path, name: str) -> Path:
    """The folder of that name inside a folder of results, made where there is none.

    Raises `FrictrackError` where it cannot be made, or a link to elsewhere stands in its place.
    """
    path = folder / name
    if path.is_symlink():
        raise FrictrackError(f"expected a folder {path} but it is a link to elsewhere; remove the link")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise FrictrackError(f"cannot write results into {path}: {e.strerror or e}") from e
    return path


@contextmanager
def atomic_write(path: Path, mode: int = 0o644) -> Iterator[Path]:
    """A file to write that takes the place of `path` when the block ends well; a power cut leaves the old or the new.

    Raises `FrictrackError` when it cannot be written, and leaves what was there.
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
        _remove_leftovers(path, part)
        yield part
        _commit(part, path, mode)
    except OSError as e:
        raise FrictrackError(f"cannot write {path}: {e.strerror or e}; what was there is untouched") from e
    finally:
        with suppress(FileNotFoundError):
            part.unlink()


def _remove_leftovers(path: Path, mine: Path) -> None:
    """Remove what writers of `path` that were killed have left: those of this host, and of others after a day."""
    left = re.compile(rf"\.{re.escape(path.stem)}_(\w+)-(\d+)_[^.]+\.part{re.escape(path.suffix)}")
    for part in path.parent.iterdir():
        found = left.fullmatch(part.name)
        if found is None or part == mine:
            continue
        with suppress(OSError):
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


def replace_text(path: Path, text: str) -> Path:
    """Write a text in UTF-8, its line ends as they are, whole or not at all; returns the path."""
    with atomic_write(path) as part:
        part.write_bytes(text.encode())
    return path
