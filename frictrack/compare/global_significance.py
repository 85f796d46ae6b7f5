"""How high the best of many overlapping looks at white noise rises by chance.

Looks along a continuous setting, such as the place of a local force, form a smooth random process. Its chance of
passing a level u is bounded by its chance to begin above it plus the expected number of upcrossings: u's Gaussian times
the length of the curve that the normalised looks draw on the sphere, over pi (Hotelling 1939; Knowles & Siegmund 1989,
Int. Statist. Rev. 57). Families of looks add up (Bonferroni). A noise that is itself estimated makes it Student's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from frictrack.records import Array


@dataclass(frozen=True)
class Chance:
    """Chance of a whole search: length of all families' curves, their number, and degrees of freedom of the noise."""

    length: float
    families: int
    freedom: float

    def __call__(self, z: Array | float) -> float:
        """Bound on the chance that noise alone reaches |z| standard deviations anywhere."""
        u = float(np.max(np.abs(z)))
        rising = self.length / np.pi * float(np.exp(-(self.freedom - 1) / 2 * np.log1p(u**2 / self.freedom)))
        begun = 2 * self.families * float(student.sf(u, self.freedom))
        return float(min(1.0, max(rising + begun, np.finfo(float).tiny)))


def arc(parts: Sequence[tuple[Array, float]], kept: Array) -> float:
    """Length on the unit sphere of a curve through columns of norms `kept` (k,); one of norm 0 is left out.

    The columns are given as parts (n_i, k), each with the sign of what it adds to inner products.
    """
    seen = np.flatnonzero(kept > 0)
    if len(seen) < 2:
        return 0.0
    inner = np.zeros(len(seen) - 1)
    for part, sign in parts:
        unit = part[:, seen] / kept[seen]
        inner += sign * np.einsum("nk,nk->k", unit[:, 1:], unit[:, :-1])
    return float(np.sum(np.arccos(np.clip(inner, -1.0, 1.0))))
