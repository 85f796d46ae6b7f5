"""Interpolate smooth functions from Chebyshev points or from knots, and compute over how many frames they correlate.

References
----------
Trefethen, L. N. (2013). Approximation Theory and Approximation Practice, ch. 3 and 5. SIAM.

"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from frictrack.records import Array


@dataclass(frozen=True)
class ChebyshevAxis:
    """Interpolation by the polynomial through the Chebyshev points of an interval.

    Examples
    --------
    >>> axis = ChebyshevAxis.over(0.0, 2.0, 4)
    >>> values = axis.points**3
    >>> (axis.weights(np.array([1.5])) @ values).round(6).tolist()
    [3.375]
    >>> np.allclose(axis.slopes @ values, 3 * axis.points**2)
    True

    """

    low: float
    high: float
    count: int

    @classmethod
    def over(cls, low: float, high: float, count: int) -> ChebyshevAxis:
        """Return an axis of `count` points, of one point where the interval is empty."""
        return cls(low, high, count if high > low else 1)

    @cached_property
    def points(self) -> Array:
        """The interpolation points (n,)."""
        angles = np.pi * (2 * np.arange(self.count) + 1) / (2 * self.count)
        return np.asarray(0.5 * (self.low + self.high) - 0.5 * (self.high - self.low) * np.cos(angles))

    @cached_property
    def slopes(self) -> Array:
        """Map (n, n) from values at the points to the slopes of the polynomial there."""
        if self.count == 1:
            return np.zeros((1, 1))
        polynomials = np.eye(self.count)
        scale = 2 / (self.high - self.low)
        series = np.polynomial.chebyshev.chebder(polynomials, axis=0)
        values = np.polynomial.chebyshev.chebval(self._unit(self.points), series)
        return np.asarray(scale * values.T @ self._inverse)

    @cached_property
    def _inverse(self) -> Array:
        return np.asarray(np.linalg.inv(self._polynomials(self.points)))

    def weights(self, x: Array) -> Array:
        """Compute the weights (Q, n) of the points at positions (Q,)."""
        return np.ones((len(x), 1)) if self.count == 1 else self._polynomials(x) @ self._inverse

    def _unit(self, x: Array) -> Array:
        return np.clip((2 * x - self.low - self.high) / (self.high - self.low), -1.0, 1.0)

    def _polynomials(self, x: Array) -> Array:
        return np.asarray(np.cos(np.arange(self.count) * np.arccos(self._unit(x))[:, None]))


def correlation_time_frames(r: Array, window: float = 5.0) -> float:
    """Compute the integrated correlation time of a residual, summed over a growing window.

    Parameters
    ----------
    r : array of shape (n,)
        Residual.
    window : float
        The sum ends at the first lag above this multiple of the correlation time.

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
    n = len(r)
    if n < 8:
        return 1.0
    spectrum = np.abs(np.fft.rfft(r - r.mean(), 2 * n)) ** 2
    rho = np.fft.irfft(spectrum)[: n // 2]
    total = 1 + 2 * np.cumsum(rho[1:] / max(float(rho[0]), 1e-300))
    far = np.flatnonzero(np.arange(1, len(total) + 1) >= window * total)
    return max(float(total[far[0]] if len(far) else total[-1]), 1.0)


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
