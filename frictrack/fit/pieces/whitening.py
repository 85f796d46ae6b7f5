"""Whiten measurement errors: convert them to independent numbers of standard deviation one, and back.

The noise is white, with a standard deviation per frame, plus in some sensors a first-order autoregressive part (rms,
correlation time). Kalman's filter computes the innovation of every frame. It is exact across missing frames, and a
frame of unknown size adds no information. The map is linear, so it also applies to sensitivities.

References
----------
Kalman, R. E. (1960). A new approach to linear filtering and prediction problems. J. Basic Eng. 82, 35-45.

"""

from __future__ import annotations

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
    size : array of shape (n,)
        Standard deviations of the innovations e - c.
    persistence, gain : array of shape (n - 1,), optional
        Coefficients of the recursion; None where all noise is white, so that c is zero.

    """

    size: Array
    persistence: Array | None = None
    gain: Array | None = None

    @classmethod
    def of(cls, t: Array, sigma: Array, correlated: tuple[float, ...]) -> Whitening:
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
        return cls(np.sqrt(variance), decay * (1 - share[:-1]), decay * share[:-1])

    def whitened(self, errors: Array) -> Array:
        """Compute the innovations (n, ...) of errors (n, ...), in units of their standard deviation."""
        return np.asarray((errors - self._predicted(errors, 0.0)) / _column(self.size, errors))

    def coloured(self, white: Array) -> Array:
        """Compute the errors (n, ...) that have these innovations."""
        innovations = white * _column(self.size, white)
        return np.asarray(innovations + self._predicted(innovations, 1.0))

    def transposed(self, white: Array) -> Array:
        """Apply the transposed map of `whitened`."""
        scaled = white / _column(self.size, white)
        return np.asarray(scaled - self._predicted_transposed(scaled, 0.0))

    def coloured_transposed(self, rows: Array) -> Array:
        """Apply the transposed map of `coloured` to rows (n, ...)."""
        return np.asarray((rows + self._predicted_transposed(rows, 1.0)) * _column(self.size, rows))

    def _predicted(self, e: Array, feedback: float) -> Array | float:
        """The series c (n, ...) with c[0] = 0 and c[i + 1] = (persistence + feedback gain)[i] c[i] + gain[i] e[i].

        From errors e the feedback is 0; from innovations, which are errors less c, it is 1.
        """
        if self.persistence is None or self.gain is None:
            return 0.0
        banded, right = np.ones((2, len(e))), np.zeros_like(e)
        banded[1, :-1] = -(self.persistence + feedback * self.gain)
        right[1:] = _column(self.gain, e) * e[:-1]
        return _solve((1, 0), banded, right)

    def _predicted_transposed(self, e: Array, feedback: float) -> Array | float:
        """The transposed map of `_predicted`."""
        if self.persistence is None or self.gain is None:
            return 0.0
        banded, out = np.ones((2, len(e))), np.zeros_like(e)
        banded[0, 1:] = -(self.persistence + feedback * self.gain)
        out[:-1] = _column(self.gain, e) * _solve((0, 1), banded, e)[1:]
        return out


def _solve(bands: tuple[int, int], banded: Array, right: Array) -> Array:
    """Solutions (n, ...) of banded equations for right sides (n, ...)."""
    flat = right.reshape(len(right), -1)
    return np.asarray(solve_banded(bands, banded, flat, check_finite=False)).reshape(right.shape)


def _column(values: Array, like: Array) -> Array:
    """Values (n,) reshaped to multiply an array (n, ...)."""
    return values.reshape(-1, *[1] * (like.ndim - 1))
