"""The interface of all recordings; a file format adds `_open` and `_read`."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.base.files import hash_files
from frictrack.recording.byte_ranges import RangedFile, file_size, identify
from frictrack.recording.timebase import Header, audit

Frame = NDArray[np.unsignedinteger[Any]]  # (h, w) grey values, uint8 or uint16

_SAMPLED_BYTES = 1 << 20  # bytes of the head, the middle and the tail of a file in `sampled_hash`


class Recording(ABC):
    """High-speed recording: frames on demand with their true times, never all in memory.

    Attributes
    ----------
    path : Path or RangedFile
        File or folder.
    fps : float
        Frame rate, 1/s.
    n_frames : int
        Number of frames.
    shape : tuple of int
        Height and width, px.
    bit_depth : int
        Bits of a grey value.
    t : array (n_frames,)
        Time from the first frame, s.
    notes : tuple of str
        Findings about the file.
    exposure : float or None
        Exposure time, s.
    stamps : array (n_frames,) or None
        Time stamps in the file, s.
    clocked : bool
        Whether the time stamps are the times of the frames: those of a camera, or uneven ones of a container.
    trigger : int or None
        Number of the frame at the trigger.
    timebase : Timebase
        Audit of the time base.
    direct : bool
        Whether any part of any frame can be read at once; see `random_access` for other recordings.

    """

    suffixes: ClassVar[tuple[str, ...]]
    reads_ranges: ClassVar[bool] = False  # it opens remote files that are read in parts
    direct: bool = False
    _kept: NDArray[np.int64] | None = None  # frames of the file that are frames of the film (None: all)

    def __init__(self, path: str | Path | RangedFile, fps: float | None = None) -> None:
        self.path = path if isinstance(path, RangedFile) else Path(path)
        header = self._open()
        self._check(header)
        self.timebase = audit(self.path.name, fps, header)
        self.fps, self.t, self._kept = self.timebase.fps, self.timebase.t, self.timebase.kept
        self.n_frames, self.shape, self.bit_depth = len(self.t), header.shape, header.bit_depth
        self.notes = header.notes + self.timebase.notes
        self.exposure = header.exposure
        self.stamps = header.stamps if self._kept is None or header.stamps is None else header.stamps[self._kept]
        self.clocked = (header.camera and header.stamps is not None) or self.timebase.uneven
        self.trigger = header.trigger

    @abstractmethod
    def _open(self) -> Header:
        """Read the header of the file; raise `FrictrackError` for another format."""

    @abstractmethod
    def _read(self, indices: Iterable[int]) -> Iterator[Frame]:
        """Yield the frames of these rising indices; stop where the file breaks off.

        A single picture that cannot be decoded is black; later frames follow.
        """

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[Frame]:
        """Yield frames in order.

        Parameters
        ----------
        start, stop, step : int
            First frame, end (exclusive) and stride, as in `slice`.

        Yields
        ------
        array (h, w)
            uint8 or uint16.

        """
        return self._read(self._in_file(range(self.n_frames)[start:stop:step]))

    def pick(self, indices: Iterable[int]) -> list[Frame]:
        """Read some frames in one pass over the file.

        Parameters
        ----------
        indices : iterable of int
            Rising numbers of frames.

        Returns
        -------
        list of array (h, w)
            uint8 or uint16; shorter where the file breaks off.

        """
        return list(self._read(self._in_file(indices)))

    def frame(self, i: int) -> Frame:
        """Read one frame.

        Parameters
        ----------
        i : int
            Number of the frame; negative numbers count from the end.

        Returns
        -------
        array (h, w)
            uint8 or uint16.

        Raises
        ------
        FrictrackError
            For a frame that does not exist or cannot be read.

        """
        if not -self.n_frames <= i < self.n_frames:
            raise FrictrackError(f"{self.path.name}: expected a frame from 0 to {self.n_frames - 1} but got {i}")
        for frame in self._read(self._in_file([i % self.n_frames])):
            return frame
        raise FrictrackError(self._breaks_off(i))

    def cut(self, indices: Sequence[int] | NDArray[Any], corners: NDArray[Any], size: tuple[int, int]) -> Frame:
        """Cut boxes out of frames.

        This is fast only if the recording is `direct`; otherwise the indices must rise and whole frames are decoded.

        Parameters
        ----------
        indices : array of int (n,)
            Numbers of the frames.
        corners : array of int (n, 2)
            Upper left pixels (x, y) of the boxes.
        size : tuple of int
            Height and width of the boxes, px.

        Returns
        -------
        array (n, h, w)
            uint8 or uint16.

        Raises
        ------
        FrictrackError
            Where a frame or a box is outside the film.

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
        """Check boxes against the film: indices (n,) in the file and corners (n, 2)."""
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
        """Error message for a truncated file."""
        return (
            f"{self.path.name}: frame {i} cannot be read, the file breaks off before it; "
            "copy the recording from the camera again"
        )

    @property
    def hash(self) -> str:
        """SHA-256 over every byte of the recording's files; see `frictrack.base.files.hash_files`.

        Of a remote film that is read in parts, it is what the store states; see `recording.byte_ranges`. Raises
        `FrictrackError` where a file has vanished since it was opened, or cannot be read.
        """
        return self.read_hash()

    def read_hash(self, *, reread: bool = False) -> str:
        """Compute `hash`.

        Parameters
        ----------
        reread : bool
            Read the files even if the hash of their present state is known.

        """
        with self._still_there():
            remote = [file for file in self.files if isinstance(file, RangedFile)]
            local = [file for file in self.files if isinstance(file, Path)]
            return identify(remote) if remote else hash_files(local, reread=reread)

    @property
    def sampled_hash(self) -> str:
        """SHA-256 over names, sizes and the first, middle and last megabyte: what results up to November 2026 hold."""
        digest = hashlib.sha256()
        with self._still_there():
            for file in self.files:
                size = file_size(file)
                digest.update(f"{file.name}:{size}\n".encode())
                with file.open("rb") as stream:
                    for at in sorted({0, max(0, size // 2 - _SAMPLED_BYTES // 2), max(0, size - _SAMPLED_BYTES)}):
                        stream.seek(at)
                        digest.update(stream.read(_SAMPLED_BYTES))
        return digest.hexdigest()

    @contextmanager
    def _still_there(self) -> Iterator[None]:
        """Turn an `OSError` into a `FrictrackError`."""
        try:
            yield
        except OSError as e:
            raise FrictrackError(
                f"{self.path.name}: expected the recording that was opened but it cannot be read any more "
                f"({e.strerror or e}); is the disk still there?"
            ) from e

    @property
    def files(self) -> Sequence[Path | RangedFile]:
        """All files of the recording, in their order: header and frames of a camera's format, pictures of a folder."""
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


def truncation_notes(name: str, found: int, promised: int) -> tuple[str, ...]:
    """Return a note if frames are missing at the end of a file; raise `FrictrackError` if all are."""
    if not found:
        raise FrictrackError(
            f"{name}: truncated film: none of its {promised} frames is complete; copy it from the camera again"
        )
    return (f"truncated film: {found} of {promised} promised frames are in the file",) * (found < promised)


def grey(picture: NDArray[Any]) -> Frame:
    """Convert a picture to grey values (luma of ITU-R BT.601).

    Examples
    --------
    >>> grey(np.array([[[255, 0, 0]]], np.uint8)).tolist()
    [[76]]

    """
    if picture.ndim == 2:
        return picture
    luma = picture[..., :3] @ np.array([0.299, 0.587, 0.114])
    return np.rint(luma).astype(picture.dtype)


class RecordingView(Recording):
    """Frames of another recording, with random access."""

    suffixes: ClassVar[tuple[str, ...]] = ()

    def __init__(self, source: Recording) -> None:
        self.__dict__.update({k: v for k, v in vars(source).items() if not k.startswith("_")})
        self._source, self.direct = source, True

    @property
    def files(self) -> Sequence[Path | RangedFile]:
        """See `Recording.files`."""
        return self._source.files

    def _open(self) -> Any:
        raise NotImplementedError("a view is made of an open recording")


class FrameRange(RecordingView):
    """The frames `start` to `stop` (exclusive) of a recording with random access; they are counted from 0.

    Parameters
    ----------
    source : Recording
        Recording with random access.
    start, stop : int
        First frame and end (exclusive).

    """

    def __init__(self, source: Recording, start: int, stop: int) -> None:
        super().__init__(source)
        self._start = start
        self.t = source.t[start:stop]
        self.n_frames, self.notes = len(self.t), ()
        self.stamps = None if source.stamps is None else source.stamps[start:stop]

    def cut(self, indices: Sequence[int] | NDArray[Any], corners: NDArray[Any], size: tuple[int, int]) -> Frame:
        """Cut boxes out of frames; see `Recording.cut`."""
        return self._source.cut(np.asarray(indices, np.int64) + self._start, corners, size)

    def _read(self, indices: Iterable[int]) -> Iterator[Frame]:
        for index in indices:
            yield self._source.frame(index + self._start)
