"""Smooth functions: Gaussian processes of the most likely size, interpolation; size and correlation time of a series.

A Gaussian process in the residual of a model is a smooth force that the model lacks.

The force is f = L z with coefficients z ~ N(0, s I), where L L' is a Matern covariance. Its traces in the
residual r are T f, with the model projected out of T and r. The restricted likelihood of the size s needs only the
eigenvalues w of L' T'T L and the components g of L' T'r along their eigenvectors:

    2 log p(s) = sum s g^2 / (1 + s w) - log(1 + s w)

References
----------
Rasmussen, C. E. & Williams, C. K. I. (2006). Gaussian Processes for Machine Learning, Eq. 4.17 and ch. 5. MIT Press.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.records import Array

SIZES = np.geomspace(1e-3, 1e3, 61)  # variances of a process over that of one unit of chi-squared
JITTER = 1e-8  # of unit variance, that keeps covariances of near points invertible
MIN_CORRELATED_FRAMES = 8  # shorter series count as white
CORRELATION_WINDOW = 5.0  # correlation times; the sum ends at the first lag above (Sokal 1997)


def matern_covariance(points: Array, length: float, smoothness: float = 2.5) -> Array:
    """Compute the covariance of a Matern process of unit variance.

    Examples
    --------
    >>> matern_covariance(np.array([0.0, 1.0]), 1.0).round(3).tolist()
    [[1.0, 0.524], [0.524, 1.0]]

    """
    d = np.sqrt(2 * smoothness) * np.abs(points[:, None] - points) / length
    return np.asarray((1 + d + (d**2 / 3 if smoothness > 2 else 0.0)) * np.exp(-d))


def matern_root(points: Array, length: float, smoothness: float = 2.5) -> Array:
    """Root L (K, K) of the covariance of a Matern process at points (K,)."""
    return np.asarray(np.linalg.cholesky(matern_covariance(points, length, smoothness) + JITTER * np.eye(len(points))))


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


def rms(values: Array) -> float:
    """Compute the root mean square of some values."""
    return float(np.sqrt(np.mean(values**2)))


def _autocorrelation(r: Array) -> Array:
    """Autocorrelation of a series (n,) at the lags 0 to n/2 - 1."""
    n = len(r)
    spectrum = np.abs(np.fft.rfft(r - r.mean(), 2 * n)) ** 2
    rho = np.fft.irfft(spectrum)[: n // 2]
    return np.asarray(rho / max(float(rho[0]), 1e-300))


def correlation_time_frames(r: Array) -> float:
    """Compute the integrated correlation time of a residual, summed over a growing window.

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

    Examples
    --------
    >>> linear_interpolation_matrix(np.array([0.25, 2.0]), np.array([0.0, 1.0])).tolist()
    [[0.75, 0.25], [0.0, 1.0]]

    """
    place = np.interp(axis, knots, np.arange(float(len(knots))))
    left, rows = np.minimum(place.astype(int), len(knots) - 2), np.arange(len(axis))
    out = np.zeros((len(axis), len(knots)))
    out[rows, left + 1] = place - left
    out[rows, left] = 1 - out[rows, left + 1]
    return out
