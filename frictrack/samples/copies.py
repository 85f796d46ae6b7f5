"""Find records that are the same measurement: their noise agrees, and so does their course to better than the noise.

The noise of two measurements has nothing in common, however alike the motion. A copy may be cut, shifted in time or
place, or written with other digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.signal import correlate

from frictrack.records import Array, Displacement
from frictrack.samples.outliers import FOURTH, MEDIAN_TO_SIGMA

AGREES = 0.9  # correlation of the noise of two records
SHARE = 0.5  # of the shorter record that both must hold
FEWEST = 32  # rows that both must hold
CUT = 4.0  # robust deviations beyond which a difference counts no more: an outlier must not make two records agree


def copies(displacements: Sequence[Displacement]) -> list[tuple[int, int]]:
    """Pairs of displacements that are the same measurement, by their numbers.

    Examples
    --------
    >>> import numpy as np
    >>> from frictrack.records import Displacement
    >>> t, nan, rng = np.arange(200) / 4000, np.full(200, np.nan), np.random.default_rng(0)
    >>> x = [2 * t + 1e-5 * rng.standard_normal(200) for _ in range(2)]
    >>> made = [Displacement(t, y, nan, nan, nan, nan, np.ones(200, bool)) for y in (*x, x[0] + 0.1)]
    >>> copies(made)
    [(0, 2)]

    """
    series = [np.interp(d.t, d.t[_known(d)], d.x[_known(d)]) if np.sum(_known(d)) else d.x for d in displacements]
    rough = [_rough(x) for x in series]
    return [(i, j) for i, j in combinations(range(len(series)), 2) if _same(series, rough, i, j)]


def _known(d: Displacement) -> Array:
    return np.asarray(d.valid & np.isfinite(d.x))


def _rough(x: Array) -> Array:
    """Fourth differences, cut where they stand out, of length one."""
    if len(x) < FEWEST:
        return np.zeros(0)
    difference = np.convolve(x, FOURTH, mode="valid")
    usual = MEDIAN_TO_SIGMA * float(np.median(np.abs(difference)))
    return np.clip(difference, -CUT * usual, CUT * usual)


def _same(series: Sequence[Array], rough: Sequence[Array], i: int, j: int) -> bool:
    """Whether two records agree at the lag at which their noise agrees best."""
    a, b = rough[i], rough[j]
    if not (np.any(a) and np.any(b)):
        return bool(
            len(series[i]) == len(series[j]) >= FEWEST and np.ptp(series[i]) > 0 == np.ptp(series[i] - series[j])
        )
    lag = int(np.argmax(correlate(a, b, method="fft"))) - (len(b) - 1)
    first, last = max(lag, 0), min(len(a), len(b) + lag)
    if last - first < max(FEWEST, SHARE * min(len(a), len(b))):
        return False
    one, other = a[first:last], b[first - lag : last - lag]
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    if size == 0.0 or float(one @ other) < AGREES * size:
        return False
    x, y = series[i][first:last], series[j][first - lag : last - lag]
    noise = float(np.std(one)) / float(np.sqrt(70.0))
    return float(np.std(x - y)) < noise < float(np.std(x))
