"""Some neighbouring frames of a recording, as a recording of its own."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from frictrack.recording.base import Frame, Recording
from frictrack.recording.byte_ranges import RangedFile


class FrameRange(Recording):
    """The frames `start` to `stop` (exclusive) of a recording with random access; they are counted from 0.

    Parameters
    ----------
    source : Recording
        Recording with random access.
    start, stop : int
        First frame and end (exclusive).

    """

    suffixes: ClassVar[tuple[str, ...]] = ()

    def __init__(self, source: Recording, start: int, stop: int) -> None:
        self.__dict__.update({k: v for k, v in vars(source).items() if not k.startswith("_")})
        self._source, self._start = source, start
        self.t = source.t[start:stop]
        self.n_frames, self.notes, self.direct = len(self.t), (), True
        self.stamps = None if source.stamps is None else source.stamps[start:stop]

    @property
    def files(self) -> Sequence[Path | RangedFile]:
        """See `Recording.files`."""
        return self._source.files

    def cut(self, indices: Sequence[int] | NDArray[Any], corners: NDArray[Any], size: tuple[int, int]) -> Frame:
        """Cut boxes out of frames; see `Recording.cut`."""
        return self._source.cut(np.asarray(indices, np.int64) + self._start, corners, size)

    def _open(self) -> Any:
        raise NotImplementedError("a range of frames is made of an open recording")

    def _read(self, indices: Iterable[int]) -> Iterator[Frame]:
        for index in indices:
            yield self._source.frame(index + self._start)
