"""Read Phantom recordings (.cine): frames with a time stamp and an exposure each.

Fields and offsets follow the maker's "Cine File Format" (Vision Research); all numbers are little-endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, BinaryIO, ClassVar

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.recording.base import Header
from frictrack.recording.raw import DirectRecording, PixelLayout

_FILE = struct.Struct("<2sHHHiIiIIIIQ")  # CINEFILEHEADER
_BITMAP = struct.Struct("<IiiHHIIiiII")  # BITMAPINFOHEADER
_PACKED = {256: 10, 1024: 12}  # biCompression: P10 (companded) and P12L (linear)
# SETUP: place and type of what is used, and the length from which on a setup has it
_SETUP = {"rate_16": (0, "<H"), "rate": (768, "<I"), "shutter": (772, "<I"), "bits": (896, "<I")}
_SHUTTER_NS = (1568, "<I")
_STAMPS, _EXPOSURES = 1002, 1003  # tagged blocks: time and exposure of each picture, in 2^-32 s
_MAX_BLOCKS = 100


class Phantom(DirectRecording):
    """Phantom recording (8 bit, 10 bit packed and companded, 12 bit packed, 16 bit)."""

    suffixes: ClassVar[tuple[str, ...]] = (".cine",)
    reads_ranges = True

    def _open(self) -> Header:
        with self.path.open("rb") as file:
            size = file.seek(0, 2)
            try:
                return self._header(file, size)
            except struct.error as error:
                raise FrictrackError(
                    f"{self.path.name}: expected a Phantom film but the file breaks off in its header; copy it again"
                ) from error

    def _header(self, file: BinaryIO, size: int) -> Header:
        head = _CineHeader.read(file)
        if head.mark != b"CI":
            raise FrictrackError(f"{self.path.name}: expected a Phantom film but the file cannot be read as one")
        height, width, bits = self._pixels(head)
        padded = 4 if head.picture_bytes != abs(height) * width * bits // 8 and not head.packed else 1
        layout = PixelLayout(self.path, range(0), bits, padded=padded)
        offsets = _offsets(file, head, layout.pitch(width) * abs(height), size)
        if not len(offsets):
            raise FrictrackError(
                f"{self.path.name}: truncated film: none of its {head.count} frames is complete; "
                "copy it from the camera again"
            )
        notes: tuple[str, ...] = ()
        if len(offsets) < head.count:
            notes = (f"truncated film: {len(offsets)} of {head.count} promised frames are in the file",)
        self._layout = PixelLayout(
            self.path,
            offsets,
            bits,
            upward=height > 0 and not head.packed,  # packed pictures are always stored from the top
            padded=padded,
            table=_LINEAR_12_BIT if bits == 10 else None,
        )
        blocks = _blocks(file, head, size)
        return Header(
            len(offsets),
            (abs(height), width),
            self._depth(head, bits),
            head.rate,
            notes=notes,
            stamps=_stamps(blocks.get(_STAMPS), head, len(offsets)),
            exposure=_exposure(blocks.get(_EXPOSURES), head),
            trigger=-head.first,
            camera=True,
        )

    def _pixels(self, head: _CineHeader) -> tuple[int, int, int]:
        """Height (negative: stored from the top), width and bits of a pixel, all checked."""
        bits = _PACKED.get(head.packed, head.bit_count)
        if bits not in (8, 10, 12, 16) or head.compression not in (0, 2) or head.packed not in (0, *_PACKED):
            raise FrictrackError(
                f"{self.path.name}: expected uncompressed grey values of 8, 10, 12 or 16 bit but got {head.bit_count} "
                f"bit, compression {head.compression}; save the film as raw cine from the camera's software"
            )
        if not (0 < abs(head.height) <= 1 << 16 and 0 < head.width <= 1 << 16):
            raise FrictrackError(
                f"{self.path.name}: expected pictures of 1 to 65536 px but got {head.width}x{head.height} px; "
                "the header is damaged, copy the film from the camera again"
            )
        if bits in (10, 12) and head.width % 4:
            raise FrictrackError(
                f"{self.path.name}: expected packed rows of a multiple of 4 px but got {head.width} px; "
                "save the film unpacked from the camera's software"
            )
        return head.height, head.width, bits

    def _depth(self, head: _CineHeader, bits: int) -> int:
        """Bit depth of the grey values."""
        if bits != 16:
            return 12 if bits == 10 else bits
        return head.setup["bits"] if 8 < head.setup["bits"] <= 16 else 16


@dataclass(frozen=True)
class _CineHeader:
    """Used fields of the file, bitmap and setup headers."""

    mark: bytes
    compression: int
    first: int  # number of the first picture, counted from the trigger
    count: int
    off_setup: int
    off_offsets: int
    trigger_time: int  # 2^-32 s
    width: int
    height: int
    bit_count: int
    packed: int
    picture_bytes: int
    setup_bytes: int
    setup: dict[str, int]

    @classmethod
    def read(cls, file: BinaryIO) -> _CineHeader:
        """Read the headers; raises `struct.error` where the file is too short."""
        file.seek(0)
        fields = _FILE.unpack(file.read(_FILE.size))
        off_bitmap, off_setup, off_offsets = fields[8:11]
        file.seek(off_bitmap)
        bitmap = _BITMAP.unpack(file.read(_BITMAP.size))
        length = _number(file, off_setup + 142, "<H")
        setup = {name: _number(file, off_setup + at, kind) for name, (at, kind) in _SETUP.items()}
        at, kind = _SHUTTER_NS
        setup["shutter_ns"] = _number(file, off_setup + at, kind) if length >= at + 4 else 0
        return cls(
            fields[0], fields[2], fields[6], fields[7], off_setup, off_offsets, fields[11],
            bitmap[1], bitmap[2], bitmap[4], bitmap[5], bitmap[6], length, setup,
        )  # fmt: skip

    @property
    def rate(self) -> float | None:
        """Frame rate that the camera was set to, 1/s."""
        return float(self.setup["rate"] or self.setup["rate_16"]) or None


def _number(file: BinaryIO, at: int, kind: str) -> int:
    """Read one number of the struct type `kind` at a byte of the file."""
    file.seek(at)
    return int(struct.unpack(kind, file.read(struct.calcsize(kind)))[0])


def _offsets(file: BinaryIO, head: _CineHeader, picture: int, size: int) -> NDArray[np.int64]:
    """Bytes at which complete pictures start, up to the first incomplete one."""
    most = min(head.count, max(0, size - head.off_offsets) // 8)
    file.seek(head.off_offsets)
    places = np.frombuffer(file.read(8 * most), "<i8")
    if not most or not 0 <= places[0] <= size - 4:
        return np.empty(0, np.int64)
    # An annotation precedes each picture; its first number is its length, which is the same for all pictures.
    annotation = _number(file, int(places[0]), "<I")
    whole = (places >= 0) & (places <= size - picture - annotation)
    if size < picture + annotation or annotation < 8:
        return np.empty(0, np.int64)
    count = len(whole) if whole.all() else int(np.argmin(whole))
    return places[:count] + annotation


def _blocks(file: BinaryIO, head: _CineHeader, size: int) -> dict[int, NDArray[Any]]:
    """Tagged blocks of time stamps and exposures, as stored."""
    found: dict[int, NDArray[Any]] = {}
    at = head.off_setup + head.setup_bytes
    for _ in range(_MAX_BLOCKS):
        if at + 8 > min(size, head.off_offsets):
            break
        file.seek(at)
        length, tag, more = struct.unpack("<IHH", file.read(8))
        if length < 8 or at + length > size:
            break
        if tag in (_STAMPS, _EXPOSURES):
            kind = np.dtype("<u8" if tag == _STAMPS else "<u4")
            found[tag] = np.frombuffer(file.read((length - 8) // kind.itemsize * kind.itemsize), kind)
        if not more:
            break
        at += length
    return found


def _stamps(block: NDArray[Any] | None, head: _CineHeader, count: int) -> NDArray[np.float64] | None:
    """Times of the pictures from the trigger, s; NaN where none was written."""
    if block is None or len(block) < 2:
        return None
    stored = block[:count]
    stamps = np.full(count, np.nan)
    # In 2^-32 s since 1970. Subtracted as whole numbers: a float has no room for years and microseconds.
    since = (stored - np.uint64(head.trigger_time)).astype(np.int64)
    stamps[: len(stored)] = np.where(stored == 0, np.nan, since * 2.0**-32)
    return stamps


def _exposure(block: NDArray[Any] | None, head: _CineHeader) -> float | None:
    """Exposure, s: the median of the pictures, else the setting of the camera."""
    if block is not None and len(block) and np.median(block) > 0:
        return float(np.median(block)) * 2.0**-32
    return (head.setup["shutter_ns"] * 1e-9 or head.setup["shutter"] * 1e-6) or None


def _linearisation_table() -> NDArray[np.uint16]:
    """Grey values of 12 bit for the 1024 codes of the packed 10 bit format.

    The camera compands 12 bit to 10 by the transfer curve of ITU-R BT.709 above its black level of 64, so that a code
    is
    about as wide as the shot noise. This is the inverse curve. From code 1 on it is within one count of the maker's
    printed
    table, whose neighbouring codes differ by one to nine counts. White (4095) is every code above 1014.
    """
    a, b = 0.0992965, 0.0180539  # BT.709 with the digits that make it smooth
    code = np.arange(1024)
    signal = (code - 64) / 952.75
    light = np.where(signal < 4.5 * b, signal / 4.5, (np.maximum(signal + a, a) / (1 + a)) ** (1 / 0.45))
    return np.where(code > 1014, 4095, np.clip(np.rint(64.5 + 4024 * light), 0, 4095)).astype(np.uint16)


_LINEAR_12_BIT = _linearisation_table()
