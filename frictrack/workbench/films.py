"""The films that the page shows: those of the study, and recordings of its folder that are in no study yet.

Every film is decoded in a thread of its own, so that neither the server nor another film waits for it.
"""

from __future__ import annotations

from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

from frictrack.base.errors import FrictrackError
from frictrack.workbench import MissingError

if TYPE_CHECKING:
    from frictrack.recording import Recording

MAX_WIDTH_PX = 1280  # wider frames are scaled down
MAX_CACHED_FRAMES = 64
JPEG_QUALITY = 88
BLACK_PERCENTILE, WHITE_PERCENTILE = 0.1, 99.9  # of the first frame, for frames of more than 8 bits
UNKNOWN_FPS = 1000.0  # 1/s: a film whose rate nobody has told yet can be looked at


def _open(path: Path, fps: float | None) -> tuple[Recording, float | None]:
    """Open a recording, also one whose frame rate is unknown; return it with its rate."""
    from frictrack.recording import open_recording  # noqa: PLC0415

    if fps is not None:
        return open_recording(path, fps), fps
    try:
        recording = open_recording(path, None)
    except FrictrackError:  # perhaps only the rate is missing
        return open_recording(path, UNKNOWN_FPS), None
    return recording, recording.fps


MAX_OPEN_FILMS = 6  # the one that was not shown for the longest time is closed
MAX_FRAMES_AHEAD = 8  # decoded while a film plays
MAX_STEP = 4  # frames from one picture to the next of a film that plays


@dataclass(frozen=True)
class FilmFile:
    """A film on the disk, as it is now.

    Parameters
    ----------
    path : Path
        The recording.
    fps : float or None
        Frames per second; None if the study does not tell it.
    version : str
        Changes when the file does.

    """

    path: Path
    fps: float | None
    version: str


def film_file(path: Path, fps: float | None = None) -> FilmFile:
    """Look at a film on the disk.

    Parameters
    ----------
    path : Path
        The recording.
    fps : float, optional
        Frames per second as the study tells it.

    Raises
    ------
    MissingError
        If there is no such file.

    """
    try:
        return FilmFile(path, fps, file_version(path))
    except OSError as e:
        raise MissingError(f"expected the film {path} but it is gone; put it back or remove the run") from e


def file_version(path: Path) -> str:
    """Return a text that changes when a file does."""
    stat = path.stat()
    return f"{stat.st_mtime_ns:x}-{stat.st_size:x}"


class OpenFilm:
    """One film and the thread that decodes it. Frames that follow are decoded ahead while it plays.

    Parameters
    ----------
    file : FilmFile
        The film.

    """

    def __init__(self, file: FilmFile) -> None:
        self.file = file
        self._thread = ThreadPoolExecutor(1, f"film {file.path.name}")
        self._stack = ExitStack()
        self._recording: Recording | None = None
        self._picture = lru_cache(MAX_CACHED_FRAMES)(self._jpeg)
        self._waiting, self._last = 0, -1

    def info(self) -> Future[dict[str, Any]]:
        """`frames`, `width` and `height` in px, `fps`, None if neither study nor file tells it, and the `version`."""
        return self._thread.submit(self._info)

    def _info(self) -> dict[str, Any]:
        recording = self._opened()
        height, width = recording.shape
        sizes = {"frames": recording.n_frames, "width": width, "height": height}
        return {**sizes, "fps": self._fps, "version": self.file.version}

    def frame(self, number: int) -> Future[bytes]:
        """JPEG of a frame; a number outside the film is clipped."""
        self._waiting += 1
        return self._thread.submit(self._frame, number)

    def _frame(self, number: int) -> bytes:
        self._waiting -= 1
        found = min(max(number, 0), self._opened().n_frames - 1)
        picture = self._picture(found)
        step, self._last = found - self._last, found
        if 0 < step <= MAX_STEP:
            self._read_ahead(found + step, step, MAX_FRAMES_AHEAD)
        return picture

    def _read_ahead(self, number: int, step: int, count: int) -> None:
        """Decode one of the next frames, unless somebody waits for another one; then the one after it."""

        def decode() -> None:
            if not self._waiting and number < self._opened().n_frames:
                self._picture(number)
                self._read_ahead(number + step, step, count - 1)

        if count and not self._waiting:
            try:
                self._thread.submit(decode)
            except RuntimeError:  # the film was closed
                return

    def _opened(self) -> Recording:
        """The recording, opened when it is first needed; frames of more than 8 bits are shown by the first one."""
        if self._recording is None:
            import numpy as np  # noqa: PLC0415 - slow to load

            from frictrack.recording import random_access  # noqa: PLC0415 - loads OpenCV

            recording, self._fps = _open(self.file.path, self.file.fps)
            opened = self._stack.enter_context(random_access(recording))
            first = opened.frame(0)
            deep = first.dtype != np.uint8
            self._limits = tuple(np.percentile(first, (BLACK_PERCENTILE, WHITE_PERCENTILE))) if deep else (0.0, 255.0)
            self._recording = opened
        return self._recording

    def _jpeg(self, number: int) -> bytes:
        import cv2  # noqa: PLC0415
        import numpy as np  # noqa: PLC0415

        frame, (low, high) = self._opened().frame(number), self._limits
        if (low, high) != (0.0, 255.0):
            frame = np.clip((frame - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.uint8)
        if frame.shape[1] > MAX_WIDTH_PX:
            size = MAX_WIDTH_PX, round(frame.shape[0] * MAX_WIDTH_PX / frame.shape[1])
            frame = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        return bytes(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])

    def close(self) -> None:
        """Close the film when the frames that are waited for are decoded."""
        try:
            self._thread.submit(self._stack.close)
        except RuntimeError:
            return
        self._thread.shutdown(wait=False)


class Films:
    """The films that are open. A film whose file has changed is opened again."""

    def __init__(self) -> None:
        self._open: OrderedDict[Path, OpenFilm] = OrderedDict()
        self._lock = Lock()

    def open(self, file: FilmFile) -> OpenFilm:
        """Open a film, or find it open; the pictures are decoded when they are asked for."""
        with self._lock:
            held = self._open.get(file.path)
            if held is None or held.file != file:
                if held is not None:
                    held.close()
                held = self._open[file.path] = OpenFilm(file)
            self._open.move_to_end(file.path)
            while len(self._open) > MAX_OPEN_FILMS:
                self._open.popitem(last=False)[1].close()
            return held

    def close(self) -> None:
        """Close all films."""
        with self._lock:
            for film in self._open.values():
                film.close()
            self._open.clear()
