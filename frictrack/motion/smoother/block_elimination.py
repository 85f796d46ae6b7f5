"""Eliminate symmetric banded equations part by part, so that only one part of a long record is held at a time.

Of the equations K1 of the first part, A of its last unknowns with those of the next part, and K2 of the next part,
eliminating the first part changes only the first corner of the next one, K2 - A' K1^-1 A, and so on: a block LU
factorisation (Golub & Van Loan 2013, Matrix Computations, section 4.5). The solution is that of all equations at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from frictrack.motion.smoother.equation_layout import EquationPart
from frictrack.records import Array


@dataclass(frozen=True, eq=False)
class FactoredPart(EquationPart):
    """A part whose bands are factors, with their pivots (size,); all parts before it were eliminated."""

    pivots: NDArray[np.int32]

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.bands.shape[1]

    @property
    def logdet(self) -> float:
        """Log of the absolute determinant."""
        return float(np.sum(np.log(np.abs(self.bands[2 * len(self.after)]))))

    def solve(self, right: Array, carried: Array | float, following: Array | float = 0.0) -> Array:
        """Solve for the unknowns of this part.

        Parameters
        ----------
        right
            Right-hand sides, (size, ...), overwritten.
        carried
            `carry` of the part before.
        following
            Equations of the first unknowns after this part times their values, (band, ...); 0 without them.

        Returns
        -------
        Array
            The unknowns, (size, ...).

        """
        band = len(self.after)
        right[:band] -= carried
        right[-band:] -= following
        return np.asarray(scipy.linalg.lapack.dgbtrs(self.bands, band, band, right, self.pivots, overwrite_b=1)[0])

    def carry(self, solution: Array) -> Array:
        """What eliminating this part subtracts from the right-hand side of the part after it, (band, ...)."""
        return np.asarray(self.after.T @ solution[-len(self.after) :])


def factor_part(part: EquationPart, corner: Array | None) -> FactoredPart:
    """Factor a part, after `corner` (band, band) of the parts before it was added; its bands are overwritten."""
    band = len(part.after)
    add_corners(part, corner)
    bands, pivots, _ = scipy.linalg.lapack.dgbtrf(part.bands, band, band, overwrite_ab=1)
    return FactoredPart(**{**vars(part), "bands": bands}, pivots=pivots)


def following_corner(part: FactoredPart) -> Array:
    """Correction of the first equations after a part, by eliminating it, (band, band)."""
    band, tail = len(part.after), min(2 * len(part.after), part.size)
    right = np.zeros((tail, band))
    right[-band:] = part.after
    # steps before the tail change nothing: they exchange a row with one at most `band` below, and both are zero
    pivots = part.pivots[-tail:] - (part.size - tail)
    found = scipy.linalg.lapack.dgbtrs(part.bands[:, -tail:], band, band, right, pivots)[0]
    return np.asarray(-part.after.T @ found[-band:])


def add_corners(part: EquationPart, first: Array | None, last: Array | None = None) -> None:
    """Add coefficients (band, band) to the first and to the last equations of a part."""
    band, size = len(part.after), part.bands.shape[1]
    for corner, place in ((first, 0), (last, size - band)):
        if corner is not None:
            row, column = np.indices((band, band))
            part.bands[2 * band + row - column, place + column] += corner


def reversed_part(part: EquationPart) -> EquationPart:
    """The same equations from the last unknown to the first one."""
    band = len(part.after)
    bands = np.zeros(part.bands.shape, order="F")
    bands[band:] = part.bands[band:][::-1, ::-1]
    return replace(part, bands=bands, before=part.after.T[::-1, ::-1], after=part.before.T[::-1, ::-1])
