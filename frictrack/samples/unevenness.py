"""Find samples that come unevenly although their time stamps are even: their noise grows with the speed.

A sample that comes late by tau is off by v tau, so that the variance of a position is a^2 + (v s)^2, s being the rms of
tau. Fourth differences, from which any smooth motion is gone, show it by bins of speed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import linregress

from frictrack.records import Array
from frictrack.samples.clock import speed
from frictrack.samples.outliers import FOURTH, MEDIAN_TO_SIGMA

ROWS, MOST = 40, 12  # rows of a bin of speed, and bins
FEWEST = 4  # bins that can show a trend
CERTAIN = 4.0  # standard deviations of the slope: 3e-5 by chance, less than one in 10^4 records
MIN_RECORDS, ALPHA = 4, 1e-3  # records whose noise shows a trend, and its level of significance in one study
TINY = np.finfo(float).tiny  # what is smaller has lost its digits
STILL = 0.01  # of the smallest variance of a bin, that a sample at rest has at the least: weights stay finite
# Relative deviation of the variance of n fourth differences by their median absolute value: its efficiency is 37 %
# (Huber & Ronchetti 2009, Robust Statistics, section 1.2), and each shares its noise with its neighbours (2.63).
RELATIVE = float(np.sqrt(2.0 * 2.63 / 0.37))


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
    10.5

    """
    squares, size = _binned(t, x, slowest)
    if len(squares) < FEWEST or not (np.min(size) > TINY and np.min(squares) > TINY and np.all(np.isfinite(size))):
        return 0.0, 0.0
    variance = np.full(len(squares), float(np.average(size[:, 0], weights=size[:, 1])))
    design = np.stack([np.ones_like(squares), squares], axis=1)
    for _ in range(3):  # deviations by the fitted variances themselves
        weight = np.sqrt(size[:, 1]) / (RELATIVE * variance)
        found, *_ = np.linalg.lstsq(design * weight[:, None], size[:, 0] * weight, rcond=None)
        covariance = np.linalg.inv((design * weight[:, None]).T @ (design * weight[:, None]))
        if found[1] <= CERTAIN * np.sqrt(covariance[1, 1]):
            return 0.0, 0.0
        variance = np.maximum(design @ found, 1e-3 * np.max(size[:, 0]))
    return float(np.sqrt(found[1])), float(np.sqrt(max(found[0], STILL * np.min(size[:, 0]))))


def common_unevenness(records: Sequence[tuple[Array, Array, float]]) -> float:
    """Jitter of samples (s, rms) by which the noise of several records grows with their speed; 0 where it does not.

    Parameters
    ----------
    records : sequence of tuple
        Even time stamps t (n,) s, positions x (n,) m, and the speed below which rows are not looked at, m/s.

    """
    found = [_binned(*record) for record in records]
    seen = [(squares, size) for squares, size in found if len(squares) and np.min(size) > TINY]
    means = [(np.mean(squares), np.average(size[:, 0], weights=size[:, 1])) for squares, size in seen]
    if len(means) < MIN_RECORDS:
        return 0.0
    squares, variances = np.array(means).T
    if np.ptp(squares) <= 1e-6 * np.max(squares):
        return 0.0
    line = linregress(squares, variances)
    return float(np.sqrt(line.slope)) if line.slope > 0 and line.pvalue < ALPHA else 0.0


def _binned(t: Array, x: Array, slowest: float) -> tuple[Array, Array]:
    """Mean squared speed (k,) of bins, and of each the variance of a position and its number of rows, (k, 2)."""
    if len(x) < 5:
        return np.zeros(0), np.zeros((0, 2))
    difference = np.convolve(x, FOURTH, mode="valid") / np.sqrt(70.0)
    fast = np.abs(speed(t, x))[2:-2]
    whole = np.rint((t[4:] - t[:-4]) / np.median(np.diff(t))) == 4
    rows = np.flatnonzero(whole & (fast > slowest))
    rows = rows[np.argsort(fast[rows])]
    parts = [part for part in np.array_split(rows, min(max(len(rows) // ROWS, 1), MOST)) if len(part) >= ROWS // 2]
    variances = [(MEDIAN_TO_SIGMA * float(np.median(np.abs(difference[part])))) ** 2 for part in parts]
    squares = np.array([float(np.mean(fast[part] ** 2)) for part in parts])
    return squares, np.array([(v, len(part)) for v, part in zip(variances, parts, strict=True)]).reshape(-1, 2)
