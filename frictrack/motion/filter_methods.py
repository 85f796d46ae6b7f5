"""The other filters, for comparison: each a linear map of the frames whose numbers are settled from the data.

They know no gaps (missing frames are bridged by a straight line) and no prior, so that what they lose of the signal is
estimated by filtering the filtered series once more (twicing; Tukey 1977, Exploratory Data Analysis, ch. 16).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.polynomial import polynomial
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.signal import butter, savgol_coeffs, savgol_filter, sosfiltfilt

from frictrack.errors import FrictrackError
from frictrack.motion.stencil import stencil_derivative
from frictrack.records import Array, Mask

CUTOFFS = np.geomspace(0.002, 0.4, 60)  # tried by Butterworth, over the frame rate
BUTTERWORTH_ORDER = 4
MAX_RESIDUAL_SIGMAS = 2.0  # standard deviations that the residual's mean square may lie above the noise
WINDOW_FRAMES = np.unique(np.round(np.geomspace(5, 401, 40)).astype(int) | 1)  # tried by Savitzky and Golay, frames
DEGREES = (3, 4, 5)
MAX_FRAMES = 3000  # of a Gaussian process, whose cost grows with the cube of them
MAX_LOG_PARAMETER = 20.0  # log of a length or a size
HALF_AMPLITUDE_CUTOFF = 0.1874  # cut-off at which exp(-(2 pi f l)^2 / 2) is one half, times the length l


class FilterMethod(Protocol):
    """A linear filter of evenly spaced frames."""

    name: ClassVar[str]

    @property
    def cutoff(self) -> float:
        """Cycles per frame of which half of the amplitude passes."""

    def derived(self, y: Array, order: int) -> Array:
        """Derivative of an order, 0 to 2, of the columns (n, ...) after filtering, per frame."""


@dataclass(frozen=True)
class Butterworth:
    """Forward and backward Butterworth filter; a cubic is left out, or its ends would ring."""

    low: float  # cycles per frame of which half of the amplitude passes, both ways together
    name: ClassVar[str] = "butterworth"

    @property
    def cutoff(self) -> float:
        """Cycles per frame of which half of the amplitude passes."""
        return self.low

    def derived(self, y: Array, order: int) -> Array:
        """Derivative of an order of the filtered columns (n, ...), by central differences."""
        return stencil_derivative(self._smooth(y), order)

    def _smooth(self, y: Array) -> Array:
        trend = _cubic(y)
        sos = butter(BUTTERWORTH_ORDER, 2 * self.low, output="sos")
        reach = min(len(y) - 1, int(np.ceil(1 / self.low)))
        return np.asarray(trend + sosfiltfilt(sos, y - trend, axis=0, padtype="odd", padlen=reach))

    @classmethod
    def fit(cls, y: Array, noise: float) -> Butterworth:
        """Residual analysis (Winter 2009): the lowest cut-off that takes away no more than the noise `noise`."""
        for low in CUTOFFS:
            made = cls(float(low))
            rest = y - made._smooth(y)
            if np.mean(rest**2) <= noise**2 * (1 - 2 * low) * (1 + MAX_RESIDUAL_SIGMAS * np.sqrt(2 / len(y))):
                return made
        return cls(float(CUTOFFS[-1]))


@dataclass(frozen=True)
class SavitzkyGolay:
    """A polynomial through the frames of a window, whole windows at the ends."""

    window: int
    degree: int
    name: ClassVar[str] = "savitzky-golay"

    @property
    def cutoff(self) -> float:
        """Cycles per frame of which half of the amplitude passes."""
        response = np.abs(np.fft.rfft(savgol_coeffs(self.window, self.degree), 8192))
        return float(np.argmax(response < 0.5) / 8192)

    def derived(self, y: Array, order: int) -> Array:
        """Derivative of an order of the polynomials through the columns (n, ...)."""
        return np.asarray(savgol_filter(y, self.window, self.degree, deriv=order, axis=0, mode="interp"))

    @classmethod
    def fit(cls, y: Array, noise: float) -> SavitzkyGolay:
        """Window and degree of the least generalised cross-validation (Craven & Wahba 1979)."""
        del noise
        tried = [cls(int(w), d) for d in DEGREES for w in WINDOW_FRAMES if d + 1 < w <= len(y)]
        return min(tried, key=lambda m: m._cross_validation_score(y))

    def _cross_validation_score(self, y: Array) -> float:
        middle = float(savgol_coeffs(self.window, self.degree)[self.window // 2])
        return float(np.mean((y - self.derived(y, 0)) ** 2)) / (1.0 - middle) ** 2


@dataclass(frozen=True)
class GaussianProcess:
    """A squared-exponential covariance beside a cubic, the noise known (Rasmussen & Williams 2006, ch. 2)."""

    length: float  # frames
    size: float  # standard deviation over that of the noise
    name: ClassVar[str] = "gaussian-process"

    @property
    def cutoff(self) -> float:
        """Cycles per frame of which half of the prior's amplitude is left."""
        return HALF_AMPLITUDE_CUTOFF / self.length

    def derived(self, y: Array, order: int) -> Array:
        """Derivative of an order of the posterior mean of the columns (n, ...), by central differences."""
        trend = _cubic(y)
        covariance = self._covariance(len(y))
        known = cho_factor(covariance + np.eye(len(y)), overwrite_a=True)
        return stencil_derivative(trend + covariance @ cho_solve(known, y - trend), order)

    def _covariance(self, n: int) -> Array:
        apart = (np.arange(n)[:, None] - np.arange(n)) / self.length
        return np.asarray(self.size**2 * np.exp(-0.5 * apart**2))

    @classmethod
    def fit(cls, y: Array, noise: float) -> GaussianProcess:
        """Length and size of the highest marginal likelihood, sought on every k-th frame first."""
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
        found = minimize(loss, best, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.02}).x
        return cls(float(np.exp(found[0])), float(np.exp(found[1])))


METHODS: Mapping[str, Any] = {m.name: m for m in (Butterworth, SavitzkyGolay, GaussianProcess)}


def interpolate_missing(y: Array, known: Mask) -> Array:
    """Columns (n, ...) with straight lines over the frames that are not known."""
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
