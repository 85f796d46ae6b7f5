"""Write frames to a film that other software opens: MJPEG, lossless MOV, TIFF, or a folder of PNG files."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.base.files import atomic_write

Frame = NDArray[Any]
WriteFrame = Callable[[Frame], object]


def write_film(frames: Iterable[Frame], path: str | os.PathLike[str], fps: float, quality: int = 95) -> int:
    """Write frames to a film; the suffix of the path chooses the format.

    .avi is MJPEG with 8 bit, .mov has lossless PNG frames with 8 bit, .tif and .tiff are uncompressed ImageJ stacks
    with 8 or 16 bit. A path without suffix becomes a folder of PNG files with 8 or 16 bit and no frame rate. A file
    is replaced only when all frames are written.

    Parameters
    ----------
    frames
        Pictures, each (height, width), uint8 or uint16.
    path
        File or folder to write.
    fps
        Frames per second.
    quality
        JPEG quality of .avi, 1 to 100.

    Returns
    -------
    int
        Number of frames written.

    Raises
    ------
    FrictrackError
        For an unknown suffix, no frames, frames that the format cannot hold, or a file that cannot be written.

    """
    path = Path(path)
    if path.suffix.lower() not in _WRITERS:
        known = ", ".join(suffix for suffix in _WRITERS if suffix)
        raise FrictrackError(f'{path.name}: expected a film ending in {known}, or a folder, but got "{path.suffix}"')
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise FrictrackError(f"{path.name}: expected at least one frame to write but got none")
    _check_frame(first, path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with _atomic_file(path) as part, _WRITERS[path.suffix.lower()](part, first, fps, quality) as write_frame:
        n = 0
        for n, frame in enumerate(chain([first], frames), start=1):  # noqa: B007 - the count is the answer
            write_frame(np.ascontiguousarray(frame))
    return n


def _check_frame(frame: Frame, path: Path) -> None:
    """Raise FrictrackError for a frame that the format of the path cannot hold."""
    if frame.ndim != 2 or frame.dtype not in (np.uint8, np.uint16):
        raise FrictrackError(
            f"{path.name}: expected grey frames of 8 or 16 bit but got shape {frame.shape} of {frame.dtype}"
        )
    if path.suffix.lower() in (".avi", ".mov") and frame.dtype != np.uint8:
        raise FrictrackError(
            f"{path.name}: expected 8-bit frames for {path.suffix} but got {frame.dtype}; write .tif or a folder of PNG"
        )


@contextmanager
def _atomic_file(path: Path) -> Iterator[Path]:
    """Temporary file that replaces `path` when all frames are written; folders are filled in place."""
    if not path.suffix:
        path.mkdir(exist_ok=True)
        yield path
        return
    with atomic_write(path) as part:
        yield part


@contextmanager
def _opencv(codec: str, path: Path, frame: Frame, fps: float, quality: int) -> Iterator[WriteFrame]:
    """OpenCV writer of a codec; raise FrictrackError if this OpenCV cannot open it."""
    # OpenCV's own MJPEG writer, because FFmpeg's AVI muxer drops frames above 1000 fps and has no quality setting.
    mjpeg = codec == "MJPG"
    api = cv2.CAP_OPENCV_MJPEG if mjpeg else cv2.CAP_FFMPEG
    size = (frame.shape[1], frame.shape[0])
    writer = cv2.VideoWriter(str(path), api, cv2.VideoWriter.fourcc(*codec), fps, size, mjpeg)
    if not writer.isOpened():
        raise FrictrackError(f"{path.name}: expected OpenCV to write {codec} films but it cannot here; write .tif")
    writer.set(cv2.VIDEOWRITER_PROP_QUALITY, quality)  # of MJPEG; lossless codecs have none
    try:
        # Three equal channels, because the writer of MJPEG scrambles grey frames.
        yield lambda f: writer.write(cv2.cvtColor(f, cv2.COLOR_GRAY2BGR) if mjpeg else f)
    finally:
        writer.release()


@contextmanager
def _tiff(path: Path, frame: Frame, fps: float, quality: int) -> Iterator[WriteFrame]:
    about = {"finterval": 1 / fps}
    with tifffile.TiffWriter(path, imagej=True) as writer:
        yield lambda f: writer.write(f, contiguous=True, metadata=about)


@contextmanager
def _folder(path: Path, frame: Frame, fps: float, quality: int) -> Iterator[WriteFrame]:
    numbers = iter(range(10**9))

    def write_frame(f: Frame) -> None:
        name = path / f"frame_{next(numbers):06d}.png"
        if not cv2.imwrite(str(name), f):
            raise FrictrackError(f"{name}: expected to write this file but could not; check the folder and the disk")

    yield write_frame


# QuickTime keeps any frame rate; AVI does not (above), Matroska rounds time stamps to 1 ms.
_WRITERS: dict[str, Callable[[Path, Frame, float, int], AbstractContextManager[WriteFrame]]] = {
    ".avi": partial(_opencv, "MJPG"),
    ".mov": partial(_opencv, "png "),
    ".tif": _tiff,
    ".tiff": _tiff,
    "": _folder,
}
