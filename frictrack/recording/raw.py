"""Random access to frames: boxes from uncompressed recordings, and other recordings decoded once, in a thread.

A format with uncompressed pixels derives from `DirectRecording` and sets `_layout` when it is opened.
"""

from __future__ import annotations

import atexit
import math
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from io import FileIO
from pathlib import Path
from threading import Condition, Thread
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.recording.base import Frame, Recording, RecordingView
from frictrack.recording.byte_ranges import RangedFile, RangeReader

_MIN_SPARSE_BYTES = 1 << 18  # bytes of a frame above which reading ahead beyond the box costs more than it saves
_UNPACK_BYTES = 1 << 18  # bytes of packed pixels unpacked at a time: they stay in the cache
_GROUPS = {8: (1, 1), 10: (4, 5), 12: (2, 3), 16: (1, 2)}  # bits: pixels and bytes of one group
MAX_MEMORY_BYTES = 512 << 20  # of decoded film; a longer film goes to a temporary file


@dataclass(frozen=True)
class PixelLayout:
    """Position and coding of the pixels in a file.

    Attributes
    ----------
    path : Path or RangedFile
        File with the pixels.
    offsets : array of int or range
        Byte at which each picture starts.
    bits : int
        8 or 16, or 10 or 12 for pixels packed without gaps, high bits first (four pixels in five bytes, two in three).
    byte_order : str
        "<", ">" or "=".
    upward : bool
        Whether the lowest row is stored first.
    shift : int
        Bits to shift right, for values stored in the high bits.
    padded : int
        Number of bytes of which the length of a row is a multiple.
    table : array of uint16 or None
        Grey value of each stored code, for companded recordings.

    """

    path: Path | RangedFile
    offsets: NDArray[np.int64] | range
    bits: int
    byte_order: Literal["<", ">", "="] = "<"
    upward: bool = False
    shift: int = 0
    padded: int = 1
    table: NDArray[np.uint16] | None = None

    def starts(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        """Compute where pictures start."""
        if isinstance(self.offsets, range):
            return self.offsets.start + self.offsets.step * indices
        return self.offsets[indices]

    def pitch(self, width: int) -> int:
        """Bytes from one row of `width` px to the next."""
        pixels, size = _GROUPS[self.bits]
        return -(-width // pixels * size // self.padded) * self.padded

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the resulting grey values."""
        return np.dtype(np.uint8 if self.bits == 8 else np.uint16)


def picture_bytes(shape: tuple[int, int], bits: int) -> int:
    """Compute the size of a picture.

    Examples
    --------
    >>> picture_bytes((100, 200), 12)
    30000

    """
    return shape[0] * shape[1] * bits // 8


class DirectRecording(Recording):
    """Recording of which any part of any frame can be read at once."""

    direct = True
    _layout: PixelLayout

    def cut(self, indices: Sequence[int] | NDArray[Any], corners: NDArray[Any], size: tuple[int, int]) -> Frame:
        """Read only the bytes of the boxes; see `Recording.cut`."""
        if not self.direct:
            return super().cut(indices, corners, size)
        indices, corners = self._boxes(indices, corners, size)
        return self._cutter.cut(indices, corners, size)

    def _read(self, indices: Iterable[int]) -> Iterator[Frame]:
        corner = np.zeros((1, 2), np.int64)
        for index in indices:
            yield self._cutter.cut(np.array([index]), corner, self.shape)[0]

    @cached_property
    def _cutter(self) -> BoxReader:
        return BoxReader(self.shape, self._layout)


class BoxReader:
    """Read boxes out of pictures with one layout.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the pictures, px.
    layout : PixelLayout
        Position and coding of the pixels.

    """

    def __init__(self, shape: tuple[int, int], layout: PixelLayout) -> None:
        self._layout, self._shape = layout, shape
        self._sparse = picture_bytes(shape, layout.bits) > _MIN_SPARSE_BYTES
        self._group, self._bytes = _GROUPS[layout.bits]
        self._pitch = layout.pitch(shape[1])

    def cut(self, indices: NDArray[np.int64], corners: NDArray[np.int64], size: tuple[int, int]) -> Frame:
        """Read grey values of boxes, without any check."""
        out = np.empty((len(indices), *size), self._layout.dtype)
        if self._layout.bits in (8, 16):
            self._gather(out, indices, corners[:, 0], corners[:, 1])
            return self._graded(out)
        many = max(1, _UNPACK_BYTES // max(1, size[0] * size[1] * 2))
        for at in range(0, len(indices), many):
            part = slice(at, at + many)
            out[part] = self._unpacked(indices[part], corners[part], size)
        return out

    def _gather(
        self,
        out: NDArray[Any],
        indices: NDArray[np.int64],
        groups: NDArray[np.int64],
        rows: NDArray[np.int64],
    ) -> None:
        """Copy the bytes of each box into `out` (n, h, w in groups or bytes); `groups` is its first column."""
        h, step = out.shape[1], -self._pitch if self._layout.upward else self._pitch
        kind = np.dtype(np.uint16 if self._layout.bits == 16 else np.uint8).newbyteorder(self._layout.byte_order)
        if self._layout.upward:
            rows = self._shape[0] - rows - h
        starts = self._layout.starts(indices) + rows * self._pitch + groups * self._bytes
        span = (h - 1) * self._pitch + out.shape[2] * kind.itemsize
        first_row = (h - 1) * self._pitch if self._layout.upward else 0
        box, strides = out.shape[1:], (step, kind.itemsize)
        buffer = bytearray(span)
        found = np.ndarray(box, kind, buffer, first_row, strides)
        for target, _ in zip(out, self._filled(buffer, starts.tolist()), strict=True):
            target[...] = found

    def _filled(self, buffer: bytearray, starts: list[int]) -> Iterator[None]:
        """Fill `buffer` with the bytes from each of `starts` in turn.

        Reading is faster than memory mapping here, because each page is used once (measured for a box of 53 x 83 px
        from
        frames of 1024 x 128 px: 5 us against 14 us).
        """
        path = self._layout.path
        with RangeReader(path) if isinstance(path, RangedFile) else FileIO(path) as file:
            if isinstance(file, RangeReader):
                file.fetch(np.array(starts, np.int64), len(buffer))
            elif self._sparse and hasattr(os, "posix_fadvise"):  # not on Windows
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_RANDOM)
            for start in starts:
                file.seek(start)
                if file.readinto(buffer) != len(buffer):
                    name = self._layout.path.name
                    raise FrictrackError(f"{name}: the file became shorter while it was read; open it again")
                yield

    def _unpacked(self, indices: NDArray[np.int64], corners: NDArray[np.int64], size: tuple[int, int]) -> Frame:
        """Boxes of packed pixels: whole groups are read, then the pixels left and right of the box are removed."""
        per_row = self._shape[1] // self._group
        count = min(per_row, (size[1] + self._group - 2) // self._group + 1)
        first = np.minimum(corners[:, 0] // self._group, per_row - count)
        packed = np.empty((len(indices), size[0], count * self._bytes), np.uint8)
        self._gather(packed, indices, first, corners[:, 1])
        pixels = self._graded(unpack(packed, self._layout.bits))
        skip = corners[:, 0] - first * self._group
        out = np.empty((len(indices), *size), np.uint16)
        for left in np.unique(skip).tolist():
            mine = skip == left
            out[mine] = pixels[mine, :, left : left + size[1]]
        return out

    def _graded(self, codes: Frame) -> Frame:
        """Grey values of stored codes."""
        if self._layout.table is not None:
            return self._layout.table[codes]
        if self._layout.shift:
            codes >>= np.uint16(self._layout.shift)
        return codes


def unpack(packed: NDArray[np.uint8], bits: int) -> NDArray[np.uint16]:
    """Unpack pixels of 10 or 12 bit, stored high bits first.

    Examples
    --------
    >>> unpack(np.array([0xAB, 0xCD, 0xEF], np.uint8), 12).tolist() == [0xABC, 0xDEF]
    True

    """
    pixels, size = _GROUPS[bits]
    groups = packed.reshape(*packed.shape[:-1], -1, size).astype(np.uint16)
    out = np.empty((*groups.shape[:-1], pixels), np.uint16)
    for i in range(pixels):
        byte, bit = divmod(i * bits, 8)
        high = groups[..., byte] & np.uint16((1 << (8 - bit)) - 1)
        spare = bits - (8 - bit)  # bits that the next byte holds
        out[..., i] = (high << np.uint16(spare)) | (groups[..., byte + 1] >> np.uint16(8 - spare))
    return out.reshape(*packed.shape[:-1], -1)


@contextmanager
def random_access(recording: Recording) -> Iterator[Recording]:
    """Provide random access to a recording.

    A `direct` recording is returned as it is; others are decoded once, in a thread, into memory or a temporary file.
    The spool's `cut`, `frame`, `frames` and `pick` wait for their frames and raise the errors of the decoder. Leaving
    the context ends the thread and frees memory and disk.

    Parameters
    ----------
    recording : Recording
        Open recording.

    Yields
    ------
    Recording
        Recording with random access.

    Raises
    ------
    FrictrackError
        Where the disk has no room for the decoded film.

    """
    if recording.direct:
        yield recording
        return
    spool = Spool(recording, _room_for(recording))
    try:
        yield spool
    finally:
        spool.close()


class Spool(RecordingView):
    """Decoded frames of another recording, with random access; created by `random_access`."""

    def __init__(self, source: Recording, decoded: Frame) -> None:
        super().__init__(source)
        self._decoded = decoded  # (n, h, w)
        self._ready, self._done, self._stop = 0, False, False
        self._wanted = source.n_frames  # the first frame that a reader waits for
        self._fault: BaseException | None = None
        self._condition = Condition()
        self._decoder = Thread(target=self._decode, name="frictrack decoder", daemon=True)
        atexit.register(self.close)  # a thread that still decodes when Python ends would abort the process
        self._decoder.start()

    def cut(self, indices: Sequence[int] | NDArray[Any], corners: NDArray[Any], size: tuple[int, int]) -> Frame:
        """Wait for the frames and cut boxes out of them; see `Recording.cut`."""
        indices, corners = self._boxes(indices, corners, size)
        if len(indices) and not self._wait(int(indices.max())):
            raise FrictrackError(self._breaks_off(int(indices.max())))
        out: Frame = np.empty((len(indices), *size), self._decoded.dtype)
        for target, i, (x, y) in zip(out, indices.tolist(), corners.tolist(), strict=True):
            target[...] = self._decoded[i, y : y + size[0], x : x + size[1]]
        return out

    def close(self) -> None:
        """Stop the decoder and free the memory; it may be called again."""
        atexit.unregister(self.close)
        if self._stop:
            return
        with self._condition:
            self._stop = True
            self._condition.notify_all()
        self._decoder.join()
        self._decoded = self._decoded[:0].copy()  # which also deletes a temporary file

    def _read(self, indices: Iterable[int]) -> Iterator[Frame]:
        for index in indices:
            if not self._wait(index):
                return
            yield np.array(self._decoded[index])

    def _wait(self, index: int) -> bool:
        """Wait for a frame; False where the film breaks off before it."""
        if index < self._ready:
            return True

        def is_ready() -> bool:
            self._wanted = min(self._wanted, index)
            return index < self._ready or self._done

        with self._condition:
            self._condition.wait_for(is_ready)
        if index >= self._ready and self._fault is not None:
            raise self._fault
        return index < self._ready

    def _decode(self) -> None:
        """Decode all frames; runs in the thread."""
        try:
            for i, frame in enumerate(self._source.frames()):
                if self._stop:
                    break
                self._decoded[i] = frame
                self._announce(i + 1)
        except BaseException as fault:  # noqa: BLE001 - it is raised again where the frame is asked for
            self._fault = fault
        finally:
            with self._condition:
                self._done = True
                self._condition.notify_all()

    def _announce(self, ready: int) -> None:
        """Tell readers that the frames before `ready` are decoded."""
        with self._condition:
            self._ready = ready
            if ready > self._wanted:  # a reader that is woken for every frame takes time from the decoder
                self._wanted = self._source.n_frames
                self._condition.notify_all()


def _room_for(source: Recording) -> Frame:
    """Room for the decoded frames, in memory, or for a long film in a temporary file."""
    kind = np.dtype(np.uint8 if source.bit_depth <= 8 else np.uint16)
    shape = (source.n_frames, *source.shape)
    size = math.prod(shape) * kind.itemsize
    if size <= MAX_MEMORY_BYTES:
        return np.empty(shape, kind)
    free = shutil.disk_usage(tempfile.gettempdir()).free
    if size > free:
        raise FrictrackError(
            f"{source.path.name}: expected {size / 1e9:.1f} GB of room for the decoded film in "
            f"{tempfile.gettempdir()} but {free / 1e9:.1f} GB are free; make room or set TMPDIR to another disk"
        )
    with tempfile.TemporaryFile(prefix="frictrack-", suffix=".film") as file:
        return np.memmap(file, kind, "w+", shape=shape)
