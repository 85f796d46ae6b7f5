"""The data of a structural smoother: positions with weights, colour of the noise, and penalties of lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from frictrack.records import Array

TREND_ORDER = 4  # order of the difference that the trend keeps small; it has as many free coefficients


def penalty(cutoff: float, interval: float) -> float:
    """Penalty lambda at which half of the amplitude passes at a cut-off.

    Parameters
    ----------
    cutoff
        Frequency, Hz.
    interval
        Frame interval, s.

    Returns
    -------
    float
        Lambda, in units of the weight of one frame.

    Examples
    --------
    >>> round(cutoff_of(penalty(50.0, 1e-3), 1e-3), 9)
    50.0

    """
    return float((2.0 * np.sin(np.pi * cutoff * interval)) ** (-2 * TREND_ORDER))


def cutoff_of(lam: float, interval: float) -> float:
    """Cut-off (Hz) of a penalty lambda, the inverse of `penalty`; at most half the frame rate."""
    half = 0.5 * float(lam) ** (-0.5 / TREND_ORDER)
    return float(np.arcsin(min(half, 1.0)) / np.pi / interval)


def response(omega: Array, lam: float) -> Array:
    """Share of the amplitude that a trend of penalty lambda passes at frequencies omega, radians per frame."""
    return np.asarray(1.0 / (1.0 + lam * (2.0 * np.sin(omega / 2.0)) ** (2 * TREND_ORDER)))


@dataclass(frozen=True, eq=False)
class LineParameters:
    """Frequencies omega (K,), radians per frame, and penalties mu (K,) of K lines."""

    omega: Array
    mu: Array


NO_LINES = LineParameters(np.empty(0), np.empty(0))


@dataclass(frozen=True)
class NoiseColour:
    """White noise plus a first-order autoregressive process, with unit variance together.

    Attributes
    ----------
    correlation
        Correlation of neighbouring frames of the autoregressive part, rho.
    share
        Its share of the variance.

    """

    correlation: float
    share: float

    def spectrum(self, omega: Array) -> Array:
        """Spectral density at frequencies omega, radians per frame; 1 on average."""
        response = np.abs(1.0 - self.correlation * np.exp(-1j * omega)) ** 2
        return np.asarray(1.0 - self.share + self.share * (1.0 - self.correlation**2) / response)

    @property
    def shocks(self) -> float:
        """Variance of the innovations c_j - rho c_(j-1) over that of the noise."""
        return self.share * (1.0 - self.correlation**2)

    def log_likelihood_cost(self, measured: int, n: int) -> float:
        """Determinant term in twice the negative log-likelihood of n frames, of which some were measured."""
        return float((n - 1) * np.log(self.shocks) + np.log(self.share) + measured * np.log(1.0 - self.share))

    def sample(self, white: Array, driving: Array) -> Array:
        """Generate such noise.

        Parameters
        ----------
        white, driving
            Two white series of unit variance, (n, ...) each.

        Returns
        -------
        Array
            Noise of unit variance, (n, ...).

        """
        innovations = np.concatenate([np.sqrt(self.share) * driving[:1], np.sqrt(self.shocks) * driving[1:]])
        return np.asarray(
            np.sqrt(1.0 - self.share) * white
            + scipy.signal.lfilter([1.0], [1.0, -self.correlation], innovations, axis=0)
        )


@dataclass(frozen=True, eq=False)
class SmootherData:
    """Measurements to smooth.

    Attributes
    ----------
    y, w
        Positions and their weights, each (n,); the weight is 0 where none was measured.
    second_differences, second_difference_weights
        Second differences of the position by a sensor, and their weights, each (n - 2,); weight 0 where unknown.
    colour
        Colour of the noise; None for white noise.

    """

    y: Array
    w: Array
    second_differences: Array | None = None
    second_difference_weights: Array | None = None
    colour: NoiseColour | None = None

    @property
    def precision(self) -> Array:
        """Weights (n,) with respect to the white part of the noise."""
        return self.w / (1.0 - self.colour.share) if self.colour else self.w

    def part(self, first: int, stop: int) -> SmootherData:
        """The data of frames first to stop (exclusive)."""
        sensor = (self.second_differences, self.second_difference_weights)
        bent, weights = (None if q is None else q[first : stop - 2] for q in sensor)
        return SmootherData(self.y[first:stop], self.w[first:stop], bent, weights, self.colour)

    def probes(self, rng: np.random.Generator, many: int) -> Array:
        """Random series (n, many) with the covariance of the noise, from random signs."""
        white = rng.choice([-1.0, 1.0], (len(self.w), many))
        return self.colour.sample(white, rng.choice([-1.0, 1.0], white.shape)) if self.colour else white

    def apply_inverse_covariance(self, y: Array) -> Array:
        """Multiply columns by the inverse covariance of unit noise.

        Parameters
        ----------
        y
            Columns, (n, ...).

        Returns
        -------
        Array
            Products, (n, ...).

        """
        weighted = weighted_columns(self.precision, y)
        if not self.colour:
            return weighted
        n, rho, inverse_innovation = len(self.w), self.colour.correlation, 1.0 / self.colour.shocks
        banded = np.zeros((3, n))
        banded[0, 1:] = banded[2, :-1] = -rho * inverse_innovation
        banded[1] = self.precision + inverse_innovation * (1.0 + rho**2 * (np.arange(n) < n - 1))
        banded[1, 0] += 1.0 / self.colour.share - inverse_innovation
        flat = scipy.linalg.solve_banded((1, 1), banded, weighted.reshape(n, -1)).reshape(weighted.shape)
        return weighted - weighted_columns(self.precision, flat)

    @property
    def count(self) -> int:
        """Number of measured values."""
        return int(np.sum(self.w > 0)) + (
            0 if self.second_difference_weights is None else int(np.sum(self.second_difference_weights > 0))
        )


def weighted_columns(w: Array, y: Array) -> Array:
    """Weights (n,) times columns (n, ...)."""
    return np.asarray(w.reshape(-1, *[1] * (y.ndim - 1)) * y)
