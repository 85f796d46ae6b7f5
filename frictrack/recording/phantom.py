"""Read Phantom recordings (.cine): frames with a time stamp and an exposure each.

Fields and offsets follow the maker's "Cine File Format" (Vision Research); all numbers are little-endian.
"""

from __future__ import annotations

import struct
from typing import Any, BinaryIO, ClassVar

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.recording.base import Header, truncation_notes
from frictrack.recording.raw import DirectRecording, PixelLayout

# Fields that are used: the header in which each lies, its byte there, and its type. A header lies at the byte of the
# file that the field of its name holds (CINEFILEHEADER, BITMAPINFOHEADER, SETUP).
_FIELDS = {
    "compression": ("file", 4, "<H"),
    "first": ("file", 16, "<i"),  # number of the first picture, counted from the trigger
    "count": ("file", 20, "<I"),
    "bitmap": ("file", 24, "<I"),
    "setup": ("file", 28, "<I"),
    "offsets": ("file", 32, "<I"),
    "trigger_time": ("file", 36, "<Q"),  # 2^-32 s
    "width": ("bitmap", 4, "<i"),
    "height": ("bitmap", 8, "<i"),
    "bit_count": ("bitmap", 14, "<H"),
    "packed": ("bitmap", 16, "<I"),
    "picture_bytes": ("bitmap", 20, "<I"),
    "rate_16": ("setup", 0, "<H"),
    "setup_bytes": ("setup", 142, "<H"),
    "rate": ("setup", 768, "<I"),
    "shutter": ("setup", 772, "<I"),
    "bits": ("setup", 896, "<I"),
}
_SHUTTER_NS = 1568  # byte of the setup, if that is so long
_PACKED = {256: 10, 1024: 12}  # biCompression: P10 (companded) and P12L (linear)
_STAMPS, _EXPOSURES = 1002, 1003  # tagged blocks: time and exposure of each picture, in 2^-32 s
_MAX_BLOCKS = 100


CineHeader = dict[str, int]


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
        file.seek(0)
        if file.read(2) != b"CI":
            raise FrictrackError(f"{self.path.name}: expected a Phantom film but the file cannot be read as one")
        head = _read_header(file)
        height, width, bits = self._pixels(head)
        padded = 4 if head["picture_bytes"] != abs(height) * width * bits // 8 and not head["packed"] else 1
        layout = PixelLayout(self.path, range(0), bits, padded=padded)
        offsets = _offsets(file, head, layout.pitch(width) * abs(height), size)
        notes = truncation_notes(self.path.name, len(offsets), head["count"])
        self._layout = PixelLayout(
            self.path,
            offsets,
            bits,
            upward=height > 0 and not head["packed"],  # packed pictures are always stored from the top
            padded=padded,
            table=_LINEAR_12_BIT if bits == 10 else None,
        )
        blocks = _blocks(file, head, size)
        return Header(
            len(offsets),
            (abs(height), width),
            self._depth(head, bits),
            float(head["rate"] or head["rate_16"]) or None,
            notes=notes,
            stamps=_stamps(blocks.get(_STAMPS), head, len(offsets)),
            exposure=_exposure(blocks.get(_EXPOSURES), head),
            trigger=-head["first"],
            camera=True,
        )

    def _pixels(self, head: CineHeader) -> tuple[int, int, int]:
        """Height (negative: stored from the top), width and bits of a pixel, all checked."""
        bits = _PACKED.get(head["packed"], head["bit_count"])
        if bits not in (8, 10, 12, 16) or head["compression"] not in (0, 2) or head["packed"] not in (0, *_PACKED):
            raise FrictrackError(
                f"{self.path.name}: expected uncompressed grey values of 8, 10, 12 or 16 bit but got "
                f"{head['bit_count']} bit, compression {head['compression']}; "
                "save the film as raw cine from the camera's software"
            )
        if not (0 < abs(head["height"]) <= 1 << 16 and 0 < head["width"] <= 1 << 16):
            raise FrictrackError(
                f"{self.path.name}: expected pictures of 1 to 65536 px but got {head['width']}x{head['height']} px; "
                "the header is damaged, copy the film from the camera again"
            )
        if bits in (10, 12) and head["width"] % 4:
            raise FrictrackError(
                f"{self.path.name}: expected packed rows of a multiple of 4 px but got {head['width']} px; "
                "save the film unpacked from the camera's software"
            )
        return head["height"], head["width"], bits

    def _depth(self, head: CineHeader, bits: int) -> int:
        """Bit depth of the grey values."""
        if bits != 16:
            return 12 if bits == 10 else bits
        return head["bits"] if 8 < head["bits"] <= 16 else 16


def _read_header(file: BinaryIO) -> CineHeader:
    """Read the headers; raises `struct.error` where the file is too short."""
    head = {"file": 0}
    for name, (part, at, kind) in _FIELDS.items():
        head[name] = _number(file, head[part] + at, kind)
    is_long = head["setup_bytes"] >= _SHUTTER_NS + 4
    head["shutter_ns"] = _number(file, head["setup"] + _SHUTTER_NS, "<I") if is_long else 0
    return head


def _number(file: BinaryIO, at: int, kind: str) -> int:
    """Read one number of the struct type `kind` at a byte of the file."""
    file.seek(at)
    return int(struct.unpack(kind, file.read(struct.calcsize(kind)))[0])


def _offsets(file: BinaryIO, head: CineHeader, picture: int, size: int) -> NDArray[np.int64]:
    """Bytes at which complete pictures start, up to the first incomplete one."""
    most = min(head["count"], max(0, size - head["offsets"]) // 8)
    file.seek(head["offsets"])
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


def _blocks(file: BinaryIO, head: CineHeader, size: int) -> dict[int, NDArray[Any]]:
    """Tagged blocks of time stamps and exposures, as stored."""
    found: dict[int, NDArray[Any]] = {}
    at = head["setup"] + head["setup_bytes"]
    for _ in range(_MAX_BLOCKS):
        if at + 8 > min(size, head["offsets"]):
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


def _stamps(block: NDArray[Any] | None, head: CineHeader, count: int) -> NDArray[np.float64] | None:
    """Times of the pictures from the trigger, s; NaN where none was written."""
    if block is None or len(block) < 2:
        return None
    stored = block[:count]
    stamps = np.full(count, np.nan)
    # In 2^-32 s since 1970. Subtracted as whole numbers: a float has no room for years and microseconds.
    since = (stored - np.uint64(head["trigger_time"])).astype(np.int64)
    stamps[: len(stored)] = np.where(stored == 0, np.nan, since * 2.0**-32)
    return stamps


def _exposure(block: NDArray[Any] | None, head: CineHeader) -> float | None:
    """Exposure, s: the median of the pictures, else the setting of the camera."""
    if block is not None and len(block) and np.median(block) > 0:
        return float(np.median(block)) * 2.0**-32
    return (head["shutter_ns"] * 1e-9 or head["shutter"] * 1e-6) or None


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
