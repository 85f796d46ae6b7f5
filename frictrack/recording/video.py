"""Read through OpenCV: AVI, MP4 and other video containers in order, and folders of numbered pictures.

Seeking in a container can return other frames than asked for (opencv#9053): going back means opening the file again.
The number of frames is that of the packets in the file, not that of the header.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import ClassVar, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.recording.base import Frame, Header, Recording, truncation_notes

# What FFmpeg and OpenCV would say on stderr about broken files, `Recording` says in words.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
# FFmpeg goes by the content and also knows lists of other files and addresses: a film must be the film itself.
os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", "protocol_whitelist;file|format_whitelist;avi,mov,matroska")
if "OPENCV_LOG_LEVEL" not in os.environ:
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)

# Pixel formats whose first plane is the luma itself: read as it was stored, without a turn through BGR.
_LUMA_FIRST = {b"Y800": 8, b"I420": 8, b"Y42B": 8, b"Y1\x00\x10": 16}


class Video(Recording):
    """Recording in a video container (8 bit, or 16 bit grey)."""

    path: Path
    suffixes: ClassVar[tuple[str, ...]] = (".avi", ".mp4", ".mov", ".mkv", ".m4v")

    def _open(self) -> Header:
        capture = self._capture()
        promised, fps = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), capture.get(cv2.CAP_PROP_FPS)
        good, first = capture.read()
        if not good:
            raise FrictrackError(
                f"{self.path.name}: expected a film but no frame of it can be read; it is damaged or empty, "
                "copy it from the camera again"
            )
        stamps = self._stamps()
        packets = len(stamps)
        depth = 16 if first.dtype == np.uint16 else 8
        return Header(
            packets,
            first.shape[:2],
            depth,
            fps if fps > 0 else None,
            notes=truncation_notes(self.path.name, packets, promised),
            stamps=stamps,
        )

    def _read(self, indices: Iterable[int]) -> Iterator[Frame]:
        capture, at = self._capture(), -1
        for index in indices:
            while at < index:
                if not capture.grab():
                    return
                at += 1
            good, frame = capture.retrieve()
            if not good:
                return
            yield cast(Frame, frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY))

    def _capture(self) -> cv2.VideoCapture:
        # FFmpeg takes a name such as "concat:a|b.avi" for a command, but never an absolute path.
        """Open the container; luma is read as stored where possible."""
        capture = cv2.VideoCapture(str(self.path.absolute()), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            raise FrictrackError(f"{self.path.name}: expected a film but the file cannot be read as one")
        code = (int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) & 0xFFFFFFFF).to_bytes(4, "little")
        if code in _LUMA_FIRST:
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        return capture

    def _stamps(self) -> NDArray[np.float64]:
        """Presentation time of each frame, s; read from the packets without decoding."""
        capture = cv2.VideoCapture(str(self.path.absolute()), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
        stamps = []
        while capture.grab():
            stamps.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
        return np.sort(stamps)  # packets come in the order of decoding, frames in that of showing


_PICTURES = (".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg")


class Folder(Recording):
    """Recording as one picture per frame (png, tif, bmp, jpg), in the order of their numbers."""

    path: Path
    suffixes: ClassVar[tuple[str, ...]] = ()

    def _open(self) -> Header:
        self._pictures = _natural(_of_one_kind(self.path))
        if not self._pictures:
            raise FrictrackError(
                f"{self.path.name}: expected pictures ({', '.join(_PICTURES)}) in the folder but found none"
            )
        first = next((p for p in map(_load, self._pictures) if p is not None), None)
        if first is None:
            raise FrictrackError(f"{self.path.name}: none of its {len(self._pictures)} files can be read as a picture")
        ticks, notes = _ticks(self._pictures)
        depth = 8 * first.dtype.itemsize
        return Header(len(self._pictures), first.shape, depth, ticks=ticks, notes=notes)

    def _read(self, indices: Iterable[int]) -> Iterator[Frame]:
        kind = np.uint8 if self.bit_depth == 8 else np.uint16
        for index in indices:
            frame = _load(self._pictures[index])
            if frame is None:
                frame = np.zeros(self.shape, kind)
            if frame.shape != self.shape:
                raise FrictrackError(
                    f"{self.path.name}: expected pictures of {self.shape[1]}x{self.shape[0]} px but "
                    f"{self._pictures[index].name} has {frame.shape[1]}x{frame.shape[0]} px"
                )
            yield frame

    @property
    def files(self) -> list[Path]:
        """See `Recording.files`."""
        return self._pictures


def _of_one_kind(folder: Path) -> list[Path]:
    """Pictures with the most frequent suffix: a stray note.png among 4000 tif files is no frame."""
    pictures = [p for p in folder.iterdir() if p.suffix.lower() in _PICTURES]
    if not pictures:
        return []
    kind, _ = Counter(p.suffix.lower() for p in pictures).most_common(1)[0]
    return [p for p in pictures if p.suffix.lower() == kind]


def _natural(pictures: list[Path]) -> list[Path]:
    """Sort such that img_9 comes before img_10."""
    return sorted(pictures, key=lambda p: [(len(d.lstrip("0")), d.lstrip("0"), s) for s, d in _parts(p)])


def _parts(picture: Path) -> list[tuple[str, str]]:
    """Split a file name into texts and numbers."""
    return re.findall(r"(\D*)(\d*)", picture.stem)


def _ticks(pictures: list[Path]) -> tuple[NDArray[np.int64] | None, tuple[str, ...]]:
    """Frame intervals since the first picture, from the last number in each name."""
    numbers = [re.findall(r"\d+", p.stem) for p in pictures]
    if len(pictures) < 2 or not all(numbers):
        return None, ()
    steps = np.diff([int(found[-1]) for found in numbers])
    if np.any(steps <= 0):
        return None, ()
    ticks = np.concatenate([[0], np.cumsum(steps // np.gcd.reduce(steps))])
    missing = int(ticks[-1]) + 1 - len(pictures)
    if not missing:
        return None, ()
    return ticks, (f"{missing} frames are missing in the numbering of the pictures",)


def _load(picture: Path) -> Frame | None:
    """Read grey values as stored; None for a file that is no picture."""
    data = np.fromfile(picture, np.uint8)  # imread itself cannot open names outside ASCII on Windows
    if not data.size:
        return None
    try:
        return cast(Frame | None, cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH))
    except cv2.error:  # a damaged header that promises a picture of gigabytes
        return None
