"""Find the regular grid of frames of a record with missing frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frictrack.errors import FrictrackError
from frictrack.records import Array
from frictrack.sampling import base_interval

MAX_UNEVENNESS = 0.01  # error of a time stamp over the frame interval
MAX_FRAMES_PER_ROW = 100  # with more missing frames a time stamp must be wrong


@dataclass(frozen=True)
class FrameGrid:
    """Frame number of each row (n,), from 0, and the frame interval (s)."""

    frames: NDArray[np.int64]
    interval: float

    @property
    def n(self) -> int:
        """Frames from the first row to the last, missing ones included."""
        return int(self.frames[-1]) + 1

    def to_frames(self, column: Array, empty: float = 0.0) -> Array:
        """Put a column of rows (n,) on the grid; missing frames get `empty`."""
        out = np.full(self.n, empty)
        out[self.frames] = column
        return out

    def to_rows(self, series: Array) -> Array:
        """Take the rows (..., n) of a series of all frames (..., N)."""
        return series if len(self.frames) == self.n else series[..., self.frames]


def frame_grid(t: Array) -> FrameGrid:
    """Find the frame number of each time stamp.

    Parameters
    ----------
    t
        Time stamps, s, (n,), increasing.

    Returns
    -------
    FrameGrid
        Frame numbers and frame interval.

    Raises
    ------
    FrictrackError
        If an interval is not a multiple (within 1 %) of the usual one, or so long that a time stamp must be wrong.

    Examples
    --------
    >>> frame_grid(np.array([0.0, 0.1, 0.2, 0.4])).frames.tolist()
    [0, 1, 2, 4]

    """
    gaps = np.diff(t) / (base_interval(t) or np.median(np.diff(t)))
    steps = np.rint(gaps)
    off = np.where(steps < 1, np.inf, np.abs(gaps - steps))
    if np.max(off) > MAX_UNEVENNESS:
        i = int(np.argmax(off > MAX_UNEVENNESS))
        raise FrictrackError(
            f"time: expected evenly spaced frames but the interval after t = {t[i]:g} s is {gaps[i]:.4g} times "
            "the usual one; give the frame rate, or time stamps in which missing frames leave whole gaps"
        )
    if np.sum(steps) > MAX_FRAMES_PER_ROW * len(t):
        i = int(np.argmax(gaps))
        raise FrictrackError(
            f"time: expected few missing frames but {gaps[i]:.3g} frame intervals pass between t = {t[i]:g} s "
            f"and t = {t[i + 1]:g} s; correct that time stamp or cut the record there"
        )
    frames = np.concatenate(([0.0], np.cumsum(steps))).astype(np.int64)
    return FrameGrid(frames, float(t[-1] - t[0]) / float(frames[-1]))
