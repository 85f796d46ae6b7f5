"""Smooth functions: interpolation, the correlation time of a series, and Gaussian processes of the most likely size.

A force that a model lacks is estimated as a Gaussian process f = L z of coefficients, z ~ N(0, s I), where L L' is the
Matern 5/2 covariance. Its traces in the residual r are T f, with the model projected out of T and r. The restricted
likelihood of the size s needs only the eigenvalues w of L' T'T L and the components g of L' T'r:

    2 log p(s) = sum s g^2 / (1 + s w) - log(1 + s w)

References
----------
Rasmussen, C. E. & Williams, C. K. I. (2006). Gaussian Processes for Machine Learning, Eq. 4.17 and ch. 5. MIT Press.
Trefethen, L. N. (2013). Approximation Theory and Approximation Practice, ch. 3 and 5. SIAM.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from frictrack.records import Array

SIZES = np.geomspace(1e-3, 1e3, 61)  # variances of a process over that of one unit of chi-squared
JITTER = 1e-8  # of unit variance, that keeps covariances of near points invertible


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


def matern_covariance(points: Array, length: float) -> Array:
    """Compute the covariance of a Matern 5/2 process of unit variance.

    Parameters
    ----------
    points : array of shape (K,)
        Where it is evaluated.
    length : float
        Correlation length, in the unit of the points.

    Returns
    -------
    array of shape (K, K)
        Covariance (1 + d + d^2/3) exp(-d), d = sqrt(5) distance/length.

    Examples
    --------
    >>> matern_covariance(np.array([0.0, 1.0]), 1.0).round(3).tolist()
    [[1.0, 0.524], [0.524, 1.0]]

    """
    d = np.sqrt(5.0) * np.abs(points[:, None] - points) / length
    return np.asarray((1 + d + d**2 / 3) * np.exp(-d))


def matern_root(points: Array, length: float) -> Array:
    """Root L (K, K) of the covariance of a Matern 5/2 process at points (K,)."""
    return np.asarray(np.linalg.cholesky(matern_covariance(points, length) + JITTER * np.eye(len(points))))


@dataclass(frozen=True)
class SmoothProcess:
    """The most likely Gaussian process of K coefficients.

    Attributes
    ----------
    gain : float
        Twice the rise of the log restricted likelihood over that of no force.
    root : int
        Which of the roots, and so which correlation length.
    mean : array of shape (K,)
        Its mean.
    spread, prior : array of shape (K, K)
        Roots of its covariance, with the data and without.

    """

    gain: float
    root: int
    mean: Array
    spread: Array
    prior: Array


def most_likely_process(gram: Array, data: Array, roots: Sequence[Array], max_trace: float = np.inf) -> SmoothProcess:
    """Find the correlation length and size of the highest restricted likelihood.

    Parameters
    ----------
    gram : array of shape (K, K)
        Gram matrix T'T of the traces of unit coefficients, the model projected out.
    data : array of shape (K,)
        Their products T'r with the residual.
    roots : sequence of array of shape (K, K)
        Root of the covariance for every correlation length.
    max_trace : float
        Largest standard deviation of a trace of the process, in those of the noise.

    Returns
    -------
    SmoothProcess

    """
    found = [_most_likely_size(gram, data, root, max_trace) for root in roots]
    best = int(np.argmax([one.gain for one in found]))
    return replace(found[best], root=best)


def _most_likely_size(gram: Array, data: Array, root: Array, max_trace: float) -> SmoothProcess:
    """The process of one correlation length at its most likely size."""
    values, vectors = np.linalg.eigh(root.T @ gram @ root)
    values = np.maximum(values, 0.0)
    g = vectors.T @ (root.T @ data)
    sizes = SIZES[:, None] * max(float(g @ g) / max(float(values @ values), 1e-300), 1e-300)
    sizes = np.minimum(sizes, max_trace**2 / max(float(values[-1]), 1e-300))
    gains = np.sum(sizes * g**2 / (1 + sizes * values) - np.log1p(sizes * values), axis=1)
    best = int(np.argmax(gains))
    size = float(sizes[best, 0])
    shrunk = size / (1 + size * values)
    basis = root @ vectors
    return SmoothProcess(float(gains[best]), 0, basis @ (shrunk * g), basis * np.sqrt(shrunk), basis * np.sqrt(size))
