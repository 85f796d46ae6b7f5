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
