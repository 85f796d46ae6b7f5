"""Find the regular grid of frames of a record with missing frames, and compute finite differences on it.

Differences have five points inside and six at the ends; they are exact up to fourth order.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
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

    def to_frames(self, columns: Array, empty: float = 0.0) -> Array:
        """Put columns (n, ...) of the rows on the grid; missing frames get `empty`."""
        out = np.full((self.n, *columns.shape[1:]), empty)
        out[self.frames] = columns
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


STENCIL_FRAMES = 6  # at most in a stencil
STENCIL_REACH = 2  # frames on either side of a central stencil


def stencils(n: int, interval: float) -> tuple[NDArray[np.int64], Array]:
    """Stencils of the derivatives of order 0, 1 and 2 in all frames.

    Parameters
    ----------
    n
        Number of frames, at least 6.
    interval
        Frame interval, s.

    Returns
    -------
    tuple of arrays
        First frame of each stencil, (n,), and weights, (3, n, 6).

    Examples
    --------
    >>> start, weights = stencils(8, 1.0)
    >>> int(start[4]), (12 * weights[2, 4, :5]).round(9).tolist()
    (2, [-1.0, 16.0, -30.0, 16.0, -1.0])

    """
    return stencil_start(n), stencil_weights(n, interval)


def stencil_start(n: int) -> NDArray[np.int64]:
    """First frame (n,) of the stencil of each frame."""
    return np.clip(np.arange(n) - STENCIL_REACH, 0, n - STENCIL_FRAMES)


def stencil_weights(n: int, interval: float, frames: slice = slice(None)) -> Array:
    """Weights (3, m, 6) of the stencils of m of n frames, as `stencils` returns them of all."""
    frame = np.arange(n)[frames]
    place = frame - np.clip(frame - STENCIL_REACH, 0, n - STENCIL_FRAMES)
    return np.asarray(_table()[:, place] / interval ** np.arange(3.0)[:, None, None])


def stencil_derivatives(y: Array, interval: float) -> Array:
    """Compute derivatives of order 0, 1 and 2.

    Examples
    --------
    >>> stencil_derivatives(np.arange(8.0) ** 2, 1.0)[2].round(9).tolist()
    [2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0]

    """
    out = np.empty((3, len(y)))
    for order, column in enumerate(out):
        np.divide(stencil_derivative(y, order), interval**order, out=column)
    return out


def stencil_derivative(y: Array, order: int) -> Array:
    """Derivative of one order of columns (n, ...), per frame."""
    weights, n = _table()[order], len(y)
    out = scipy.ndimage.correlate1d(y, weights[STENCIL_REACH, :-1], axis=0)  # five frames about each
    for place in range(STENCIL_FRAMES):
        if place != STENCIL_REACH:
            first = 0 if place < STENCIL_REACH else n - STENCIL_FRAMES
            out[first + place] = np.tensordot(weights[place], y[first : first + STENCIL_FRAMES], 1)
    return np.asarray(out)


@lru_cache(maxsize=1)
def _table() -> Array:
    """Weights (3, STENCIL_FRAMES, STENCIL_FRAMES) of the derivatives at each node."""
    return np.array([[_stencil(p, order) for p in range(STENCIL_FRAMES)] for order in range(3)])


def _stencil(place: int, order: int) -> Array:
    """Weights (STENCIL_FRAMES,) of the derivative at node `place`; five nodes where they are symmetric about it."""
    m = STENCIL_FRAMES - 1 if place == STENCIL_REACH else STENCIL_FRAMES
    powers = np.vander(np.arange(m) - float(place), increasing=True).T
    wanted = np.array([1.0, 1.0, 2.0])[order] * (np.arange(m) == order)
    return np.pad(np.linalg.solve(powers, wanted), (0, STENCIL_FRAMES - m))
