"""Uncompressed pictures in a file: only the bytes of the wanted box are touched, in bounded memory.

A format whose pixels lie bare in its file derives from `Direct` and sets `_layout` when it is opened.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from frictrack.errors import FrictrackError
from frictrack.recording.base import Frame, Recording

_WINDOW = 64 << 20  # bytes mapped at a time: what was read before it is given back to the system
_SPARSE = 1 << 18  # bytes of a frame above which reading ahead beyond the box costs more than it saves
_TOGETHER = 1 << 18  # bytes of packed pixels unpacked at a time: they stay in the cache
_GROUPS = {8: (1, 1), 10: (4, 5), 12: (2, 3), 16: (1, 2)}  # bits: pixels and bytes of one group


@dataclass(frozen=True)
class Layout:
    """Where the pictures lie and how a pixel is stored.

    `path`: the file of pixels. `offsets`: byte at which each picture starts. `bits`: 8, 16, or 10 and 12 for pixels
    packed without a gap, high bits first (four pixels in five bytes, two in three). `upward`: the lowest row is
    stored first. `shift`: bits to the right (values stored in the high bits). `padded`: bytes of a row are a multiple
    of it. `table`: grey value of each stored code (companded recordings).
    """

    path: Path
    offsets: NDArray[np.int64] | range
    bits: int
    byte_order: Literal["<", ">", "="] = "<"
    upward: bool = False
    shift: int = 0
    padded: int = 1
    table: NDArray[np.uint16] | None = None

    def starts(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        """Bytes at which these pictures start."""
        if isinstance(self.offsets, range):
            return self.offsets.start + self.offsets.step * indices
        return self.offsets[indices]

    def pitch(self, width: int) -> int:
        """Bytes from one row to the next."""
        pixels, size = _GROUPS[self.bits]
        return -(-width // pixels * size // self.padded) * self.padded

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the grey values that come out."""
        return np.dtype(np.uint8 if self.bits == 8 else np.uint16)


def picture_bytes(shape: tuple[int, int], bits: int) -> int:
    """Bytes of one picture (h, w) at 8, 10 packed, 12 packed or 16 bit."""
    return shape[0] * shape[1] * bits // 8


class Direct(Recording):
    """A recording of which any part of any frame can be read at once."""

    direct = True
    _layout: Layout

    def cut(self, indices: Sequence[int] | NDArray[Any], corners: NDArray[Any], size: tuple[int, int]) -> Frame:
        """See `Recording.cut`; only the bytes of the boxes are read."""
        if not self.direct:
            return super().cut(indices, corners, size)
        indices, corners = self._boxes(indices, corners, size)
        return self._cutter.cut(indices, corners, size)

    def _read(self, indices: Iterable[int]) -> Iterator[Frame]:
        corner = np.zeros((1, 2), np.int64)
        for index in indices:
            yield self._cutter.cut(np.array([index]), corner, self.shape)[0]

    @cached_property
    def _cutter(self) -> Cutter:
        sparse = picture_bytes(self.shape, self._layout.bits) > _SPARSE
        return Cutter(self.shape, self._layout, Window(self._layout.path, sparse))


class Window:
    """A file mapped piece by piece, so that resident memory does not grow with the file.

    `sparse`: little of it is wanted, so the system reads what it is told of and nothing around it (measured: a box
    out of a frame of 1 MB that is not in memory yet takes 0.1 ms, not 1 ms).
    """

    def __init__(self, path: Path, sparse: bool = False) -> None:
        self._path = path
        self.sparse = sparse and hasattr(mmap, "MADV_WILLNEED")  # not on Windows
        self._now: tuple[mmap.mmap | bytes, int, int] = (b"", 0, 0)

    def over(self, low: int, high: int) -> tuple[mmap.mmap | bytes, int, int]:
        """(bytes, first, end): the mapped piece of the file which holds `low` to `high`."""
        now = self._now
        if now[1] <= low and high <= now[2]:
            return now
        with self._path.open("rb") as file:
            size = file.seek(0, 2)
            if high > size:
                raise FrictrackError(f"{self._path.name}: the file became shorter while it was read; open it again")
            first = low - low % mmap.ALLOCATIONGRANULARITY
            end = min(size, max(high, first + _WINDOW))
            piece = mmap.mmap(file.fileno(), end - first, access=mmap.ACCESS_READ, offset=first)
        if self.sparse:
            piece.madvise(mmap.MADV_RANDOM)
        self._now = (piece, first, end)
        return self._now

    def read(self, low: int, high: int) -> None:
        """Have `low` to `high` of the mapped piece read in one go; only where `sparse`."""
        piece, first, end = self._now
        if isinstance(piece, mmap.mmap):
            start = (low - first) // mmap.PAGESIZE * mmap.PAGESIZE
            piece.madvise(mmap.MADV_WILLNEED, start, min(high, end) - first - start)


class Cutter:
    """Boxes out of the pictures of one layout."""

    def __init__(self, shape: tuple[int, int], layout: Layout, window: Window) -> None:
        self._layout, self._window, self._shape = layout, window, shape
        self._group, self._bytes = _GROUPS[layout.bits]
        self._pitch = layout.pitch(shape[1])

    def cut(self, indices: NDArray[np.int64], corners: NDArray[np.int64], size: tuple[int, int]) -> Frame:
        """Grey values (n, h, w) of the boxes; nothing is checked."""
        out = np.empty((len(indices), *size), self._layout.dtype)
        if self._layout.bits in (8, 16):
            self._gather(out, indices, corners[:, 0], corners[:, 1])
            return self._graded(out)
        many = max(1, _TOGETHER // max(1, size[0] * size[1] * 2))
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
        piece, first, end = self._window.over(0, 0)
        for target, low in zip(out, starts.tolist(), strict=True):
            if not (first <= low and low + span <= end):
                piece, first, end = self._window.over(low, low + span)
            if self._window.sparse:
                self._window.read(low, low + span)
            target[...] = np.ndarray(box, kind, piece, low - first + first_row, strides)

    def _unpacked(self, indices: NDArray[np.int64], corners: NDArray[np.int64], size: tuple[int, int]) -> Frame:
        """Boxes of packed pixels: whole groups are read, then what lies left and right of the box is cut off."""
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
        if self._layout.table is not None:
            return self._layout.table[codes]
        if self._layout.shift:
            codes >>= np.uint16(self._layout.shift)
        return codes


def unpack(packed: NDArray[np.uint8], bits: int) -> NDArray[np.uint16]:
    """Pixels (..., m) of 10 or 12 bit out of bytes (..., k) in which they are packed high bits first."""
    pixels, size = _GROUPS[bits]
    groups = packed.reshape(*packed.shape[:-1], -1, size).astype(np.uint16)
    out = np.empty((*groups.shape[:-1], pixels), np.uint16)
    for i in range(pixels):
        byte, bit = divmod(i * bits, 8)
        high = groups[..., byte] & np.uint16((1 << (8 - bit)) - 1)
        spare = bits - (8 - bit)  # bits that the next byte holds
        out[..., i] = (high << np.uint16(spare)) | (groups[..., byte + 1] >> np.uint16(8 - spare))
    return out.reshape(*packed.shape[:-1], -1)
