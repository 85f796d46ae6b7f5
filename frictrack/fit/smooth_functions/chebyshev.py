"""Interpolate smooth functions from Chebyshev points, with their slopes.

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
