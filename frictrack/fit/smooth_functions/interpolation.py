"""Interpolate from knots, and compute over how many frames a series correlates."""

from __future__ import annotations

import numpy as np

from frictrack.records import Array

MIN_CORRELATED_FRAMES = 8  # shorter series count as white
CORRELATION_WINDOW = 5.0  # correlation times; the sum ends at the first lag above (Sokal 1997)


def _autocorrelation(r: Array) -> Array:
    """Autocorrelation of a series (n,) at the lags 0 to n/2 - 1."""
    n = len(r)
    spectrum = np.abs(np.fft.rfft(r - r.mean(), 2 * n)) ** 2
    rho = np.fft.irfft(spectrum)[: n // 2]
    return np.asarray(rho / max(float(rho[0]), 1e-300))


def correlation_time_frames(r: Array) -> float:
    """Compute the integrated correlation time of a residual, summed over a growing window.

    Parameters
    ----------
    r : array of shape (n,)
        Residual.

    Returns
    -------
    float
        Correlation time in frames, at least 1.

    References
    ----------
    Sokal, A. (1997). Monte Carlo methods in statistical mechanics. Functional Integration, NATO ASI 361, 131-192.

    Examples
    --------
    >>> correlation_time_frames(np.tile([1.0, -1.0], 50))
    1.0

    """
    if len(r) < MIN_CORRELATED_FRAMES:
        return 1.0
    total = 1 + 2 * np.cumsum(_autocorrelation(r)[1:])
    far = np.flatnonzero(np.arange(1, len(total) + 1) >= CORRELATION_WINDOW * total)
    return max(float(total[far[0]] if len(far) else total[-1]), 1.0)


def correlated_frames(r: Array) -> int:
    """Compute the lag at which the autocorrelation of a residual (n,) falls below 1/e, frames; 0 for white noise.

    Examples
    --------
    >>> correlated_frames(np.sin(np.linspace(0, 6, 100))) > 10
    True

    """
    n = len(r)
    if n < MIN_CORRELATED_FRAMES:
        return 0
    rho = _autocorrelation(r)
    if rho[1] < 3.0 / np.sqrt(n):
        return 0
    below = np.flatnonzero(rho < np.exp(-1.0))
    return int(below[0]) if len(below) else n // 2


def linear_interpolation_matrix(axis: Array, knots: Array) -> Array:
    """Compute the matrix of linear interpolation from knots to points, constant beyond the ends.

    Parameters
    ----------
    axis : array of shape (n,)
        Points.
    knots : array of shape (K,)
        Knots in rising order.

    Returns
    -------
    array of shape (n, K)
        Weights of the knots.

    Examples
    --------
    >>> linear_interpolation_matrix(np.array([0.25, 2.0]), np.array([0.0, 1.0])).tolist()
    [[0.75, 0.25], [0.0, 1.0]]

    """
    right = np.clip(np.searchsorted(knots, axis), 1, len(knots) - 1)
    share = np.clip((axis - knots[right - 1]) / (knots[right] - knots[right - 1]), 0.0, 1.0)
    out = np.zeros((len(axis), len(knots)))
    rows = np.arange(len(axis))
    out[rows, right - 1] = 1 - share
    out[rows, right] = share
    return out
