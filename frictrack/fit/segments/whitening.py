"""Turn errors of a measurement into numbers that are independent and of size one, and back.

Noise is white, of a size that may differ from frame to frame, beside an autoregressive part (rms, correlation time).
What a frame adds to those before it is its innovation, which Kalman's filter (1960, J. Basic Eng. 82) finds: exact
across missing frames, and a frame of unknown size says nothing. All is linear, so that the same map turns residuals and
sensitivities.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_banded

from frictrack.records import Array


@dataclass(frozen=True, eq=False)
class Whitening:
    """The map from errors (n, ...) to independent ones of size one.

    With c the prediction of the correlated part, c[i + 1] = keep[i] c[i] + gain[i] e[i], innovations are e - c over
    `size` (n,); `keep` and `gain` (n - 1,).
    """

    persistence: Array
    gain: Array
    size: Array

    @classmethod
    def of(cls, t: Array, sigma: Array, correlated: tuple[float, float]) -> Whitening:
        """For frames at t (n,), s, white noise sigma (n,) and a correlated part: rms, and correlation time in s.

        Examples
        --------
        >>> w = Whitening.of(np.arange(3.0), np.full(3, 1e-9), (2.0, 1 / np.log(2.0)))
        >>> w.whitened(np.array([2.0, 1.0, 0.5])).round(6)
        array([1., 0., 0.])

        """
        rms, time = correlated
        decay = np.exp(-np.diff(t) / time)
        variance, share, before = np.empty(len(t)), np.empty(len(t)), rms**2
        for i, white in enumerate(sigma**2):
            variance[i] = before + white
            share[i] = before / variance[i]
            if i < len(decay):
                before = decay[i] ** 2 * share[i] * white + (1 - decay[i] ** 2) * rms**2
        return cls(decay * (1 - share[:-1]), decay * share[:-1], np.sqrt(variance))

    def whitened(self, errors: Array) -> Array:
        """Innovations (n, ...) of errors (n, ...), in units of their size."""
        return (errors - _filter_forward(self.persistence, self.gain, errors)) / _column(self.size, errors)

    def coloured(self, white: Array) -> Array:
        """The errors (n, ...) of which these are the innovations."""
        innovations = white * _column(self.size, white)
        return innovations + _filter_forward(self.persistence + self.gain, self.gain, innovations)

    def transposed(self, white: Array) -> Array:
        """The transposed map: with it, the product of innovations with rows is one of errors with the result."""
        scaled = white / _column(self.size, white)
        return scaled - _filter_backward(self.persistence, self.gain, scaled)

    def coloured_transposed(self, rows: Array) -> Array:
        """The transposed map of `coloured`: what independent errors enter products of errors with rows (n, ...) by."""
        return (rows + _filter_backward(self.persistence + self.gain, self.gain, rows)) * _column(self.size, rows)


def _filter_forward(persistence: Array, gain: Array, innovations: Array) -> Array:
    """The series c (n, ...) with c[0] = 0 and c[i + 1] = keep[i] c[i] + gain[i] driven[i]."""
    banded = np.zeros((2, len(innovations)))
    banded[0], banded[1, :-1] = 1.0, -persistence
    right = np.zeros_like(innovations)
    right[1:] = _column(gain, innovations) * innovations[:-1]
    return _solved((1, 0), banded, right)


def _filter_backward(persistence: Array, gain: Array, innovations: Array) -> Array:
    """The transposed map of `_run`."""
    banded = np.zeros((2, len(innovations)))
    banded[1], banded[0, 1:] = 1.0, -persistence
    solved = _solved((0, 1), banded, innovations)
    out: Array = np.zeros_like(innovations)
    out[:-1] = _column(gain, innovations) * solved[1:]
    return out


def _solved(bands: tuple[int, int], banded: Array, right: Array) -> Array:
    """Solutions (n, ...) of banded equations for right sides (n, ...)."""
    flat = right.reshape(len(right), -1)
    return np.asarray(solve_banded(bands, banded, flat, check_finite=False)).reshape(right.shape)


def _column(values: Array, like: Array) -> Array:
    """Values (n,) that multiply an array (n, ...)."""
    return values.reshape(-1, *[1] * (like.ndim - 1))
