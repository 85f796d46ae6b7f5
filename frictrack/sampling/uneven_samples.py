"""Find samples that come unevenly although their time stamps are even: their noise grows with the speed.

A sample that comes late by tau is off by v tau, so that the variance of a position is a^2 + (v s)^2, s being the rms of
tau. Fourth differences, from which any smooth motion is gone, show it by bins of speed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictrack.distributions import robust_std, student_sf
from frictrack.records import Array
from frictrack.sampling.even_clock import robust_speed
from frictrack.sampling.outlier_search import FOURTH_DIFFERENCE

ROWS_PER_BIN, MAX_BINS = 40, 12  # rows of a bin of speed, and bins
MIN_BINS = 4  # bins of speed that can show a trend
MIN_SLOPE_SIGMAS = 4.0  # standard deviations of the slope: 3e-5 by chance, less than one in 10^4 records
MIN_RECORDS, ALPHA = 4, 1e-3  # records whose noise shows a trend, and its level of significance in one study
MIN_SPEED_SPREAD = 1e-6  # relative difference of squared speeds; a smaller one is none
SMALLEST_VARIANCE = np.finfo(float).tiny  # a smaller variance has lost its digits
MIN_REST_SHARE = 0.01  # of the smallest variance of a bin, that a sample at rest has: weights stay finite
CLIP_SIGMAS, CLIPPED_MEAN_SQUARE = (
    3.0,
    0.99501,
)  # robust deviations at which a square is cut off, and the mean square of a Gaussian then
# Relative deviation of the variance of n fourth differences, each of which shares its noise with its neighbours (2.63).
RELATIVE_DEVIATION = float(np.sqrt(2.0 * 2.63))


def unevenness(t: Array, x: Array, slowest: float = 0.0) -> tuple[float, float]:
    """Jitter of samples (s, rms) and the noise of a sample at rest (m); 0 and 0 where no jitter shows.

    Parameters
    ----------
    t : array (n,)
        Even time stamps, s.
    x : array (n,)
        Positions, m.
    slowest : float
        Speed below which rows are not looked at, m/s: slower ones share the error of their pixel, or of their step.

    Examples
    --------
    >>> import numpy as np
    >>> rng, t = np.random.default_rng(0), np.arange(800) / 4000
    >>> late = 1e-5 * rng.standard_normal(800)
    >>> x = 4 * (t + late) - 9 * (t + late) ** 2 + 3e-6 * rng.standard_normal(800)
    >>> round(1e6 * unevenness(t, x)[0], 1)
    10.2

    """
    squares, size = _bin_by_speed(t, x, slowest)
    if len(squares) < MIN_BINS or not (
        np.min(size) > SMALLEST_VARIANCE and np.min(squares) > SMALLEST_VARIANCE and np.all(np.isfinite(size))
    ):
        return 0.0, 0.0
    (at_rest, slope), sigma, _ = _fit_line(squares, size)
    if slope <= MIN_SLOPE_SIGMAS * sigma:
        return 0.0, 0.0
    return float(np.sqrt(slope)), float(np.sqrt(max(at_rest, MIN_REST_SHARE * np.min(size[:, 0]))))


def _fit_line(squares: Array, size: Array) -> tuple[Array, float, float]:
    """Fit the variance at rest and its slope over squared speed; also the slope's deviation and chi-squared.

    `size` (k, 2) are variances and the numbers of their rows, which determine their deviations.
    """
    design = np.stack([np.ones_like(squares), squares], axis=1)
    variance = np.full(len(squares), float(np.average(size[:, 0], weights=size[:, 1])))
    for _ in range(3):  # deviations by the fitted variances themselves
        weight = np.sqrt(size[:, 1]) / (RELATIVE_DEVIATION * variance)
        rows, right = design * weight[:, None], size[:, 0] * weight
        found, *_ = np.linalg.lstsq(rows, right, rcond=None)
        variance = np.maximum(design @ found, 1e-3 * np.max(size[:, 0]))
    sigma = float(np.sqrt(np.linalg.pinv(rows.T @ rows)[1, 1]))
    return np.asarray(found, dtype=np.float64), sigma, float(np.sum((right - rows @ found) ** 2))


def common_unevenness(records: Sequence[tuple[Array, Array, float]]) -> float:
    """Jitter of samples (s, rms) by which the noise of several records grows with their speed; 0 where it does not.

    Parameters
    ----------
    records : sequence of tuple
        Even time stamps t (n,) s, positions x (n,) m, and the speed below which rows are not looked at, m/s.

    """
    found = [_bin_by_speed(*record) for record in records]
    usable = [(squares, size) for squares, size in found if len(squares) and np.min(size) > SMALLEST_VARIANCE]
    if len(usable) < MIN_RECORDS:
        return 0.0
    squares = np.array([np.mean(one) for one, _ in usable])
    size = np.array([(np.average(each[:, 0], weights=each[:, 1]), np.sum(each[:, 1])) for _, each in usable])
    if np.ptp(squares) <= MIN_SPEED_SPREAD * np.max(squares):
        return 0.0
    (_, slope), sigma, chi2 = _fit_line(squares, size)
    dof = len(usable) - 2  # records differ in their noise, too: their scatter counts
    t_statistic = slope / (sigma * max(1.0, np.sqrt(chi2 / dof)))
    return float(np.sqrt(slope)) if slope > 0 and student_sf(t_statistic, dof) < ALPHA else 0.0


def _bin_by_speed(t: Array, x: Array, slowest: float) -> tuple[Array, Array]:
    """Mean squared speed (k,) of bins; variance of a position and number of rows in each, (k, 2)."""
    if len(x) < 5:
        return np.zeros(0), np.zeros((0, 2))
    difference = np.convolve(x, FOURTH_DIFFERENCE, mode="valid") / np.sqrt(70.0)
    fast = np.abs(robust_speed(t, x))[2:-2]
    whole = np.rint((t[4:] - t[:-4]) / np.median(np.diff(t))) == 4
    rows = np.flatnonzero(whole & (fast > slowest))
    rows = rows[np.argsort(fast[rows])]
    parts = [
        part
        for part in np.array_split(rows, min(max(len(rows) // ROWS_PER_BIN, 1), MAX_BINS))
        if len(part) >= ROWS_PER_BIN // 2
    ]
    variances = [_clipped_variance(difference[part]) for part in parts]
    squares = np.array([float(np.mean(fast[part] ** 2)) for part in parts])
    return squares, np.array([(v, len(part)) for v, part in zip(variances, parts, strict=True)]).reshape(-1, 2)


def _clipped_variance(difference: Array) -> float:
    """Variance from clipped squares, consistent for Gaussian noise and robust against outliers (Huber 1981)."""
    most = CLIP_SIGMAS * float(robust_std(difference))
    return float(np.mean(np.minimum(np.abs(difference), most) ** 2)) / CLIPPED_MEAN_SQUARE
