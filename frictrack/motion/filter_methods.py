"""Other filters for comparison: Butterworth, Savitzky-Golay and Gaussian process, with parameters from the data.

Each is a linear map of the frames. Missing frames are bridged by straight lines. The signal that a filter removes is
estimated by filtering once more (twicing; Tukey 1977, Exploratory Data Analysis, ch. 16).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
import scipy
from numpy.polynomial import polynomial

from frictrack.errors import FrictrackError
from frictrack.motion.stencil import stencil_derivative
from frictrack.records import Array, Mask

CUTOFFS = np.geomspace(0.002, 0.4, 60)  # tried for Butterworth, cycles per frame
BUTTERWORTH_ORDER = 4
MAX_RESIDUAL_SIGMAS = 2.0  # standard deviations by which the residual's mean square may exceed the noise
WINDOW_FRAMES = np.unique(np.round(np.geomspace(5, 401, 40)).astype(int) | 1)  # tried for Savitzky-Golay
DEGREES = (3, 4, 5)
MAX_FRAMES = 3000  # of a Gaussian process, whose cost grows with their cube
MAX_LOG_PARAMETER = 20.0  # log of a length or an amplitude
HALF_AMPLITUDE_CUTOFF = 0.1874  # f l at which exp(-(2 pi f l)^2 / 2) is one half


class FilterMethod(Protocol):
    """A linear filter of evenly spaced frames."""

    name: ClassVar[str]

    @property
    def cutoff(self) -> float:
        """Frequency at which half of the amplitude passes, cycles per frame."""

    def derived(self, y: Array, order: int) -> Array:
        """Derivative of order 0 to 2 of the filtered columns (n, ...), per frame."""


@dataclass(frozen=True)
class Butterworth:
    """Butterworth filter forward and backward, without a cubic, which would ring at the ends.

    Attributes
    ----------
    low
        Frequency at which both passes together keep half of the amplitude, cycles per frame.

    """

    low: float
    name: ClassVar[str] = "butterworth"

    @property
    def cutoff(self) -> float:
        """Frequency at which half of the amplitude passes, cycles per frame."""
        return self.low

    def derived(self, y: Array, order: int) -> Array:
        """Derivative of the filtered columns (n, ...) by central differences, per frame."""
        return stencil_derivative(self._smooth(y), order)

    def _smooth(self, y: Array) -> Array:
        trend = _cubic(y)
        sos = scipy.signal.butter(BUTTERWORTH_ORDER, 2 * self.low, output="sos")
        reach = min(len(y) - 1, int(np.ceil(1 / self.low)))
        return np.asarray(trend + scipy.signal.sosfiltfilt(sos, y - trend, axis=0, padtype="odd", padlen=reach))

    @classmethod
    def fit(cls, y: Array, noise: float) -> Butterworth:
        """Choose the lowest cut-off that removes no more than the noise (residual analysis).

        Parameters
        ----------
        y
            Positions, (n,).
        noise
            Standard deviation of the noise, in the unit of y.

        Returns
        -------
        Butterworth
            The filter.

        References
        ----------
        Winter 2009, Biomechanics and Motor Control of Human Movement, ch. 3.

        """
        for low in CUTOFFS:
            made = cls(float(low))
            rest = y - made._smooth(y)
            if np.mean(rest**2) <= noise**2 * (1 - 2 * low) * (1 + MAX_RESIDUAL_SIGMAS * np.sqrt(2 / len(y))):
                return made
        return cls(float(CUTOFFS[-1]))


@dataclass(frozen=True)
class SavitzkyGolay:
    """Polynomial of a degree through a window of frames (Savitzky & Golay 1964), full windows at the ends."""

    window: int
    degree: int
    name: ClassVar[str] = "savitzky-golay"

    @property
    def cutoff(self) -> float:
        """Frequency at which half of the amplitude passes, cycles per frame."""
        response = np.abs(np.fft.rfft(scipy.signal.savgol_coeffs(self.window, self.degree), 8192))
        return float(np.argmax(response < 0.5) / 8192)

    def derived(self, y: Array, order: int) -> Array:
        """Derivative of the polynomials through the columns (n, ...), per frame."""
        return np.asarray(scipy.signal.savgol_filter(y, self.window, self.degree, deriv=order, axis=0, mode="interp"))

    @classmethod
    def fit(cls, y: Array, noise: float) -> SavitzkyGolay:
        """Choose window and degree by generalised cross-validation.

        Parameters
        ----------
        y
            Positions, (n,).
        noise
            Not used.

        Returns
        -------
        SavitzkyGolay
            The filter.

        References
        ----------
        Craven & Wahba 1979, Numer. Math. 31, 377-403.

        """
        del noise
        tried = [cls(int(w), d) for d in DEGREES for w in WINDOW_FRAMES if d + 1 < w <= len(y)]
        return min(tried, key=lambda m: m._cross_validation_score(y))

    def _cross_validation_score(self, y: Array) -> float:
        """Generalised cross-validation score."""
        middle = float(scipy.signal.savgol_coeffs(self.window, self.degree)[self.window // 2])
        return float(np.mean((y - self.derived(y, 0)) ** 2)) / (1.0 - middle) ** 2


@dataclass(frozen=True)
class GaussianProcess:
    """Gaussian process with squared-exponential covariance plus a cubic (Rasmussen & Williams 2006, ch. 2).

    Attributes
    ----------
    length
        Length of the covariance, frames.
    size
        Standard deviation over that of the noise, which is known.

    """

    length: float
    size: float
    name: ClassVar[str] = "gaussian-process"

    @property
    def cutoff(self) -> float:
        """Frequency at which half of the amplitude of the prior remains, cycles per frame."""
        return HALF_AMPLITUDE_CUTOFF / self.length

    def derived(self, y: Array, order: int) -> Array:
        """Derivative of the posterior mean of the columns (n, ...) by central differences, per frame."""
        trend = _cubic(y)
        covariance = self._covariance(len(y))
        known = scipy.linalg.cho_factor(covariance + np.eye(len(y)), overwrite_a=True)
        return stencil_derivative(trend + covariance @ scipy.linalg.cho_solve(known, y - trend), order)

    def _covariance(self, n: int) -> Array:
        """Covariance of n frames."""
        apart = (np.arange(n)[:, None] - np.arange(n)) / self.length
        return np.asarray(self.size**2 * np.exp(-0.5 * apart**2))

    @classmethod
    def fit(cls, y: Array, noise: float) -> GaussianProcess:
        """Choose length and size by marginal likelihood, on every k-th frame.

        Parameters
        ----------
        y
            Positions, (n,).
        noise
            Standard deviation of the noise, in the unit of y.

        Returns
        -------
        GaussianProcess
            The process.

        Raises
        ------
        FrictrackError
            For more than `MAX_FRAMES` frames.

        References
        ----------
        Rasmussen & Williams 2006, Gaussian Processes for Machine Learning, ch. 5.

        """
        if len(y) > MAX_FRAMES:
            raise FrictrackError(
                f"low_pass: expected at most {MAX_FRAMES} frames for a Gaussian process but got {len(y)}; "
                'use the default or method = "kalman"'
            )
        rest = (y - _cubic(y)) / noise
        step = max(1, len(y) // 400)

        def loss(p: Array) -> float:
            if not 0 < p[0] < MAX_LOG_PARAMETER or abs(p[1]) > MAX_LOG_PARAMETER:
                return np.inf
            made = cls(float(np.exp(p[0])) / step, float(np.exp(p[1])))
            try:
                known = np.linalg.cholesky(made._covariance(len(rest[::step])) + np.eye(len(rest[::step])))
            except np.linalg.LinAlgError:
                return np.inf
            return float(np.sum(np.linalg.solve(known, rest[::step]) ** 2) + 2 * np.sum(np.log(np.diag(known))))

        size = float(np.log(max(float(np.std(rest)), 1.0)))
        starts = [np.array([np.log(k), size]) for k in np.geomspace(2 * step, len(y) / 4, 6)]
        best = starts[int(np.argmin([loss(p) for p in starts]))]
        found = scipy.optimize.minimize(loss, best, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.02}).x
        return cls(float(np.exp(found[0])), float(np.exp(found[1])))


METHODS: Mapping[str, Any] = {m.name: m for m in (Butterworth, SavitzkyGolay, GaussianProcess)}


def interpolate_missing(y: Array, known: Mask) -> Array:
    """Interpolate missing frames linearly.

    Parameters
    ----------
    y
        Columns, (n, ...).
    known
        Measured frames, (n,).

    Returns
    -------
    Array
        The columns without gaps, (n, ...).

    Examples
    --------
    >>> interpolate_missing(np.array([0.0, 9.0, 4.0]), np.array([True, False, True])).tolist()
    [0.0, 2.0, 4.0]

    """
    if known.all():
        return y
    n = np.arange(len(y))
    flat = y.reshape(len(y), -1)
    return np.stack([np.interp(n, n[known], column[known]) for column in flat.T], axis=1).reshape(y.shape)


def _cubic(y: Array) -> Array:
    """Least-squares cubic (n, ...) through columns."""
    u = np.linspace(-1.0, 1.0, len(y))
    flat = y.reshape(len(y), -1)
    return np.asarray(polynomial.polyval(u, polynomial.polyfit(u, flat, 3)).T.reshape(y.shape))
