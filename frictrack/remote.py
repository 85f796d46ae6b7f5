"""Fetch recordings that are given by an address into a cache folder of this machine, by fsspec.

    video = "s3://lab/course_a/v3.cine"      s3://, gs://, az://, sftp://, https://, webdav://, ...

Each protocol needs its own package (s3fs, gcsfs, sshfs, aiohttp), which the user installs. Passwords belong into the
configuration of these packages, never into a study file.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import urlsplit

from frictrack.content_hash import cache_root
from frictrack.errors import FrictrackError, is_disk_full

MAX_CACHE_BYTES = 50e9  # above it, the least recently used files are deleted
CACHE_INDEX = "cache"  # file in which fsspec lists what it has fetched
COMPANION_ENDINGS = {".cih": (".mraw",), ".cihx": (".mraw",)}  # header -> files with the frames
CHANGE_KEYS = ("ETag", "etag", "LastModified", "last_modified", "mtime", "updated")  # by which a file's change is seen


@dataclass(frozen=True)
class RemoteFile:
    """The address of a remote file.

    Attributes
    ----------
    url
        The address.

    Examples
    --------
    >>> file = RemoteFile("s3://lab/course_a/v3.cine")
    >>> file.name, file.stem
    ('v3.cine', 'v3')

    """

    url: str

    def __str__(self) -> str:
        return self.url

    @property
    def name(self) -> str:
        """The last part of the path: ``v3.cine``."""
        return PurePosixPath(urlsplit(self.url).path).name

    @property
    def stem(self) -> str:
        """The name without its suffix: ``v3``."""
        return PurePosixPath(self.name).stem

    def fetch(self) -> Path:
        """Return the path of the file on this machine; it is fetched unless the cache has its current version.

        Raises
        ------
        FrictrackError
            If it cannot be fetched.

        """
        fsspec = _fsspec()
        trim_cache()
        kept = cache_folder(self.url)
        companions = COMPANION_ENDINGS.get(PurePosixPath(self.name).suffix.lower(), ())
        urls = [self.url, *(self.url[: -len(PurePosixPath(self.name).suffix)] + ending for ending in companions)]
        how = {"cache_storage": str(kept), "same_names": True, "check_files": True}
        try:
            found = [Path(fsspec.open_local(f"filecache::{url}", filecache=how)) for url in urls]
        except Exception as e:  # every protocol has errors of its own
            if is_disk_full(e):  # the part that was written would keep it full
                for url in urls:
                    (kept / RemoteFile(url).name).unlink(missing_ok=True)
            raise self._failed(e) from e
        for path in found:
            os.utime(path)
        return found[0]

    def state(self) -> list[int]:
        """Return numbers that change when the remote file changes, without fetching it; empty if there is no answer."""
        info = self.info()
        if not info:
            return []
        mark = hashlib.sha256(repr([str(info.get(key)) for key in CHANGE_KEYS]).encode()).hexdigest()
        return [int(info.get("size") or 0), int(mark[:12], 16)]

    def info(self) -> dict[str, Any]:
        """Return what the store says about the file, as fsspec gives it; empty if there is no answer."""
        try:
            fs, path = self.filesystem()
            return dict(fs.info(path))
        except Exception:  # noqa: BLE001 - every protocol has errors of its own
            return {}

    def filesystem(self) -> tuple[Any, str]:
        """Return the file system of fsspec for the address, and the path in it."""
        fs, path = _fsspec().url_to_fs(self.url)
        return fs, str(path)

    def _failed(self, e: Exception) -> FrictrackError:
        why = " ".join(str(e).split()) or type(e).__name__
        return FrictrackError(f"expected a recording at {self.url} but it cannot be fetched: {why}")


def is_remote(text: str) -> bool:
    """Return whether a text is an address and not a path.

    Examples
    --------
    >>> is_remote("sftp://host/v3.avi"), is_remote("films/v3.avi")
    (True, False)

    """
    return "://" in text


def local_path(path: Path | RemoteFile) -> Path:
    """Return the path of a file on this machine; a remote file is fetched.

    Raises
    ------
    FrictrackError
        If it cannot be fetched.

    """
    return path.fetch() if isinstance(path, RemoteFile) else path


def _fsspec() -> Any:
    try:
        import fsspec  # noqa: PLC0415 - optional
    except ModuleNotFoundError as e:
        raise FrictrackError('recordings by address need fsspec; pip install "frictrack[cluster]"') from e
    return fsspec


def cache_folder(url: str) -> Path:
    """Return the cache folder of the files of one remote folder.

    Parameters
    ----------
    url
        Address of a file.

    """
    return _cache_root() / hashlib.sha256(url.rpartition("/")[0].encode()).hexdigest()[:16]


def trim_cache() -> None:
    """Delete the least recently used files of the cache above `MAX_CACHE_BYTES`."""
    files = []
    for path in _cache_root().rglob("*"):
        with suppress(FileNotFoundError):  # another process has deleted it
            if path.is_file() and path.name != CACHE_INDEX:
                files.append((path.stat(), path))
    total = sum(_bytes_on_disk(found) for found, _ in files)
    for found, path in sorted(files, key=lambda file: file[0].st_mtime):
        if total <= MAX_CACHE_BYTES:
            return
        total -= _bytes_on_disk(found)
        path.unlink(missing_ok=True)


def _cache_root() -> Path:
    return cache_root("recordings")


def _bytes_on_disk(found: os.stat_result) -> int:
    """Return the size of a file without its holes."""
    return min(found.st_size, 512 * getattr(found, "st_blocks", found.st_size))  # POSIX: in units of 512 bytes
