"""Read frames of a recording as JPEG pictures for the page."""

from __future__ import annotations

from collections import OrderedDict
from contextlib import ExitStack
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.recording import Frame, Recording, open_recording, random_access

MAX_WIDTH_PX = 1280  # wider frames are scaled down
MAX_CACHED_FRAMES = 64
JPEG_QUALITY = 88
BLACK_PERCENTILE, WHITE_PERCENTILE = 0.1, 99.9  # of the first frame, for frames of more than 8 bits
UNKNOWN_FPS = 1000.0  # 1/s: a film whose rate nobody has told yet can be looked at


class FrameImages:
    """JPEG pictures of the frames of one recording. Several threads may use it.

    Parameters
    ----------
    path : Path
        The recording.
    fps : float or None
        Frames per second; None to read it from the file.

    """

    def __init__(self, path: Path, fps: float | None) -> None:
        self._stack = ExitStack()
        recording, self.fps = _open(path, fps)
        self._recording = self._stack.enter_context(random_access(recording))
        self._lock = Lock()
        self._cache: OrderedDict[int, bytes] = OrderedDict()
        first = self._recording.frame(0)
        deep = first.dtype != np.uint8
        self._limits = tuple(np.percentile(first, (BLACK_PERCENTILE, WHITE_PERCENTILE))) if deep else (0.0, 255.0)

    @property
    def info(self) -> dict[str, Any]:
        """Properties of the film.

        Returns
        -------
        dict
            `frames`, `width` and `height` in px, and `fps`, which is None if neither the user nor the file tells it.

        """
        height, width = self._recording.shape
        return {"frames": self._recording.n_frames, "width": width, "height": height, "fps": self.fps}

    def __getitem__(self, number: int) -> tuple[int, bytes]:
        """Number and JPEG of a frame; a number outside the film is clipped."""
        number = min(max(number, 0), self._recording.n_frames - 1)
        with self._lock:
            if number not in self._cache:
                self._cache[number] = self._jpeg(self._recording.frame(number))
            self._cache.move_to_end(number)
            while len(self._cache) > MAX_CACHED_FRAMES:
                self._cache.popitem(last=False)
            return number, self._cache[number]

    def __contains__(self, number: int) -> bool:
        """Whether the picture of a frame is cached."""
        return number in self._cache

    def _jpeg(self, frame: Frame) -> bytes:
        low, high = self._limits
        if (low, high) != (0.0, 255.0):
            frame = np.clip((frame - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.uint8)
        if frame.shape[1] > MAX_WIDTH_PX:
            size = MAX_WIDTH_PX, round(frame.shape[0] * MAX_WIDTH_PX / frame.shape[1])
            frame = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        return bytes(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])

    def close(self) -> None:
        """Close the recording."""
        self._stack.close()


def _open(path: Path, fps: float | None) -> tuple[Recording, float | None]:
    """Open a recording, also one whose frame rate is unknown; return it with its rate."""
    if fps is not None:
        return open_recording(path, fps), fps
    try:
        recording = open_recording(path, None)
    except FrictrackError:  # perhaps only the rate is missing
        return open_recording(path, UNKNOWN_FPS), None
    return recording, recording.fps
