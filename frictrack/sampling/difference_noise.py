"""Estimate the white noise of a series: its scatter about any smooth course.

For white noise of variance s^2 the differences of order k have the variance C(2k, k) s^2 and the autocorrelations
(-1)^j C(2k, k + j) / C(2k, k); a signal of frequency f enters them with (2 sin(pi f / fs))^k. The level is estimated
from fifth differences, which contain little slow signal. Third differences need shorter stretches and give a slightly
more precise estimate, but contain jerks and the ripple of a tracker.
"""

from __future__ import annotations

from math import comb

import numpy as np

from frictrack.base.distributions import robust_std
from frictrack.records import Array, Mask
from frictrack.sampling.clock import frame_numbers, uneven_noise

DIFFERENCE_ORDER = 5
FALLBACK_ORDER = 3  # used where missing frames leave less than half as many fifth as third differences
HIGHER_ORDERS, FALL_SIGMAS = (8, 12, 16, 24), 3.0  # tried while the level falls by more than its deviations
MIN_HIGHER = 64  # differences of a higher order
SMOOTH_RISE = 2.0**2.5  # of the noise over twice the rows: halfway between a white force and smooth rows
STILL_RISE = 2.0  # where rows were smooth, and further ones are not independent yet
MIN_INDEPENDENT, MAX_NOISE_SHARE = 32, 0.02  # rows that are left; of their steps: more is a motion back and forth
N_PREDICTORS, N_PREDICTED, MIN_SURPRISE = 8, 40, 0.5  # rows before; rows; of the noise that these do not predict
OUTLIER_SIGMAS = 6.0  # robust standard deviations beyond which a difference belongs to an impact
MAX_GAP_SHARE, MAX_UNEVENNESS = 0.2, 0.01  # of the intervals, that differ from the usual one by more of it


def _is_uneven(t: Array) -> bool:
    """Whether many intervals differ from the usual one, so that few rows in a row are evenly spaced."""
    return len(t) > 1 and bool(np.mean(unusual_steps(t)) > MAX_GAP_SHARE)


def unusual_steps(t: Array) -> Mask:
    """Return which steps (n - 1,) of times (n,) differ from the usual one.

    Examples
    --------
    >>> unusual_steps(np.array([0.0, 1.0, 2.0, 4.0])).tolist()
    [False, False, True]

    """
    steps = np.diff(t)
    return np.asarray(np.abs(steps / np.median(steps) - 1.0) > MAX_UNEVENNESS)


def difference_variance(order: int) -> float:
    """Variance of the differences of unit white noise, C(2k, k)."""
    return float(comb(2 * order, order))


def correlation_cost(order: int) -> float:
    """Sum of the squared autocorrelations of the differences: frames per degree of freedom."""
    return comb(4 * order, 2 * order) / comb(2 * order, order) ** 2


CORRELATION_COST = correlation_cost(DIFFERENCE_ORDER)  # 2.91


def noise_level(x: Array, valid: Mask, relative: Array | None = None, t: Array | None = None) -> tuple[float, float]:
    """Estimate the standard deviation of the white noise of a series.

    Differences over a missing frame, and outliers by an impact, are left out. From m fifth differences,
    var(s^2) / s^4 = 2 * 2.91 / m, and half of its root for s.

    Parameters
    ----------
    x
        Values at evenly spaced frames in any unit, (n,).
    valid
        Frames that were measured, (n,).
    relative
        Relative standard deviations of the frames, (n,); the result then is that of a frame where they are 1.
    t
        Times, s, (n,), if intervals between frames may be longer than others.

    Returns
    -------
    tuple of float
        Standard deviation, and its relative standard deviation. NaN if fewer than four neighbouring frames are valid.

    Examples
    --------
    >>> noise = np.random.default_rng(0).standard_normal(5000)
    >>> sigma, _ = noise_level(np.linspace(0.0, 50.0, 5000) ** 2 + noise, np.ones(5000, dtype=bool))
    >>> 0.95 < sigma < 1.05
    True

    """
    steps = np.minimum(np.diff(frame_numbers(t)), 2.0) if t is not None and len(t) > 1 else np.ones(1)
    if t is not None and _is_uneven(t) and np.sum(valid) > DIFFERENCE_ORDER:
        scale = np.ones(len(x)) if relative is None else relative
        level = uneven_noise(t[valid], x[valid], scale[valid])
        return level, 0.5 * float(np.sqrt(2.0 * correlation_cost(4) / np.sum(valid)))
    if np.any(steps > 1):
        rows = np.repeat(np.arange(len(x)), np.append(steps, 1).astype(int))  # with a frame in every gap, not measured
        measured = valid[rows] & np.append(True, np.diff(rows) > 0)
        if np.any(_complete_differences(measured, FALLBACK_ORDER)):
            return noise_level(x[rows], measured, None if relative is None else relative[rows])
    complete = {order: _complete_differences(valid, order) for order in (DIFFERENCE_ORDER, FALLBACK_ORDER)}
    order = difference_order(*(int(np.sum(whole)) for whole in complete.values()))
    if not np.any(complete[order]):
        return np.nan, np.nan
    return _level_of_differences(x, valid, complete[order], relative)


def _level_of_differences(x: Array, valid: Mask, whole: Mask, relative: Array | None = None) -> tuple[float, float]:
    """White noise of a series (n,) from its complete differences of one order, and its relative standard deviation."""
    order = len(x) - len(whole)
    d = np.diff(np.where(valid, x, 0.0), order)[whole] / _expected(relative, valid, order)[whole]
    kept = d[np.abs(d) <= OUTLIER_SIGMAS * robust_std(d)]
    return float(np.sqrt(np.mean(kept**2))), 0.5 * float(np.sqrt(2.0 * correlation_cost(order) / len(kept)))


def noise_of_smooth(x: Array, t: Array | None = None) -> tuple[float, float]:
    """As `noise_level` of the finite values of a series (n,) that may change fast, at times t (n,), s.

    The order of differences rises while they hold signal.
    """
    valid = np.isfinite(x)
    level, error = noise_level(x, valid, t=t)
    for order in HIGHER_ORDERS if t is None or not _is_uneven(t) else ():
        whole = _complete_differences(valid, order)
        if np.sum(whole) < MIN_HIGHER:
            break
        higher, deviation = _level_of_differences(x, valid, whole)
        if higher > (1 - FALL_SIGMAS * deviation) * level:  # of white noise, all orders find the same
            break
        level, error = higher, deviation
    return level, error


def white_noise(x: Array, valid: Mask | None = None) -> float:
    """Estimate the white noise of a series (n,), as `noise_level`, by default of its finite values; 0 if that fails."""
    return float(np.nan_to_num(noise_level(x, np.isfinite(x) if valid is None else valid)[0]))


def independent_step(x: Array) -> int:
    """Find from how many rows on positions (n,) are independent, where another program smoothed or interpolated them.

    Their white noise s_k, as every k-th row shows it, rises as k^(order of the differences) while the rows between are
    smooth; that of measured positions hardly does, and that of an integrated white force as k^1.5. Computed positions
    without any noise rise so, too, but each follows from those before. Returns a power of two, 1 where all rows count.

    Examples
    --------
    >>> from scipy.interpolate import make_interp_spline
    >>> t = np.linspace(0.0, 1.0, 1000)
    >>> x = t - t**2 / 4 + 1e-5 * np.random.default_rng(0).standard_normal(1000)
    >>> independent_step(x), independent_step(make_interp_spline(t[::4], x[::4])(t))
    (1, 4)

    """
    step, level, rise = 1, white_noise(x), SMOOTH_RISE
    while len(x) >= 2 * step * MIN_INDEPENDENT and (wider := white_noise(x[:: 2 * step])) > rise * level:
        step, level, rise = 2 * step, wider, STILL_RISE
    if step == 1 or level > MAX_NOISE_SHARE * np.median(np.abs(np.diff(x[::step]))):
        return 1
    bends = np.diff(x[::step], 2)
    hit = np.abs(bends - np.median(bends)) > OUTLIER_SIGMAS * robust_std(bends)
    rows, hit = (np.lib.stride_tricks.sliding_window_view(q, N_PREDICTORS + 1) for q in (bends, hit))
    if len(rows := rows[~np.any(hit, axis=1)]) < MIN_INDEPENDENT // 2:
        return 1
    parts = np.array_split(rows, max(len(rows) // N_PREDICTED, 1))  # the frequency of a vibration changes slowly
    left = [p[:, -1] - p[:, :-1] @ np.linalg.lstsq(p[:, :-1], p[:, -1])[0] for p in parts]
    surprise = robust_std(np.concatenate(left)) / np.sqrt(1 - len(parts) * N_PREDICTORS / len(rows))
    return step if surprise > MIN_SURPRISE * level else 1


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


def _expected(relative: Array | None, valid: Mask, order: int) -> Array:
    """Standard deviation of the differences (n - order,) of independent noise with relative standard deviations."""
    size = np.ones(len(valid)) if relative is None else np.where(valid, relative, 1.0)
    weights = np.array([float(comb(order, k)) for k in range(order + 1)])
    return np.sqrt(np.convolve(size**2, weights**2, mode="valid"))


def _complete_differences(valid: Mask, order: int) -> Mask:
    """Mask of the differences without a missing frame."""
    count = max(len(valid) - order, 0)
    return np.asarray(np.all([valid[k : k + count] for k in range(order + 1)], axis=0))
