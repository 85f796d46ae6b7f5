"""What a structural smoother's x, v and a are worth: noise that passes, signal that is lost, frequencies that err.

The posterior covariance takes the signal to be as ragged as the penalties say, on average over the record. What
smoothing takes from the smoothed series once more (Tukey's twicing) shows where it is smoother than that, or less so:
with A the smoother and a signal as ragged as the penalties say, (1 - A) A y has the covariance A^2 (1 - A), of which
A^2 (1 - A)^2 is noise and A^3 (1 - A) is signal.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from frictrack.motion.stencil import stencil_derivative, stencil_derivatives, stencils
from frictrack.motion.system import TREND_ORDER, FactoredSmoother
from frictrack.records import Array

N_PROBES, PROBE_SEED = (
    24,
    20261121,
)  # series of random signs by which diagonals are estimated, to a fifth (Hutchinson 1990)
MAX_LOST_RATIO = 4.0  # times the lost signal that the penalties expect
NOISE_SHARE = 0.1  # of the noise in what is taken, below which signal cannot be distinguished from it
PRIOR_WEIGHT = 0.1  # of what the penalties expect, against what a part of the record shows
MIN_PARTS = 6  # parts of the record over which lost signal is averaged


def deviations(factor: FactoredSmoother, x: Array, noise: float, interval: float) -> Array:
    """Standard deviations (3, n) of smoothed x (n,) and its derivatives, in units of the `noise` of a frame."""
    start, table = stencils(len(x), interval)
    both, passed = factor.posterior_and_noise_variance(start, table)
    total = passed + _lost_share(factor, x / noise, interval) * np.maximum(both - passed, 0.0)
    for turned in line_frequency_errors(factor, x / noise, interval):
        total += turned**2
    return np.asarray(np.sqrt(total))


def line_frequency_errors(factor: FactoredSmoother, x: Array, interval: float) -> Iterator[Array]:
    """Change (3, n) of x, v and a by one standard deviation of the frequency of each line, for unit noise.

    A frequency that is off turns the line's phase along the record; what the smoother makes of that is left out.
    """
    s, d = factor.layout, factor.data
    if not s.k:
        return
    found = factor.unknowns_of(x - weighted_cubic(x, d.w))
    along = np.arange(s.n) - 0.5 * (s.n - 1)
    for row, omega in zip(s.frame[1:], factor.lines.omega, strict=True):
        turn = along * np.gradient(found[row]) / omega
        left = turn - factor.smooth(turn)
        known = float(np.sum(d.whitened(turn) * left))
        yield stencil_derivatives(left, interval) / np.sqrt(max(known, np.finfo(float).tiny))


def weighted_cubic(y: Array, w: Array) -> Array:
    """Weighted cubic (n,) through y: every smoother leaves it as it is, but it would cost digits."""
    u, known = np.linspace(-1.0, 1.0, len(y)), w > 0
    fit = np.polynomial.Polynomial.fit(u[known], y[known], TREND_ORDER - 1, domain=[-1, 1], w=np.sqrt(w[known]))
    return np.asarray(fit(u))


def _lost_share(factor: FactoredSmoother, x: Array, interval: float) -> Array:
    """Variance of the signal lost over that which the penalties expect (3, n), averaged along the record."""
    n = len(x)
    if factor.data.worth is not None:  # what a sensor saw is not lost
        return np.ones((3, n))
    once = factor.smooth(factor.data.probes(np.random.default_rng(PROBE_SEED), N_PROBES))
    twice = factor.smooth(once)
    rest = x - weighted_cubic(x, factor.data.w)
    taken = stencil_derivatives(rest - factor.smooth(rest), interval) ** 2
    kept, lost = (np.stack([stencil_derivative(m, k) / interval**k for k in range(3)]) for m in (twice, once - twice))
    noise = np.mean(lost**2, axis=2)
    expected = np.mean(kept * lost, axis=2)
    window: NDArray[np.float64] = np.ones(n // MIN_PARTS | 1)
    seen, wanted = (np.maximum(_moving_sum(m, window), 0.0) for m in (taken - noise, expected))
    wanted += _moving_sum(NOISE_SHARE * noise, window)  # what is far below the noise cannot be told from it
    return np.minimum((seen + PRIOR_WEIGHT * wanted) / ((1.0 + PRIOR_WEIGHT) * wanted), MAX_LOST_RATIO)


def _moving_sum(rows: Array, window: Array) -> Array:
    half = len(window) // 2
    return np.stack([np.convolve(np.pad(row, half, mode="reflect"), window, mode="valid") for row in rows])
