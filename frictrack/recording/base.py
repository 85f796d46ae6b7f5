"""What every recording offers, whatever its file format: a format adds `_open` and `_read`."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from frictrack.errors import FrictrackError
from frictrack.recording.header import Header
from frictrack.recording.timebase import audit

Frame = NDArray[np.unsignedinteger[Any]]  # (h, w) grey values, uint8 or uint16

_HASHED_BYTES = 1 << 20  # bytes hashed at the head, in the middle and at the tail of a file


class Recording(ABC):
    """A high-speed recording: frames on demand with their true times, never all in memory.

    Attributes: `path`, `fps` (1/s), `n_frames`, `shape` (h, w), `bit_depth`, `t` (n_frames,) in s from the
    first frame, `notes` (findings about the file, in words), `exposure` (s) or None, `stamps` (n_frames,) in s or None
    (the file's own; `clocked`: the camera wrote them, not a container), `trigger` (number of the frame at the trigger)
    or None, `timebase` (the audit of the time base: `rows` to print), `direct`: True where any part of any frame can
    be read at once (see `opened` for the others).
    """

    suffixes: ClassVar[tuple[str, ...]]
    direct: bool = False
    interframe: bool = False  # its codec predicts pictures from one another: some frames are coded anew (key frames)
    _kept: NDArray[np.int64] | None = None  # frames of the file that are frames of the film (None: all)

    def __init__(self, path: str | Path, fps: float | None = None) -> None:
        self.path = Path(path)
        header = self._open()
        self._check(header)
        self.timebase = audit(self.path.name, fps, header)
        self.fps, self.t, self._kept = self.timebase.fps, self.timebase.t, self.timebase.kept
        self.n_frames, self.shape, self.bit_depth = len(self.t), header.shape, header.bit_depth
        self.notes = header.notes + self.timebase.notes
        self.exposure = header.exposure
        self.stamps = header.stamps if self._kept is None or header.stamps is None else header.stamps[self._kept]
        self.clocked = header.camera and header.stamps is not None
        self.trigger = header.trigger

    @abstractmethod
    def _open(self) -> Header:
        """Look at the file; raise `FrictrackError` when it is not of this format."""

    @abstractmethod
    def _read(self, indices: Iterable[int]) -> Iterator[Frame]:
        """The frames of these rising indices, one by one; stop early where the file breaks off.

        A single picture that cannot be decoded is returned black, the frames after it go on.
        """

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[Frame]:
        """Frames `start` to `stop` (exclusive) in order, each (h, w) uint8 or uint16."""
        return self._read(self._in_file(range(self.n_frames)[start:stop:step]))

    def pick(self, indices: Iterable[int]) -> list[Frame]:
        """The frames of these rising `indices`, in one pass over the file."""
        return list(self._read(self._in_file(indices)))

    def frame(self, i: int) -> Frame:
        """Frame `i`, (h, w) uint8 or uint16; negative `i` counts from the end."""
        if not -self.n_frames <= i < self.n_frames:
            raise FrictrackError(f"{self.path.name}: expected a frame from 0 to {self.n_frames - 1} but got {i}")
        for frame in self._read(self._in_file([i % self.n_frames])):
            return frame
        raise FrictrackError(self._breaks_off(i))

    def cut(self, indices: Sequence[int] | NDArray[Any], corners: NDArray[Any], size: tuple[int, int]) -> Frame:
        """Boxes (n, h, w) of `size` (h, w) px, uint8 or uint16, out of the frames `indices` (n,).

        `corners` (n, 2) are the whole x and y of the upper left pixels; every box lies inside the picture. Quick
        only where `direct`; elsewhere the indices rise and whole frames are decoded. Raises `FrictrackError` where
        a frame or a box is not in the film.
        """
        indices, corners = self._boxes(indices, corners, size)
        out = np.empty((len(indices), *size), np.uint8 if self.bit_depth <= 8 else np.uint16)
        done = 0
        for target, frame, (x, y) in zip(out, self._read(indices.tolist()), corners.tolist(), strict=False):
            target[...] = frame[y : y + size[0], x : x + size[1]]
            done += 1
        if done < len(indices):
            raise FrictrackError(self._breaks_off(int(indices[done])))
        return out

    def _boxes(
        self, indices: Sequence[int] | NDArray[Any], corners: NDArray[Any], size: tuple[int, int]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Indices (n,) in the file and corners (n, 2) as whole numbers, checked against the film."""
        indices, corners = np.asarray(indices, np.int64), np.asarray(corners, np.int64).reshape(-1, 2)
        if len(indices) != len(corners):
            raise FrictrackError(f"expected one corner per frame but got {len(corners)} for {len(indices)} frames")
        if len(indices) and (indices.min() < 0 or indices.max() >= self.n_frames):
            worst = indices.min() if indices.min() < 0 else indices.max()
            raise FrictrackError(f"{self.path.name}: expected a frame from 0 to {self.n_frames - 1} but got {worst}")
        room = np.array([self.shape[1] - size[1], self.shape[0] - size[0]])
        outside = np.any((corners < 0) | (corners > room), axis=1)
        if np.any(outside):
            x, y = corners[outside][0]
            raise FrictrackError(
                f"{self.path.name}: expected boxes inside the picture of {self.shape[1]}x{self.shape[0]} px but got "
                f"{size[1]}x{size[0]} px at {x}, {y}"
            )
        return indices if self._kept is None else self._kept[indices], corners

    def _in_file(self, indices: Iterable[int]) -> Iterable[int]:
        """Numbers in the file of these frames of the film."""
        return indices if self._kept is None else self._kept[list(indices)].tolist()

    def _breaks_off(self, i: int) -> str:
        return (
            f"{self.path.name}: frame {i} cannot be read, the file breaks off before it; "
            "copy the recording from the camera again"
        )

    @property
    def hash(self) -> str:
        """SHA-256 over names, sizes and the first, middle and last megabyte of the recording's files.

        Raises `FrictrackError` where one has vanished since it was opened, or cannot be read.
        """
        digest = hashlib.sha256()
        try:
            for file in self._files():
                size = file.stat().st_size
                digest.update(f"{file.name}:{size}\n".encode())
                with file.open("rb") as stream:
                    for at in sorted({0, max(0, size // 2 - _HASHED_BYTES // 2), max(0, size - _HASHED_BYTES)}):
                        stream.seek(at)
                        digest.update(stream.read(_HASHED_BYTES))
        except OSError as e:
            raise FrictrackError(
                f"{self.path.name}: expected the recording that was opened but it cannot be read any more "
                f"({e.strerror or e}); is the disk still there?"
            ) from e
        return digest.hexdigest()

    def _files(self) -> list[Path]:
        return [self.path]

    def _check(self, header: Header) -> None:
        name = self.path.name
        if header.n_frames == 1:
            raise FrictrackError(
                f"{name}: expected a recording of many frames but got one frame; motion needs at least two"
            )
        if min(header.shape) < 8:
            h, w = header.shape
            raise FrictrackError(f"{name}: expected pictures of at least 8x8 px but got {w}x{h} px")

    def __len__(self) -> int:
        return self.n_frames

    def __repr__(self) -> str:
        h, w = self.shape
        return f"<{self.path.name}: {self.n_frames} frames {w}x{h} px, {self.bit_depth} bit, {self.fps:g} fps>"


def grey(picture: NDArray[Any]) -> Frame:
    """Grey values of a picture (h, w) or (h, w, 3 or 4) in R, G, B order: luma of ITU-R BT.601."""
    if picture.ndim == 2:
        return picture
    luma = picture[..., :3] @ np.array([0.299, 0.587, 0.114])
    return np.rint(luma).astype(picture.dtype)
