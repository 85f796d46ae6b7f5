"""Read boxes from uncompressed recordings: only the wanted bytes, in bounded memory.

A format with uncompressed pixels derives from `DirectRecording` and sets `_layout` when it is opened.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import FileIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.recording.base import Frame, Recording
from frictrack.recording.byte_ranges import RangedFile, RangeReader

_MIN_SPARSE_BYTES = 1 << 18  # bytes of a frame above which reading ahead beyond the box costs more than it saves
_UNPACK_BYTES = 1 << 18  # bytes of packed pixels unpacked at a time: they stay in the cache
_GROUPS = {8: (1, 1), 10: (4, 5), 12: (2, 3), 16: (1, 2)}  # bits: pixels and bytes of one group


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
        """Compute where pictures start.

        Parameters
        ----------
        indices : array of int (n,)
            Numbers of the pictures in the file.

        Returns
        -------
        array of int (n,)
            Bytes from the beginning of the file.

        """
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

    Parameters
    ----------
    shape : tuple of int
        Height and width, px.
    bits : int
        8, 16, or 10 or 12 for packed pixels.

    Returns
    -------
    int
        Bytes.

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
        """Read grey values of boxes, without any check.

        Parameters
        ----------
        indices : array of int (n,)
            Numbers of the pictures in the file.
        corners : array of int (n, 2)
            Upper left pixels (x, y).
        size : tuple of int
            Height and width, px.

        Returns
        -------
        array (n, h, w)
            uint8 or uint16.

        """
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

    Parameters
    ----------
    packed : array of uint8 (..., k)
        Bytes of whole groups.
    bits : int
        10 or 12.

    Returns
    -------
    array of uint16 (..., m)
        Pixels.

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
