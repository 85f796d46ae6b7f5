"""Read Photron recordings: pixels in an .mraw file, the header in a .cih (text) or .cihx (XML) file next to it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal
from xml.etree import ElementTree

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.recording.base import Header, truncation_notes
from frictrack.recording.byte_ranges import RangedFile, file_size
from frictrack.recording.raw import DirectRecording, PixelLayout, picture_bytes

_HEADERS = (".cihx", ".cih")
_MAX_HEADER_BYTES = 4 << 20  # bytes of a header that are read; the longest seen has 20 kB
# The same facts in both kinds of header.
_KEYS = {
    "width": ("Image Width", "imageDataInfo/resolution/width"),
    "height": ("Image Height", "imageDataInfo/resolution/height"),
    "bits": ("Color Bit", "imageDataInfo/colorInfo/bit"),
    "colour": ("Color Type", "imageDataInfo/colorInfo/type"),
    "depth": ("EffectiveBit Depth", "imageDataInfo/effectiveBit/depth"),
    "side": ("EffectiveBit Side", "imageDataInfo/effectiveBit/side"),
    "frames": ("Total Frame", "frameInfo/totalFrame"),
    "start": ("Start Frame", "frameInfo/startFrame"),
    "step": ("Save Step", "frameInfo/skipFrame"),
    "trigger": ("Correct Trigger Frame", "frameInfo/correctTriggerFrame"),
    "fps": ("Record Rate(fps)", "recordInfo/recordRate"),
    "shutter": ("Shutter Speed(s)", "recordInfo/shutterSpeed"),
    "shutter_ns": ("Shutter Type2(nsec)", "recordInfo/shutterSpeedNsec"),
    "format": ("File Format", "imageFileInfo/fileFormat"),
}

Facts = dict[str, str]


class Photron(DirectRecording):
    """Photron recording (8, 10 packed, 12 packed or 16 bit), named by its header or by its .mraw file."""

    suffixes: ClassVar[tuple[str, ...]] = (".mraw", *_HEADERS)
    reads_ranges = True

    def _open(self) -> Header:
        self._head, self._data = _header_and_data(self.path)
        facts = _read_header(self._head)
        shape, bits = self._pixels(facts)
        frame = picture_bytes(shape, bits)
        promised, size = self._whole_number(facts, "frames", 1, 1 << 40), file_size(self._data)
        count = min(promised, size // frame)
        notes = truncation_notes(self._data.name, count, promised)
        depth = self._whole_number(facts, "depth", 8, 16) if bits == 16 and "depth" in facts else bits
        high = bits == 16 and facts.get("side", "").lower() == "higher"
        layout = PixelLayout(self._data, range(0, count * frame, frame), bits, shift=bits - depth if high else 0)
        self._layout = layout if high else _in_order(layout, shape, depth)
        fps, rate_notes = _rate(facts)
        exposure, trigger = _exposure(facts), self._trigger(facts)
        return Header(
            count, shape, depth, fps, notes=notes + rate_notes, exposure=exposure, trigger=trigger, camera=True
        )

    def _pixels(self, facts: Facts) -> tuple[tuple[int, int], int]:
        """Shape (h, w) and bits of a pixel, both checked."""
        if facts.get("format", "mraw").lower() != "mraw":
            raise FrictrackError(
                f'{self._head.name}: expected the header of an mraw film but its pictures are "{facts["format"]}"; '
                "open those pictures themselves"
            )
        shape = self._whole_number(facts, "height", 1, 1 << 16), self._whole_number(facts, "width", 1, 1 << 16)
        bits, colour = self._whole_number(facts, "bits", 1, 64), facts.get("colour", "Mono")
        if bits not in (8, 10, 12, 16) or colour.lower() not in ("mono", "raw"):
            raise FrictrackError(
                f"{self._head.name}: expected grey values of 8, 10, 12 or 16 bit but got {colour} of {bits} bit; "
                "save the film as mono from the camera's software"
            )
        if shape[1] * bits % 8 or (bits == 10 and shape[1] % 4):
            raise FrictrackError(
                f"{self._head.name}: expected rows of whole bytes but got {shape[1]} px of {bits} bit; "
                "save the film with 16 bit from the camera's software"
            )
        return shape, bits

    def _whole_number(self, facts: Facts, key: str, low: int, high: int) -> int:
        """Whole number of the header within limits."""
        number = _number(facts.get(key, ""))
        if number is None or number != int(number) or not low <= number <= high:
            raise FrictrackError(
                f'{self._head.name}: expected "{_KEYS[key][0]}" as a whole number from {low} to {high} but got '
                f'"{facts.get(key, "nothing")[:40]}"; the header is damaged, copy it from the camera again'
            )
        return int(number)

    def _trigger(self, facts: Facts) -> int | None:
        """Frame at the trigger: Photron counts frames from the trigger, and the film starts at number `start`."""
        start = _number(facts.get("start", ""))
        if start is None:
            return None
        return round(((_number(facts.get("trigger", "")) or 0) - start) / _step(facts))

    @property
    def files(self) -> Sequence[Path | RangedFile]:
        """See `Recording.files`."""
        return [self._head, self._data]


def _header_and_data(path: Path | RangedFile) -> tuple[Path | RangedFile, Path | RangedFile]:
    """Header and pixel file of a recording that is named by either."""
    files_by_suffix = _neighbours(path)
    files_by_suffix[path.suffix.lower()] = path
    heads = [files_by_suffix[s] for s in _HEADERS if s in files_by_suffix]
    head = path if path.suffix.lower() in _HEADERS else heads[0] if heads else None
    if head is None:
        raise FrictrackError(
            f"{path.name}: expected its header {path.stem}.cihx or {path.stem}.cih beside it; copy both files"
        )
    if ".mraw" not in files_by_suffix:
        raise FrictrackError(f"{path.name}: expected its film {path.stem}.mraw beside it; copy both files")
    return head, files_by_suffix[".mraw"]


def _neighbours(path: Path | RangedFile) -> dict[str, Path | RangedFile]:
    """Files of the same name in the folder of a file, by suffix in small letters."""
    if isinstance(path, RangedFile):
        return {suffix: found for suffix in Photron.suffixes if (found := path.neighbour(suffix)) is not None}
    return {p.suffix.lower(): p for p in path.parent.iterdir() if p.stem == path.stem}


def _read_header(head: Path | RangedFile) -> Facts:
    """Read the header of either kind."""
    with head.open("rb") as file:
        text = file.read(_MAX_HEADER_BYTES).decode("utf-8", "replace")
    return _from_xml(head, text) if head.suffix.lower() == ".cihx" else _from_text(text)


def _from_text(text: str) -> Facts:
    """Parse `Key : value` lines up to END; after it follows the header of the film from which this one was saved."""
    lines: Facts = {}
    for line in text.splitlines():
        if line.strip() == "END":
            break
        key, colon, value = line.partition(":")
        if colon:
            lines.setdefault(key.strip(), value.strip())
    return {name: lines[key] for name, (key, _) in _KEYS.items() if lines.get(key)}


def _from_xml(head: Path | RangedFile, text: str) -> Facts:
    """Parse the XML header."""
    start, end = text.find("<cih>"), text.rfind("</cih>")
    if start < 0 or end < 0 or "<!ENTITY" in text:
        raise FrictrackError(f"{head.name}: expected a Photron header but found no <cih> in it; copy it again")
    try:
        root = ElementTree.fromstring(text[start : end + len("</cih>")])
    except ElementTree.ParseError as error:
        raise FrictrackError(f"{head.name}: expected a Photron header but its XML is damaged; copy it again") from error
    found = {name: (root.findtext(place) or "").strip() for name, (_, place) in _KEYS.items()}
    return {name: value for name, value in found.items() if value}


def _number(text: str) -> float | None:
    """A number, or a fraction such as 1/15371; None for anything else."""
    above, slash, below = text.partition("/")
    try:
        value = float(above) / float(below) if slash else float(above)
    except (ValueError, ZeroDivisionError, OverflowError):
        return None
    return value if np.isfinite(value) else None


def _step(facts: Facts) -> int:
    """Save step: number of recorded frames per frame in the file."""
    return max(1, int(_number(facts.get("step", "")) or 1))


def _rate(facts: Facts) -> tuple[float | None, tuple[str, ...]]:
    """Frame rate of this file: a film saved with a step holds only every n-th frame of the recording."""
    fps, step = _number(facts.get("fps", "")), _step(facts)
    if fps is None or fps <= 0:
        return None, ()
    if step == 1:
        return fps, ()
    note = (
        f"the header names {fps:g} fps while filming and a save step of {step}: only one frame in {step} is in "
        f"the file, so its own rate is {fps / step:g} fps"
    )
    return fps / step, (note,)


def _exposure(facts: Facts) -> float | None:
    """Exposure, s. The field "Shutter Speed(s)" holds 1/15371 or its inverse 50000.0, despite its name."""
    nanoseconds = _number(facts.get("shutter_ns", ""))
    if nanoseconds is not None and nanoseconds > 0:
        return nanoseconds * 1e-9
    value = _number(facts.get("shutter", ""))
    if value is None or value <= 0:
        return None
    return 1 / value if value > 1 else value


def _in_order(layout: PixelLayout, shape: tuple[int, int], depth: int) -> PixelLayout:
    """Layout with the byte order in which the first picture does not exceed its bit depth."""
    if layout.bits != 16 or depth == 16:
        return layout
    with layout.path.open("rb") as file:
        first = np.frombuffer(file.read(2 * shape[0] * shape[1]), "<u2")
    orders: tuple[Literal["<", ">"], ...] = ("<", ">")
    for order in orders:
        if int(first.view(np.dtype(np.uint16).newbyteorder(order)).max(initial=0)) < 1 << depth:
            return PixelLayout(layout.path, layout.offsets, layout.bits, order)
    return layout
