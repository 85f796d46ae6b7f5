"""Read multi-page TIFF recordings page by page."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import tifffile
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.recording.base import Frame, Header, grey, truncation_notes
from frictrack.recording.raw import DirectRecording, PixelLayout, picture_bytes

# What tifffile would log about broken files, `Recording` says in words.
logging.getLogger("tifffile").setLevel(logging.CRITICAL)

_MAX_COMPRESSION = 1100  # times that deflate, the densest of the codecs, can make a picture smaller
_MAX_SAMPLE_VALUE = 281  # TIFF tag: 4095 says 12 bit in 16


class Tiff(DirectRecording):
    """Recording in one TIFF or BigTIFF file (8, 12 or 16 bit), contiguous stacks of ImageJ included.

    It is direct where every page is grey, uncompressed and in one piece.
    """

    path: Path
    suffixes: ClassVar[tuple[str, ...]] = (".tif", ".tiff")

    def _open(self) -> Header:
        try:
            with tifffile.TiffFile(self.path) as tif:
                return self._header(tif)
        except FrictrackError:
            raise
        except Exception as error:  # damaged tags make tifffile fail in many ways
            raise FrictrackError(
                f"{self.path.name}: expected a TIFF film but the file cannot be read as one"
            ) from error

    def _header(self, tif: tifffile.TiffFile) -> Header:
        page: Any = tif.pages[0]
        if page.dtype not in (np.dtype(np.uint8), np.dtype(np.uint16)):
            raise FrictrackError(
                f"{self.path.name}: expected grey values of 8 to 16 bit but got {page.dtype}; "
                "save the film as unsigned 8 or 16 bit"
            )
        shape = page.shape[:2]
        self._page_shape, self._kind = page.shape, np.dtype(page.dtype)
        frame_bytes = int(np.prod(page.shape)) * page.bitspersample // 8
        self._at = page.dataoffsets[0]
        self._contiguous = _in_one_block(tif, self._at, frame_bytes)
        promised = self._promised(tif)
        in_file = self._pages_in_file(tif, frame_bytes)
        notes = truncation_notes(self.path.name, in_file, promised)
        plain = page.compression == tifffile.COMPRESSION.NONE
        if frame_bytes > self.path.stat().st_size * (1 if plain else _MAX_COMPRESSION):
            raise ValueError("a picture larger than the file can hold")
        offsets = self._offsets(tif, in_file, frame_bytes)
        self.direct = offsets is not None
        if offsets is not None:
            self._layout = PixelLayout(self.path, offsets, page.bitspersample, tif.byteorder)
        return Header(in_file, shape, _bit_depth(page), _rate(tif), notes=notes)

    def _offsets(self, tif: tifffile.TiffFile, count: int, frame_bytes: int) -> NDArray[np.int64] | range | None:
        """Start of each uncompressed picture; None where pages are compressed, coloured or in strips."""
        if not _is_plain_page(tif.pages[0]):
            return None
        if self._contiguous:
            return range(self._at, self._at + count * frame_bytes, frame_bytes)
        pages, size = [tif.pages[i] for i in range(count)], self.path.stat().st_size
        if not all(
            _is_plain_page(page) and page.shape == pages[0].shape and page.dtype == pages[0].dtype for page in pages
        ):
            return None
        if any(_end(page) > size for page in pages):  # a damaged one among sound ones
            return None
        return np.array([page.dataoffsets[0] for page in pages], np.int64)

    def _promised(self, tif: tifffile.TiffFile) -> int:
        """Number of frames according to the tags."""
        if self._contiguous:
            return int((tif.imagej_metadata or {}).get("images", 1))
        return len(tif.pages)

    def _pages_in_file(self, tif: tifffile.TiffFile, frame_bytes: int) -> int:
        """Number of pages whose data ends within the file."""
        size = self.path.stat().st_size
        if self._contiguous:
            return min(self._promised(tif), (size - self._at) // frame_bytes)
        count = len(tif.pages)
        while count and _end(tif.pages[count - 1]) > size:
            count -= 1
        return count

    def _read(self, indices: Iterable[int]) -> Iterator[Frame]:
        if self.direct:
            yield from super()._read(indices)
            return
        with tifffile.TiffFile(self.path) as tif:
            for index in indices:
                yield self._picture(tif, index)

    def _picture(self, tif: tifffile.TiffFile, index: int) -> Frame:
        """Grey values of a page; black where it cannot be decoded or has another format."""
        try:
            page = tif.pages[index]
            if page.shape == self._page_shape and page.dtype == self._kind:
                return grey(page.asarray())
        except Exception:  # noqa: BLE001 - damaged tags and codecs make tifffile fail in many ways
            pass
        return np.zeros(self.shape, self._kind)


def _in_one_block(tif: tifffile.TiffFile, at: int, frame_bytes: int) -> bool:
    """Whether this is a stack of ImageJ: all pictures follow the tags of the first page without gaps."""
    about = tif.imagej_metadata
    if about is None:
        return False
    return len(tif.pages) == 1 or at + int(about.get("images", 1)) * frame_bytes <= tif.pages[1].offset


def _is_plain_page(page: Any) -> bool:
    """Whether a page is one uncompressed grey picture in one piece, with rows without padding."""
    starts, counts = np.array(page.dataoffsets), np.array(page.databytecounts)
    gapless = bool(np.all(starts[:-1] + counts[:-1] == starts[1:]))
    plain = page.compression == tifffile.COMPRESSION.NONE and page.fillorder == tifffile.FILLORDER.MSB2LSB
    if len(page.shape) != 2 or page.is_tiled or not plain or not gapless:
        return False
    in_rows = page.bitspersample in (8, 16) or page.shape[1] % 4 == 0
    return in_rows and int(counts.sum()) >= picture_bytes(page.shape, page.bitspersample)


def _end(page: Any) -> int:
    """Byte at which the data of a page ends."""
    return max(a + n for a, n in zip(page.dataoffsets, page.databytecounts, strict=True))


def _bit_depth(page: Any) -> int:
    """Bits of a grey value, from the maximum in the tags where it is given."""
    tag = page.tags.get(_MAX_SAMPLE_VALUE)
    if tag is not None:
        return max(1, int(np.max(tag.value)).bit_length())
    return int(page.bitspersample)


def _rate(tif: tifffile.TiffFile) -> float | None:
    """Frame rate from ImageJ's frame interval, if it is given."""
    interval = (tif.imagej_metadata or {}).get("finterval")
    return 1 / float(interval) if interval else None
