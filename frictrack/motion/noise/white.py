"""White noise of a displacement series from its fifth differences, whatever the slow signal under it.

For white noise of variance s^2 the differences of order k have the variance C(2k, k) s^2 and the autocorrelations
(-1)^j C(2k, k + j) / C(2k, k); a signal of frequency f enters them with (2 sin(pi f / fs))^k only. Third differences
would do with shorter stretches and know the noise a little better, but still see jerks and the ripple of a tracker.
"""

from __future__ import annotations

from math import comb

import numpy as np

from frictrack.records import Array, Mask

DIFFERENCE_ORDER = 5
FALLBACK_ORDER = 3  # where missing frames leave less than half of what third differences would have
OUTLIER_SIGMAS = 6.0  # robust deviations beyond which a difference belongs to an impact, not to the noise
MIN_HALF_WAVE_FRAMES = 4  # frames in half a wave of what changes slowly
MEDIAN_TO_SIGMA = 1.4826022  # of the median absolute value of a Gaussian


def difference_variance(order: int) -> float:
    """Variance of the differences of unit white noise."""
    return float(comb(2 * order, order))


def correlation_cost(order: int) -> float:
    """What their correlations cost in degrees of freedom: the sum of the squared correlations at all lags."""
    return comb(4 * order, 2 * order) / comb(2 * order, order) ** 2


CORRELATION_COST = correlation_cost(DIFFERENCE_ORDER)  # 2.91


def slow_spectrum(n: int) -> Array:
    """Sizes of the first cosines (orthonormal, the constant left out) of what n frames are off by slowly, rms one.

    It is as large in every octave from a few frames to the whole piece: it has no time of its own.
    """
    k = np.arange(1, max(n // MIN_HALF_WAVE_FRAMES, 2))
    return np.asarray(np.sqrt(n / np.sum(1 / k) / k))


def noise_level(x: Array, valid: Mask, relative: Array | None = None) -> tuple[Array, Array]:
    """Standard deviation of the white noise in x, and the relative standard deviation of that estimate.

    `x` (n,) or (n, B) at evenly spaced frames, in any unit; `valid` (n,). Both results are of shape (B,), or
    scalars. With `relative` (n,) deviations of the frames, it is that of a frame in which they are one. From m fifth
    differences, var(s^2) / s^4 = 2 * 2.91 / m, hence half of its root for s.
    Differences over a missing frame, and those that an impact makes stand out, are left out. NaN where fewer than four
    neighbouring frames are valid.
    """
    order = difference_order(
        *(int(np.sum(_complete_differences(valid, k))) for k in (DIFFERENCE_ORDER, FALLBACK_ORDER))
    )
    d, whole = _differences(x, valid, order)
    if not np.any(whole):
        return np.full(x.shape[1:], np.nan)[()], np.full(x.shape[1:], np.nan)[()]
    d = d[whole] / _expected(relative, valid, order)[whole].reshape(-1, *[1] * (x.ndim - 1))
    usual = MEDIAN_TO_SIGMA * np.median(np.abs(d), axis=0)
    kept = np.abs(d) <= OUTLIER_SIGMAS * usual
    m = np.sum(kept, axis=0)
    sigma = np.sqrt(np.sum(np.where(kept, d, 0.0) ** 2, axis=0) / m)
    return sigma, 0.5 * np.sqrt(2.0 * correlation_cost(order) / m)


def difference_order(many: int, few: int) -> int:
    """Order of the differences where so many of order `DIFFERENCE_ORDER` and `FALLBACK_ORDER` have all their frames."""
    return DIFFERENCE_ORDER if 2 * many >= few else FALLBACK_ORDER


def _differences(x: Array, valid: Mask, order: int) -> tuple[Array, Mask]:
    """Differences (n - order, ...) and which of them have all their frames."""
    filled = np.where(valid.reshape(-1, *[1] * (x.ndim - 1)), x, 0.0)
    return np.diff(filled, order, axis=0), _complete_differences(valid, order)


def _expected(relative: Array | None, valid: Mask, order: int) -> Array:
    """Standard deviation of the differences (n - order,) of independent noise of these relative deviations."""
    size = np.ones(len(valid)) if relative is None else np.where(valid, relative, 1.0)
    weights = np.array([float(comb(order, k)) for k in range(order + 1)])
    return np.sqrt(np.convolve(size**2, weights**2, mode="valid"))


def _complete_differences(valid: Mask, order: int) -> Mask:
    """Which differences have all their frames."""
    count = max(len(valid) - order, 0)
    return np.asarray(np.all([valid[k : k + count] for k in range(order + 1)], axis=0))
