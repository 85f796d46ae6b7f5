"""Store the raw track: positions on cut-outs, and the reason where a frame has none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask
from frictrack.tracking.subpixel_fit import SubpixelFit

# Reasons for which a frame has no position; the user reads them.
UNREAD = "frame cannot be read"
FLAT = "picture without contrast"
LEAVES = "target leaves the frame"
NOT_CONVERGED = "sub-pixel fit did not converge"


@dataclass(frozen=True, eq=False)
class RawTrack:
    """Position of the target in every frame, on cut-outs.

    Attributes
    ----------
    corner : array of int (n, 2)
        Upper left corner (x, y) of each cut-out, px.
    fit : SubpixelFit
        Fit on the cut-outs; NaN where the target was not found.
    reason : array of object (n,)
        Why the target was not found; "" where it was.

    """

    corner: NDArray[np.int64]  # (n, 2) px, upper left corner of each cut-out
    fit: SubpixelFit
    reason: NDArray[np.object_]  # (n,), "" where found

    def __getitem__(self, rows: np.ndarray | slice) -> RawTrack:
        return RawTrack(self.corner[rows], self.fit[rows], self.reason[rows])

    def put(self, rows: np.ndarray | slice, part: RawTrack) -> None:
        """Replace some rows.

        Parameters
        ----------
        rows : array or slice
            Rows to replace.
        part : RawTrack
            New values of these rows.

        """
        self.corner[rows], self.reason[rows] = part.corner, part.reason
        self.fit.put(rows, part.fit)

    @property
    def position(self) -> Array:
        """Upper left corner of the target's rectangle (n, 2) px."""
        return self.corner + self.fit.position

    @property
    def found(self) -> Mask:
        """Frames (n,) in which the target was found."""
        return np.asarray(self.reason == "")


def empty_track(n: int) -> RawTrack:
    """Create a track in which nothing is found yet.

    Parameters
    ----------
    n : int
        Number of frames.

    Returns
    -------
    RawTrack
        All positions are NaN, all reasons "frame cannot be read".

    """
    nan = np.full(n, np.nan)
    pair = np.full((n, 2), np.nan)
    score, gain, offset, misfit = (nan.copy() for _ in range(4))
    fit = SubpixelFit(pair, nan, np.full((n, 3), np.nan), score, gain, offset, misfit, np.zeros(n, np.bool_))
    return RawTrack(np.zeros((n, 2), np.int64), fit, np.full(n, UNREAD, dtype=object))
