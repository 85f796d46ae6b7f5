"""Whiten measurement errors: convert them to independent numbers of standard deviation one, and back.

The noise is white, with a standard deviation per frame, plus a first-order autoregressive part (rms, correlation
time). Kalman's filter computes the innovation of every frame. It is exact across missing frames, and a frame of
unknown size adds no information. The map is linear, so it also applies to sensitivities.

References
----------
Kalman, R. E. (1960). A new approach to linear filtering and prediction problems. J. Basic Eng. 82, 35-45.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_banded

from frictrack.records import Array


@dataclass(frozen=True, eq=False)
class Whitening:
    """The linear map from errors (n, ...) to independent ones of standard deviation one.

    The prediction c of the correlated part follows c[i + 1] = persistence[i] c[i] + gain[i] e[i].

    Attributes
    ----------
    persistence, gain : array of shape (n - 1,)
        Coefficients of the recursion.
    size : array of shape (n,)
        Standard deviations of the innovations e - c.

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

    @classmethod
    def joined(cls, parts: Sequence[Whitening]) -> Whitening:
        """Return the map of several series end to end, each independent of the one before."""
        persistence = np.concatenate([np.append(w.persistence, 0.0) for w in parts])[:-1]
        gain = np.concatenate([np.append(w.gain, 0.0) for w in parts])[:-1]
        return cls(persistence, gain, np.concatenate([w.size for w in parts]))

    def whitened(self, errors: Array) -> Array:
        """Compute the innovations (n, ...) of errors (n, ...), in units of their standard deviation."""
        return (errors - _filter_forward(self.persistence, self.gain, errors)) / _column(self.size, errors)

    def coloured(self, white: Array) -> Array:
        """Compute the errors (n, ...) that have these innovations."""
        innovations = white * _column(self.size, white)
        return innovations + _filter_forward(self.persistence + self.gain, self.gain, innovations)

    def transposed(self, white: Array) -> Array:
        """Apply the transposed map of `whitened`."""
        scaled = white / _column(self.size, white)
        return scaled - _filter_backward(self.persistence, self.gain, scaled)

    def coloured_transposed(self, rows: Array) -> Array:
        """Apply the transposed map of `coloured` to rows (n, ...)."""
        return (rows + _filter_backward(self.persistence + self.gain, self.gain, rows)) * _column(self.size, rows)


def _filter_forward(persistence: Array, gain: Array, innovations: Array) -> Array:
    """The series c (n, ...) with c[0] = 0 and c[i + 1] = persistence[i] c[i] + gain[i] innovations[i]."""
    banded = np.zeros((2, len(innovations)))
    banded[0], banded[1, :-1] = 1.0, -persistence
    right = np.zeros_like(innovations)
    right[1:] = _column(gain, innovations) * innovations[:-1]
    return _solved((1, 0), banded, right)


def _filter_backward(persistence: Array, gain: Array, innovations: Array) -> Array:
    """The transposed map of `_filter_forward`."""
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
    """Values (n,) reshaped to multiply an array (n, ...)."""
    return values.reshape(-1, *[1] * (like.ndim - 1))
