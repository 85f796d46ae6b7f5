"""Read parts of remote files. What was read is kept in a file with holes in the cache folder of `frictrack.base.remote`.

A file is read in parts only if its store states what identifies the content: a checksum, a version or a strong ETag.
This statement takes the place of the hash over every byte.
"""

from __future__ import annotations

import asyncio
import hashlib
import io
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from http.client import PARTIAL_CONTENT
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.base.files import write_at
from frictrack.base.remote import RemoteFile, cache_folder, describe_cause

BLOCK_BYTES = 1 << 14  # that are fetched and kept together
_MAX_RUN_BLOCKS = 512  # blocks of one request: 8 MB
_MAX_BATCH_BLOCKS = 4096  # blocks of the requests that are sent at once: 64 MB
MAX_BATCH_S = 600.0  # for the answers to these requests
# Key in the description of a file by fsspec -> name of the statement; of the content, then of this version of the file.
_CHECKSUMS = {"ChecksumSHA256": "sha256", "md5Hash": "md5"}
_VERSIONS = {"VersionId": "version", "generation": "generation", "ETag": "etag", "etag": "etag"}


@dataclass(frozen=True)
class RangedFile(RemoteFile):
    """One version of a remote file, of which parts can be read.

    Attributes
    ----------
    size
        Bytes.
    identity
        What the store states about the content, such as ``"etag:5d41402a 1024 s3://lab/v3.cine"``.

    """

    size: int
    identity: str

    def open(self, mode: str = "rb") -> BinaryIO:
        """Open the file for reading; see `Path.open`."""
        if mode != "rb":
            raise ValueError(f'expected the mode "rb" but got "{mode}"')
        return cast(BinaryIO, io.BufferedReader(RangeReader(self)))

    def neighbour(self, suffix: str) -> RangedFile | None:
        """Return the file with another suffix in the same remote folder; None if there is none.

        Parameters
        ----------
        suffix
            The suffix in small letters; it is tried in capitals if this file has one in capitals.

        """
        suffix = suffix.upper() if self.suffix.isupper() else suffix
        return find_ranges(RemoteFile(self.url.removesuffix(self.suffix) + suffix))

    def check_unchanged(self) -> None:
        """Raise `FrictrackError` unless the store still has this version."""
        now = find_ranges(RemoteFile(self.url))
        if now is None:
            raise FrictrackError(f"expected the recording at {self.url} that was opened but it is not there any more")
        if now != self:
            raise FrictrackError(f"the recording at {self.url} was replaced while it was read; run again")


class RangeReader(io.RawIOBase):
    """Read a remote file; blocks that are not in the cache yet are fetched.

    Parameters
    ----------
    file
        The file.

    """

    def __init__(self, file: RangedFile) -> None:
        super().__init__()
        self._source, self._position = file, 0
        blocks = -(-file.size // BLOCK_BYTES)
        mark = hashlib.sha256(f"{file.url}\n{file.identity}".encode()).hexdigest()[:16]
        path = cache_folder(file.url) / f"{file.name}.{mark}.parts"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._kept = io.FileIO(os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o600), "r+b")
            if os.fstat(self._kept.fileno()).st_size < file.size + blocks:
                self._kept.truncate(file.size + blocks)  # after the content one byte a block: 1 if it is there
            os.utime(path)
            self._kept.seek(file.size)
            self._there = np.frombuffer(bytearray(self._kept.read(blocks)), np.uint8)
        except OSError as e:
            raise self._failed(e) from e

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Change the position; see `io.IOBase.seek`."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._source.size}[whence]
        self._position = start + offset
        return self._position

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer as far as the file goes; return the number of bytes."""
        view = memoryview(buffer).cast("B")
        view = view[: max(0, self._source.size - self._position)]
        self.fetch(np.array([self._position]), len(view))
        self._kept.seek(self._position)
        count = self._kept.readinto(view)
        self._position += count
        return count

    def close(self) -> None:
        """Close the file in the cache."""
        self._kept.close()
        super().close()

    def fetch(self, starts: NDArray[np.int64], count: int) -> None:
        """Fetch what is missing of some parts into the cache, many requests at once.

        Parameters
        ----------
        starts
            First byte of each part, shape (n,).
        count
            Bytes of each part.

        Raises
        ------
        FrictrackError
            If the store does not answer, or the cache cannot be written.

        """
        if count <= 0 or not len(starts):
            return
        first, last = starts // BLOCK_BYTES, np.minimum(starts + count - 1, self._source.size - 1) // BLOCK_BYTES
        wanted = np.zeros(len(self._there) + 1, np.int64)
        np.add.at(wanted, first, 1)
        np.add.at(wanted, last + 1, -1)
        missing = np.flatnonzero((np.cumsum(wanted[:-1]) > 0) & (self._there == 0))
        for at in range(0, len(missing), _MAX_BATCH_BLOCKS):
            try:
                self._fetch_blocks(missing[at : at + _MAX_BATCH_BLOCKS])
            except Exception as e:  # every protocol has errors of its own
                raise self._failed(e) from e

    def _fetch_blocks(self, blocks: NDArray[np.int64]) -> None:
        """Fetch blocks by their rising numbers; they are marked when they are on the disk."""
        runs = list(_runs(blocks))
        starts = [first * BLOCK_BYTES for first, _ in runs]
        ends = [min((last + 1) * BLOCK_BYTES, self._source.size) for _, last in runs]
        for start, end, part in zip(starts, ends, self._read_ranges(starts, ends), strict=True):
            if len(part) != end - start:
                raise OSError(f"expected {end - start} bytes from byte {start} but got {len(part)}")
            write_at(self._kept, start, part)
        os.fsync(self._kept.fileno())
        for first, last in runs:
            write_at(self._kept, self._source.size + first, b"\1" * (last + 1 - first))
        self._there[blocks] = 1

    def _read_ranges(self, starts: list[int], ends: list[int]) -> list[bytes]:
        fs, path = self._filesystem
        if not path.startswith("http"):
            return list(fs.cat_ranges([path] * len(starts), starts, ends, on_error="raise"))
        from fsspec.asyn import sync  # noqa: PLC0415 - optional

        try:
            return list(sync(fs.loop, _read_web_ranges, fs, path, starts, ends, timeout=MAX_BATCH_S))
        except TimeoutError as e:
            raise OSError(f"expected an answer within {MAX_BATCH_S:g} s but its server has sent none") from e

    @cached_property
    def _filesystem(self) -> tuple[Any, str]:
        return self._source.filesystem()

    def _failed(self, e: Exception) -> FrictrackError:
        return FrictrackError(f"{self._source.url} cannot be read: {describe_cause(e)}")


async def _read_web_ranges(fs: Any, url: str, starts: list[int], ends: list[int]) -> list[bytes]:
    """Read parts from a web server; fsspec would read whatever it sends, without end."""
    session = await fs.set_session()

    async def read(start: int, end: int) -> bytes:
        headers = {**fs.kwargs.get("headers", {}), "Range": f"bytes={start}-{end - 1}"}
        async with session.get(fs.encode_url(url), **{**fs.kwargs, "headers": headers}) as answer:
            answer.raise_for_status()
            if answer.status != PARTIAL_CONTENT:
                raise OSError("expected a part of it but its server sends all")
            return bytes(await answer.content.readexactly(end - start))

    return await asyncio.gather(*map(read, starts, ends))


def find_ranges(file: RemoteFile) -> RangedFile | None:
    """Return the present version of a remote file; None if it is not there, or its store does not identify the content.

    Parameters
    ----------
    file
        The address.

    """
    found = file.info()
    size, identity = found.get("size"), _identity(file.url, found)
    is_whole_only = found.get("partial") is False  # a web server that says so
    return RangedFile(file.url, int(size), identity) if size and identity and not is_whole_only else None


def identify(files: Sequence[RangedFile]) -> str:
    """Return what identifies the content of files in their order, after a look whether the store still has them.

    Parameters
    ----------
    files
        The files.

    Returns
    -------
    str
        The identity of a single file; of several ``"store:"`` and the SHA-256 of the lines of identities and names.

    Raises
    ------
    FrictrackError
        If one was replaced or removed.

    """
    for file in files:
        file.check_unchanged()
    if len(files) == 1:
        return files[0].identity
    lines = "".join(f"{file.identity}  {file.name}\n" for file in files)
    return f"store:{hashlib.sha256(lines.encode()).hexdigest()}"


def file_size(path: Path | RangedFile) -> int:
    """Return the size of a file, bytes.

    Parameters
    ----------
    path
        The file.

    """
    return path.size if isinstance(path, RangedFile) else path.stat().st_size


def _identity(url: str, found: Mapping[str, Any]) -> str:
    """Return the strongest statement of a store about a content; "" if it makes none.

    A version and an ETag mean something only together with the address.
    """
    for key, word in _CHECKSUMS.items():
        if found.get(key):
            return f"{word}:{found[key]} {found.get('size')}"
    for key, word in _VERSIONS.items():
        value = str(found.get(key) or "").strip('"')
        if value not in ("", "null") and not value.startswith("W/"):  # a weak ETag allows other bytes
            return f"{word}:{value} {found.get('size')} {url}"
    return ""


def _runs(blocks: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Yield first and last number of neighbouring blocks, at most `_MAX_RUN_BLOCKS` together."""
    first = last = int(blocks[0])
    for block in blocks[1:].tolist():
        if block != last + 1 or block - first >= _MAX_RUN_BLOCKS:
            yield first, last
            first = block
        last = block
    yield first, last
