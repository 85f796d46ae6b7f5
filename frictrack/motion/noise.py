"""White noise of a displacement series from its third differences, whatever the slow signal under it.

For white noise of variance s^2 the third differences have the variance 20 s^2 and the autocorrelations
-3/4, 3/10, -1/20; a signal of frequency f enters them with (2 sin(pi f / fs))^3 only.
"""

from __future__ import annotations

import numpy as np

from frictrack.records import Array, Mask

CORRELATIONS = np.array([1.0, -0.75, 0.3, -0.05])  # of the third differences of white noise
VARIANCE = 20.0  # of the third differences of unit white noise
SPREAD = 1.0 + 2.0 * float(np.sum(CORRELATIONS[1:] ** 2))  # 2.31: what these correlations cost in degrees
OUTLIER = 6.0  # robust deviations beyond which a third difference belongs to an impact, not to the noise
MEDIAN_TO_SIGMA = 1.4826022  # of the median absolute value of a Gaussian


def noise_level(x: Array, valid: Mask) -> tuple[Array, Array]:
    """Standard deviation of the white noise in x, and the relative standard deviation of that estimate.

    `x` (n,) or (n, B) at evenly spaced frames, in any unit; `valid` (n,). Both results are of shape (B,), or
    scalars. From m third differences, var(s^2) / s^4 = 2 * 2.31 / m, hence half of its root for s.
    Third differences over a missing frame, and those that an impact makes stand out, are left out. NaN where
    fewer than four neighbouring frames are valid.
    """
    d, whole = _third_differences(x, valid)
    if not np.any(whole):
        return np.full(x.shape[1:], np.nan)[()], np.full(x.shape[1:], np.nan)[()]
    d = d[whole]
    usual = MEDIAN_TO_SIGMA * np.median(np.abs(d), axis=0)
    kept = np.abs(d) <= OUTLIER * usual
    m = np.sum(kept, axis=0)
    sigma = np.sqrt(np.sum(np.where(kept, d, 0.0) ** 2, axis=0) / m / VARIANCE)
    return sigma, 0.5 * np.sqrt(2.0 * SPREAD / m)


def lag1(x: Array, valid: Mask) -> tuple[float, float]:
    """Correlation of the noise of neighbouring frames, and its standard deviation when there is none.

    `x` (n,), `valid` (n,). With the correlation r at lag one and none beyond, the third differences have the
    variance 20 - 30 r and the covariance -15 + 26 r at lag one, which gives r from their quotient.
    """
    d, whole = _third_differences(x, valid)
    usual = MEDIAN_TO_SIGMA * np.median(np.abs(d[whole])) if np.any(whole) else 0.0
    kept = whole & (np.abs(d) <= OUTLIER * usual)
    both = kept[1:] & kept[:-1]
    if not np.any(both) or usual == 0.0:
        return float("nan"), float("nan")
    q = float(np.mean(d[1:][both] * d[:-1][both]) / np.mean(d[kept] ** 2))
    return (20.0 * q + 15.0) / (26.0 + 30.0 * q), _LAG1_SPREAD / float(np.sqrt(np.sum(both)))


def _third_differences(x: Array, valid: Mask) -> tuple[Array, Mask]:
    """Third differences (n - 3, ...) and which of them have all four frames."""
    filled = np.where(valid.reshape(-1, *[1] * (x.ndim - 1)), x, 0.0)
    return np.diff(filled, 3, axis=0), valid[3:] & valid[2:-1] & valid[1:-2] & valid[:-3]


def _lag1_spread() -> float:
    """Standard deviation of `lag1` for white noise times the root of the number of differences (Bartlett)."""
    r = np.concatenate((CORRELATIONS[:0:-1], CORRELATIONS, np.zeros(3)))
    centre = 3
    v = np.arange(1, 5)
    before = np.where(v - 1 <= 3, r[centre + v - 1], 0.0)
    terms = r[centre + v + 1] * (v + 1 <= 3) + before - 2.0 * r[centre + 1] * r[centre + v] * (v <= 3)
    slope = 70.0 / 12.25  # d r / d q at q = -3/4
    return slope * float(np.sqrt(np.sum(terms**2)))


_LAG1_SPREAD = _lag1_spread()
