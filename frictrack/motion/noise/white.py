"""Estimate the white noise of a displacement series from its fifth differences, which contain little slow signal.

For white noise of variance s^2 the differences of order k have the variance C(2k, k) s^2 and the autocorrelations
(-1)^j C(2k, k + j) / C(2k, k); a signal of frequency f enters them with (2 sin(pi f / fs))^k. Third differences need
shorter stretches and give a slightly more precise estimate, but contain jerks and the ripple of a tracker.
"""

from __future__ import annotations

from math import comb

import numpy as np

from frictrack.distributions import robust_std
from frictrack.records import Array, Mask
from frictrack.sampling import frame_numbers

DIFFERENCE_ORDER = 5
FALLBACK_ORDER = 3  # used where missing frames leave less than half as many fifth as third differences
OUTLIER_SIGMAS = 6.0  # robust standard deviations beyond which a difference belongs to an impact
MIN_HALF_WAVE_FRAMES = 4  # frames in half a period of the fastest slow error


def difference_variance(order: int) -> float:
    """Variance of the differences of unit white noise, C(2k, k)."""
    return float(comb(2 * order, order))


def correlation_cost(order: int) -> float:
    """Sum of the squared autocorrelations of the differences: frames per degree of freedom."""
    return comb(4 * order, 2 * order) / comb(2 * order, order) ** 2


CORRELATION_COST = correlation_cost(DIFFERENCE_ORDER)  # 2.91


def slow_spectrum(n: int) -> Array:
    """Amplitudes of a slow error of unit rms in the first cosines of n frames.

    The error has equal power in each octave from a few frames to the whole piece.

    Parameters
    ----------
    n
        Number of frames.

    Returns
    -------
    Array
        Amplitudes of the orthonormal cosines, without the constant, (k,).

    """
    k = np.arange(1, max(n // MIN_HALF_WAVE_FRAMES, 2))
    return np.asarray(np.sqrt(n / np.sum(1 / k) / k))


def noise_level(x: Array, valid: Mask, relative: Array | None = None, t: Array | None = None) -> tuple[Array, Array]:
    """Estimate the standard deviation of the white noise of a series.

    Differences over a missing frame, and outliers by an impact, are left out. From m fifth differences,
    var(s^2) / s^4 = 2 * 2.91 / m, and half of its root for s.

    Parameters
    ----------
    x
        Values at evenly spaced frames in any unit, (n,) or (n, B).
    valid
        Frames that were measured, (n,).
    relative
        Relative standard deviations of the frames, (n,); the result then is that of a frame where they are 1.
    t
        Times, s, (n,), if intervals between frames may be longer than others.

    Returns
    -------
    tuple of arrays
        Standard deviation, and its relative standard deviation, both (B,) or scalars. NaN if fewer than four
        neighbouring frames are valid.

    Examples
    --------
    >>> noise = np.random.default_rng(0).standard_normal(5000)
    >>> sigma, _ = noise_level(np.linspace(0.0, 50.0, 5000) ** 2 + noise, np.ones(5000, dtype=bool))
    >>> 0.95 < float(sigma) < 1.05
    True

    """
    steps = np.minimum(np.diff(frame_numbers(t)), 2.0) if t is not None and len(t) > 1 else np.ones(1)
    if np.any(steps > 1):
        rows = np.repeat(np.arange(len(x)), np.append(steps, 1).astype(int))  # with a frame in every gap, not measured
        measured = valid[rows] & np.append(True, np.diff(rows) > 0)
        if np.any(_complete_differences(measured, FALLBACK_ORDER)):
            return noise_level(x[rows], measured, None if relative is None else relative[rows])
    order = difference_order(
        *(int(np.sum(_complete_differences(valid, k))) for k in (DIFFERENCE_ORDER, FALLBACK_ORDER))
    )
    d, whole = _differences(x, valid, order)
    if not np.any(whole):
        return np.full(x.shape[1:], np.nan)[()], np.full(x.shape[1:], np.nan)[()]
    d = d[whole] / _expected(relative, valid, order)[whole].reshape(-1, *[1] * (x.ndim - 1))
    usual = robust_std(d, axis=0)
    kept = np.abs(d) <= OUTLIER_SIGMAS * usual
    m = np.sum(kept, axis=0)
    sigma = np.sqrt(np.sum(np.where(kept, d, 0.0) ** 2, axis=0) / m)
    return sigma, 0.5 * np.sqrt(2.0 * correlation_cost(order) / m)


def difference_order(many: int, few: int) -> int:
    """Choose the order of differences.

    Parameters
    ----------
    many, few
        Numbers of complete differences of `DIFFERENCE_ORDER` and `FALLBACK_ORDER`.

    Returns
    -------
    int
        `FALLBACK_ORDER` if missing frames leave too few differences of the higher order.

    Examples
    --------
    >>> difference_order(100, 102), difference_order(10, 60)
    (5, 3)

    """
    return DIFFERENCE_ORDER if 2 * many >= few else FALLBACK_ORDER


def _differences(x: Array, valid: Mask, order: int) -> tuple[Array, Mask]:
    """Differences (n - order, ...), and a mask of those without a missing frame."""
    filled = np.where(valid.reshape(-1, *[1] * (x.ndim - 1)), x, 0.0)
    return np.diff(filled, order, axis=0), _complete_differences(valid, order)


def _expected(relative: Array | None, valid: Mask, order: int) -> Array:
    """Standard deviation of the differences (n - order,) of independent noise with relative standard deviations."""
    size = np.ones(len(valid)) if relative is None else np.where(valid, relative, 1.0)
    weights = np.array([float(comb(order, k)) for k in range(order + 1)])
    return np.sqrt(np.convolve(size**2, weights**2, mode="valid"))


def _complete_differences(valid: Mask, order: int) -> Mask:
    """Mask of the differences without a missing frame."""
    count = max(len(valid) - order, 0)
    return np.asarray(np.all([valid[k : k + count] for k in range(order + 1)], axis=0))
