"""Smooth curves: interpolation from knots, the covariance of a random one, the correlation time of a series."""

from __future__ import annotations

import numpy as np

from frictrack.records import Array


def linear_interpolation_matrix(axis: Array, knots: Array) -> Array:
    """Linear interpolation from knots (K,) to places on an axis (n,), ends held: (n, K)."""
    right = np.clip(np.searchsorted(knots, axis), 1, len(knots) - 1)
    share = np.clip((axis - knots[right - 1]) / (knots[right] - knots[right - 1]), 0.0, 1.0)
    out = np.zeros((len(axis), len(knots)))
    rows = np.arange(len(axis))
    out[rows, right - 1] = 1 - share
    out[rows, right] = share
    return out


def matern_covariance(knots: Array, reach: float) -> Array:
    """Covariance of a Matern 3/2 process of unit size at knots (K,), (K, K)."""
    d = np.sqrt(3.0) * np.abs(knots[:, None] - knots) / reach
    return np.asarray((1 + d) * np.exp(-d))


def correlation_time_frames(r: Array, window: float = 5.0) -> float:
    """Integrated correlation time of a residual (n,) in frames, summed over a growing window (Sokal 1997)."""
    n = len(r)
    if n < 8:
        return 1.0
    spectrum = np.abs(np.fft.rfft(r - r.mean(), 2 * n)) ** 2
    rho = np.fft.irfft(spectrum)[: n // 2]
    total = 1 + 2 * np.cumsum(rho[1:] / max(float(rho[0]), 1e-300))
    far = np.flatnonzero(np.arange(1, len(total) + 1) >= window * total)
    return max(float(total[far[0]] if len(far) else total[-1]), 1.0)
