"""Writes frames to a film that other software opens: MJPEG, lossless MOV, TIFF, or a folder of PNG."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from frictrack.errors import FrictrackError

Frame = NDArray[Any]
Put = Callable[[Frame], object]


def write_film(frames: Iterable[Frame], path: str | os.PathLike[str], fps: float, quality: int = 95) -> int:
    """Write 2-D uint8 or uint16 frames to `path` and return how many; the suffix chooses the format.

    .avi: MJPEG of the given quality (1 to 100), 8 bit. .mov: lossless PNG frames, 8 bit. .tif, .tiff: uncompressed
    pages, 8 to 16 bit. No suffix: a folder of PNG files, 8 to 16 bit. Only .avi and .mov hold the frame rate
    where any reader finds it. A file appears whole or not at all.
    """
    path = Path(path)
    if path.suffix.lower() not in _WRITERS:
        known = ", ".join(suffix for suffix in _WRITERS if suffix)
        raise FrictrackError(f'{path.name}: expected a film ending in {known}, or a folder, but got "{path.suffix}"')
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise FrictrackError(f"{path.name}: expected at least one frame to write but got none")
    _check(first, path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with _whole(path) as partial, _WRITERS[path.suffix.lower()](partial, first, fps, quality) as put:
        n = 0
        for n, frame in enumerate(chain([first], frames), start=1):  # noqa: B007 - the count is the answer
            put(np.ascontiguousarray(frame))
    return n


def _check(frame: Frame, path: Path) -> None:
    if frame.ndim != 2 or frame.dtype not in (np.uint8, np.uint16):
        raise FrictrackError(
            f"{path.name}: expected grey frames of 8 or 16 bit but got shape {frame.shape} of {frame.dtype}"
        )
    if path.suffix.lower() in (".avi", ".mov") and frame.dtype != np.uint8:
        raise FrictrackError(
            f"{path.name}: expected 8-bit frames for {path.suffix} but got {frame.dtype}; write .tif or a folder of PNG"
        )


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """A neighbouring file that takes the place of `path` only when all went well; folders are filled in place."""
    if not path.suffix:
        path.mkdir(exist_ok=True)
        yield path
        return
    partial = path.with_name(f"{path.stem}.partial{path.suffix}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def _opencv(path: Path, codec: str, api: int, fps: float, frame: Frame) -> Iterator[cv2.VideoWriter]:
    """An OpenCV writer that was really opened, and a file that was really written."""
    size = (frame.shape[1], frame.shape[0])
    writer = cv2.VideoWriter(str(path), api, cv2.VideoWriter.fourcc(*codec), fps, size, True)
    if not writer.isOpened():
        raise FrictrackError(f"{path.name}: expected OpenCV to write {codec} films but it cannot here; write .tif")
    try:
        yield writer
    finally:
        writer.release()


@contextmanager
def _mjpeg(path: Path, frame: Frame, fps: float, quality: int) -> Iterator[Put]:
    # OpenCV's own MJPEG writer: FFmpeg's AVI muxer drops frames above 1000 fps and has no quality setting.
    with _opencv(path, "MJPG", cv2.CAP_OPENCV_MJPEG, fps, frame) as writer:
        writer.set(cv2.VIDEOWRITER_PROP_QUALITY, quality)
        yield lambda f: writer.write(_colour(f))


@contextmanager
def _mov(path: Path, frame: Frame, fps: float, quality: int) -> Iterator[Put]:
    # QuickTime keeps any frame rate; AVI would not (above), Matroska rounds time stamps to 1 ms.
    with _opencv(path, "png ", cv2.CAP_FFMPEG, fps, frame) as writer:
        yield lambda f: writer.write(_colour(f))


def _colour(frame: Frame) -> Frame:
    """Three equal channels: OpenCV's MJPEG writer scrambles grey frames."""
    return cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR)


@contextmanager
def _tiff(path: Path, frame: Frame, fps: float, quality: int) -> Iterator[Put]:
    with tifffile.TiffWriter(path) as writer:
        yield lambda f: writer.write(f, contiguous=True, photometric="minisblack", metadata={"fps": fps})


@contextmanager
def _folder(path: Path, frame: Frame, fps: float, quality: int) -> Iterator[Put]:
    numbers = iter(range(10**9))

    def put(f: Frame) -> None:
        name = path / f"frame_{next(numbers):06d}.png"
        if not cv2.imwrite(str(name), f):
            raise FrictrackError(f"{name}: expected to write this file but could not; check the folder and the disk")

    yield put


_WRITERS: dict[str, Callable[[Path, Frame, float, int], AbstractContextManager[Put]]] = {
    ".avi": _mjpeg,
    ".mov": _mov,
    ".tif": _tiff,
    ".tiff": _tiff,
    "": _folder,
}
