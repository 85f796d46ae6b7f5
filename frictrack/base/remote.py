"""Read the paths and addresses that a user or a file names, and fetch recordings that are given by an address.

    video = "s3://lab/course_a/v3.cine"      file://, http://, https://, s3://, gs://, az://

`locate` and `RemoteFile` accept these protocols only: fsspec, which opens the addresses, knows others that run code.
Each service needs its own package (s3fs, gcsfs, adlfs), which the user installs. Passwords belong into the
configuration of these packages, never into a study file.
"""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from posixpath import normpath
from typing import Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

from frictrack.base.errors import FrictrackError, needs_package
from frictrack.base.files import cache_root

PROTOCOLS = ("file", "http", "https", "s3", "gs", "gcs", "az", "abfs")  # that an address may have
MAX_CACHE_BYTES = 50e9  # above it, the least recently used files are deleted
MAX_UNSTATED_BYTES = 2e9  # of a file whose size its server does not state
MAX_SILENCE_S = 30.0  # without an answer of a web server, or without one more byte
MIN_BYTES_PER_S = 1e3  # on the average of a file, after `MAX_SILENCE_S`
MAX_CAUSE_LENGTH = 300  # characters of what a server or a package says
COMPANION_ENDINGS = {".cih": (".mraw",), ".cihx": (".mraw",)}  # header -> files with the frames
CHANGE_KEYS = ("ETag", "etag", "LastModified", "last_modified", "Last-Modified", "mtime", "updated")  # of a new version
_LISTED: ContextVar[Collection[str] | None] = ContextVar("listed", default=None)  # the only files that may be named


def is_address(text: str) -> bool:
    """Return whether a text is an address and not a path.

    Examples
    --------
    >>> is_address("https://host/v3.avi"), is_address("films/v3.avi")
    (True, False)

    """
    return "://" in text


@contextmanager
def only_listed(files: Collection[str]) -> Iterator[None]:
    """Let `locate` refuse all other files while the block runs.

    Parameters
    ----------
    files
        Paths in the folder of a study.

    """
    before = _LISTED.set(files)
    try:
        yield
    finally:
        _LISTED.reset(before)


def locate(text: str, folder: Path = Path()) -> Path | RemoteFile:
    """Return the file that a text names. Every path and address from outside passes here or through `RemoteFile`.

    Examples
    --------
    >>> locate("s3://lab/v3.cine").name
    'v3.cine'

    """
    if (listed := _LISTED.get()) is not None:
        place = normpath(text)
        if is_address(text) or not any(one == place or one.startswith(f"{place}/") for one in listed):
            raise FrictrackError(
                f'expected a file that the crate lists, in its own folder, but got "{text}"; do not trust this crate'
            )
    if not is_address(text):
        return folder / text
    file = RemoteFile(text)
    return Path(url2pathname(urlsplit(text).path)) if text.startswith("file:///") else file


def _check_address(text: str) -> None:
    """Raise `FrictrackError` unless an address has one of `PROTOCOLS`, no other address inside, and a file name."""
    try:
        name = PurePosixPath(urlsplit(text).path).name
    except ValueError:  # brackets of an IPv6 host that do not close
        name = ""
    if "::" in text or text.partition("://")[0] not in PROTOCOLS or not name or re.search(r"[\\:]|^\.\.$", name):
        known = ", ".join(f"{one}://" for one in PROTOCOLS)
        raise FrictrackError(
            f'expected the address of a file ({known}) but got "{text[:200]}"; fetch it and give its path'
        )


@dataclass(frozen=True)
class RemoteFile:
    """The address of a remote file.

    Examples
    --------
    >>> file = RemoteFile("s3://lab/course_a/v3.cine")
    >>> file.name, file.stem
    ('v3.cine', 'v3')

    """

    url: str  # the address

    def __post_init__(self) -> None:
        _check_address(self.url)

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

    @property
    def suffix(self) -> str:
        """The last part of the name: ``.cine``."""
        return PurePosixPath(self.name).suffix

    def fetch(self) -> Path:
        """Return the path of the file on this machine; it is fetched unless the cache has its current version.

        Raises
        ------
        FrictrackError
            If it cannot be fetched.

        """
        trim_cache()
        endings = COMPANION_ENDINGS.get(self.suffix.lower(), ())
        files = [self, *(RemoteFile(self.url.removesuffix(self.suffix) + ending) for ending in endings)]
        try:
            found = [(file, *file.filesystem()) for file in files]
            infos = [fs.info(path) for _, fs, path in found]
            kept = cache_folder(self.url) / _digest([_version(info) for info in infos])
            kept.mkdir(parents=True, exist_ok=True)
            for (file, fs, path), info in zip(found, infos, strict=True):
                if not (kept / file.name).is_file():
                    _download(fs, path, kept / file.name, info.get("size"))
                os.utime(kept / file.name)
        except FrictrackError:
            raise
        except Exception as e:  # every protocol has errors of its own
            raise FrictrackError(
                f"expected a recording at {self.url} but it cannot be fetched: {describe_cause(e)}"
            ) from e
        return kept / self.name

    def state(self) -> list[int]:
        """Return numbers that change when the remote file changes, without fetching it; empty if there is no answer."""
        info = self.info()
        if not info:
            return []
        size, *marks = _version(info)
        return [int(size or 0), int(_digest(marks), 16)]

    def info(self) -> dict[str, Any]:
        """Return what the store says about the file, as fsspec gives it; empty if there is no answer."""
        try:
            fs, path = self.filesystem()
            return dict(fs.info(path))
        except Exception:  # noqa: BLE001 - every protocol has errors of its own
            return {}

    def filesystem(self) -> tuple[Any, str]:
        """Return the file system of fsspec for the address, and the path in it."""
        with needs_package("a recording by address", "frictrack[cluster]"):
            import fsspec  # noqa: PLC0415 - optional
        options = {}
        if self.url.startswith("http"):
            with suppress(ModuleNotFoundError):  # fsspec says what it needs
                from aiohttp import ClientTimeout  # noqa: PLC0415 - optional

                options["timeout"] = ClientTimeout(total=None, sock_connect=MAX_SILENCE_S, sock_read=MAX_SILENCE_S)
        fs, path = fsspec.url_to_fs(self.url, **options)
        return fs, str(path)


def local_path(path: Path | RemoteFile) -> Path:
    """Return the path of a file on this machine; a remote file is fetched.

    Raises
    ------
    FrictrackError
        If it cannot be fetched.

    """
    return path.fetch() if isinstance(path, RemoteFile) else path


def describe_cause(e: BaseException) -> str:
    """Return in one line why a remote file cannot be read."""
    if isinstance(e, FileNotFoundError) and e.__cause__ is not None:  # how fsspec reports any fault of a web server
        e = e.__cause__
    return " ".join(str(e).split())[:MAX_CAUSE_LENGTH] or type(e).__name__


def _version(info: dict[str, Any]) -> list[Any]:
    """Return what changes with a remote file: its size first."""
    return [info.get("size"), *(str(info.get(key)) for key in CHANGE_KEYS)]


def _digest(value: object) -> str:
    return hashlib.sha256(repr(value).encode()).hexdigest()[:12]


def _download(fs: Any, path: str, target: Path, size: int | None) -> None:
    """Fetch a file as a whole; a server that never ends its answer is left."""
    from fsspec.callbacks import Callback  # noqa: PLC0415 - optional

    with tempfile.TemporaryDirectory(dir=target.parent) as scratch:  # what was written of a part is removed
        part = Path(scratch) / target.name
        fs.get_file(path, str(part), callback=Callback(hooks={"limit": _limit(size)}))
        part.replace(target)


def _limit(size: int | None) -> Callable[..., None]:
    """Return a function that raises OSError when more or fewer bytes came than should."""
    began = time.monotonic()
    most, promised = (size, "as stated") if size is not None else (MAX_UNSTATED_BYTES, "without a stated size")

    def check(_: int | None, came: int, **more: Any) -> None:
        seconds = time.monotonic() - began
        if came > most:
            raise OSError(f"expected at most {most / 1e6:g} MB {promised} but its server sends more")
        if seconds > MAX_SILENCE_S and came < MIN_BYTES_PER_S * seconds:
            raise OSError(
                f"expected {MIN_BYTES_PER_S / 1e3:g} kB/s but its server sent {came} bytes in {seconds:.0f} s"
            )

    return check


def cache_folder(url: str) -> Path:
    """Return the cache folder of the files of one remote folder.

    Parameters
    ----------
    url
        Address of a file.

    """
    return cache_root("recordings") / hashlib.sha256(url.rpartition("/")[0].encode()).hexdigest()[:16]


def trim_cache() -> None:
    """Delete the least recently used files of the cache above `MAX_CACHE_BYTES`."""
    files = []
    for path in cache_root("recordings").rglob("*"):
        with suppress(FileNotFoundError):  # another process has deleted it
            if path.is_file():
                files.append((path.stat(), path))
    total = sum(_bytes_on_disk(found) for found, _ in files)
    for found, path in sorted(files, key=lambda file: file[0].st_mtime):
        if total <= MAX_CACHE_BYTES:
            return
        total -= _bytes_on_disk(found)
        path.unlink(missing_ok=True)


def _bytes_on_disk(found: os.stat_result) -> int:
    """Return the size of a file without its holes."""
    return min(found.st_size, 512 * getattr(found, "st_blocks", found.st_size))  # POSIX: in units of 512 bytes
