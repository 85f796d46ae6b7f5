"""Find records that are the same measurement: their noise agrees, and their motion agrees to better than the noise.

The noise of two measurements is independent, however similar the motion. A copy may be cut, shifted in time or
position, or written with other digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from frictrack.distributions import robust_std
from frictrack.records import Array, Displacement
from frictrack.sampling.outlier_search import FOURTH_DIFFERENCE

MIN_NOISE_CORRELATION = 0.9  # correlation of the noise of two records of the same measurement
MIN_COMMON_SHARE = 0.5  # of the shorter record that both must hold
MIN_COMMON_ROWS = 32  # rows that both must hold
CLIP_SIGMAS = 4.0  # robust deviations at which a difference is clipped: an outlier must not make two records agree


def copies(displacements: Sequence[Displacement]) -> list[tuple[int, int]]:
    """Find pairs of displacements that are the same measurement.

    Parameters
    ----------
    displacements : sequence of Displacement
        Records of a study.

    Returns
    -------
    list of tuple of int
        Numbers of the records of each pair.

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
    series = [
        np.interp(d.t, d.t[_known_rows(d)], d.x[_known_rows(d)]) if np.sum(_known_rows(d)) else d.x
        for d in displacements
    ]
    rough = [_clipped_differences(x) for x in series]
    return [(i, j) for i, j in combinations(range(len(series)), 2) if _is_same_measurement(series, rough, i, j)]


def _known_rows(d: Displacement) -> Array:
    return np.asarray(d.valid & np.isfinite(d.x))


def _clipped_differences(x: Array) -> Array:
    """Fourth differences, clipped at `CLIP_SIGMAS`."""
    if len(x) < MIN_COMMON_ROWS:
        return np.zeros(0)
    difference = np.convolve(x, FOURTH_DIFFERENCE, mode="valid")
    usual = float(robust_std(difference))
    return np.clip(difference, -CLIP_SIGMAS * usual, CLIP_SIGMAS * usual)


def _correlation(a: Array, b: Array) -> Array:
    """Cross-correlation of two series at all lags of `b`, from -(len(b) - 1)."""
    n = len(a) + len(b) - 1
    return np.fft.irfft(np.fft.rfft(a, n) * np.fft.rfft(b[::-1], n), n)


def _is_same_measurement(series: Sequence[Array], rough: Sequence[Array], i: int, j: int) -> bool:
    """Whether two records agree at the lag at which their noise agrees best."""
    a, b = rough[i], rough[j]
    if not (np.any(a) and np.any(b)):
        return bool(
            len(series[i]) == len(series[j]) >= MIN_COMMON_ROWS
            and np.ptp(series[i]) > 0 == np.ptp(series[i] - series[j])
        )
    lag = int(np.argmax(_correlation(a, b))) - (len(b) - 1)
    first, last = max(lag, 0), min(len(a), len(b) + lag)
    if last - first < max(MIN_COMMON_ROWS, MIN_COMMON_SHARE * min(len(a), len(b))):
        return False
    one, other = a[first:last], b[first - lag : last - lag]
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    if size == 0.0 or float(one @ other) < MIN_NOISE_CORRELATION * size:
        return False
    x, y = series[i][first:last], series[j][first - lag : last - lag]
    noise = float(np.std(one)) / float(np.sqrt(70.0))
    return float(np.std(x - y)) < noise < float(np.std(x))
