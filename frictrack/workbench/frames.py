"""Frames of a recording as pictures for the page: opened once, read at random, kept small."""

from __future__ import annotations

from collections import OrderedDict
from contextlib import ExitStack
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np

from frictrack.recording import Frame, open_recording, opened

WIDEST = 1280  # px; wider pictures are made smaller
KEPT = 64  # pictures that are at hand
QUALITY = 88  # of a JPEG
DARK, BRIGHT = 0.1, 99.9  # percentiles of the first frame that become black and white, for deep pictures


class Frames:
    """The pictures of one recording. May be asked from several threads."""

    def __init__(self, path: Path, fps: float | None) -> None:
        self._stack = ExitStack()
        self._recording = self._stack.enter_context(opened(open_recording(path, fps)))
        self._lock = Lock()
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        first = self._recording.frame(0)
        deep = first.dtype != np.uint8
        self._limits = tuple(np.percentile(first, (DARK, BRIGHT))) if deep else (0.0, 255.0)

    @property
    def told(self) -> dict[str, Any]:
        """Frames, size and frame rate of the film."""
        height, width = self._recording.shape
        return {"frames": self._recording.n_frames, "width": width, "height": height, "fps": self._recording.fps}

    def __getitem__(self, number: int) -> tuple[int, bytes]:
        """A frame's number and its JPEG; the number is brought into the film."""
        number = min(max(number, 0), self._recording.n_frames - 1)
        with self._lock:
            if number not in self._kept:
                self._kept[number] = self._picture(self._recording.frame(number))
            self._kept.move_to_end(number)
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
            return number, self._kept[number]

    def _picture(self, frame: Frame) -> bytes:
        low, high = self._limits
        if (low, high) != (0.0, 255.0):
            frame = np.clip((frame - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.uint8)
        if frame.shape[1] > WIDEST:
            size = WIDEST, round(frame.shape[0] * WIDEST / frame.shape[1])
            frame = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        return bytes(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1])

    def close(self) -> None:
        """Let go of the recording."""
        self._stack.close()
