"""Bound the p-value of the best of many overlapping tests in white noise (look-elsewhere effect).

Tests along a continuous setting, such as the place of a local force, form a smooth random process. The probability
that it exceeds a level u is at most the probability that it starts above u, plus the expected number of upcrossings.
The latter is the Gaussian tail factor of u times the length of the curve that the normalised columns draw on the unit
sphere, over pi. Families of tests add up (Bonferroni). An estimated noise level makes the tail that of Student's t.

References
----------
Hotelling (1939), Am. J. Math. 61, 440-460.
Knowles & Siegmund (1989), Int. Statist. Rev. 57, 205-220.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.distributions import student_sf
from frictrack.records import Array


@dataclass(frozen=True)
class GlobalSignificance:
    """Significance of a whole search.

    Parameters
    ----------
    length
        Total length of the curves that the normalised columns of all families draw on the unit sphere.
    families
        Number of families.
    dof
        Degrees of freedom of the noise estimate.

    Examples
    --------
    >>> single = GlobalSignificance(length=0.0, families=1, dof=1e6)
    >>> round(single(3.0), 4)
    0.0027

    """

    length: float
    families: int
    dof: float

    def __call__(self, z: Array | float) -> float:
        """Return an upper bound on the probability that noise alone reaches |z| standard deviations anywhere."""
        u = float(np.max(np.abs(z)))
        rising = self.length / np.pi * float(np.exp(-(self.dof - 1) / 2 * np.log1p(u**2 / self.dof)))
        begun = 2 * self.families * float(student_sf(u, self.dof))
        return float(min(1.0, max(rising + begun, np.finfo(float).tiny)))


def curve_length(parts: Sequence[tuple[Array, float]], kept: Array) -> float:
    """Length of the curve that normalised columns draw on the unit sphere.

    Parameters
    ----------
    parts
        Blocks (n_i, k) of the columns, each with the sign with which it enters the inner products.
    kept
        Norms (k,) of the columns; a column of norm 0 is left out.

    Returns
    -------
    float
        Sum of the angles between neighbouring columns, rad.

    Examples
    --------
    >>> round(curve_length([(np.eye(2), 1.0)], np.ones(2)), 4)
    1.5708

    """
    nonzero = np.flatnonzero(kept > 0)
    if len(nonzero) < 2:
        return 0.0
    inner = np.zeros(len(nonzero) - 1)
    for part, sign in parts:
        rows = part.T[nonzero]
        inner += sign * np.einsum("kn,kn->k", rows[1:], rows[:-1])
    inner /= kept[nonzero[1:]] * kept[nonzero[:-1]]
    return float(np.sum(np.arccos(np.clip(inner, -1.0, 1.0))))
