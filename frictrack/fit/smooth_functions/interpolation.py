"""Interpolate from knots, and compute the covariance of a smooth random function at knots."""

from __future__ import annotations

import numpy as np

from frictrack.records import Array


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


def matern_covariance(knots: Array, reach: float) -> Array:
    """Compute the covariance of a Matern 3/2 process of unit variance at knots.

    Parameters
    ----------
    knots : array of shape (K,)
        Places of the knots.
    reach : float
        Correlation length, in the unit of the knots.

    Returns
    -------
    array of shape (K, K)
        Covariance (1 + d) exp(-d), d = sqrt(3) distance/reach.

    References
    ----------
    Rasmussen, C. E. & Williams, C. K. I. (2006). Gaussian Processes for Machine Learning, Eq. 4.17. MIT Press.

    Examples
    --------
    >>> matern_covariance(np.array([0.0, 1.0]), 1.0).round(3).tolist()
    [[1.0, 0.483], [0.483, 1.0]]

    """
    d = np.sqrt(3.0) * np.abs(knots[:, None] - knots) / reach
    return np.asarray((1 + d) * np.exp(-d))
