"""Compute standard deviations of smoothed x, v and a: noise let through, signal lost, and errors of line frequencies.

The posterior covariance assumes a signal that is as rough as the penalties say, on average over the record. Smoothing
the smoothed series once more (twicing; Tukey 1977, Exploratory Data Analysis, ch. 16) shows where it is smoother or
rougher: with the smoother A, (1 - A) A y of such a signal has the covariance A^2 (1 - A), of which A^2 (1 - A)^2 is
noise and A^3 (1 - A) is signal.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from frictrack.motion.smoother.equations import FactoredSmoother
from frictrack.motion.smoother.smoother_data import TREND_ORDER
from frictrack.motion.stencil import stencil_derivative, stencil_derivatives, stencils
from frictrack.records import Array

N_PROBES, PROBE_SEED = 24, 20261121  # random signs that estimate diagonals within a fifth (Hutchinson 1990)
MAX_LOST_RATIO = 4.0  # times the lost signal that the penalties expect
NOISE_SHARE = 0.1  # of the noise in what is taken, below which signal cannot be distinguished from it
PRIOR_WEIGHT = 0.1  # of what the penalties expect, against what a part of the record shows
MIN_PARTS = 6  # parts of the record over which lost signal is averaged


def deviations(factor: FactoredSmoother, x: Array, noise: float, interval: float) -> Array:
    """Compute standard deviations of smoothed positions and their derivatives.

    Parameters
    ----------
    factor
        The smoother.
    x
        Smoothed positions, m, (n,).
    noise
        Standard deviation of a frame of weight 1, m.
    interval
        Frame interval, s.

    Returns
    -------
    Array
        Standard deviations of x, v and a over `noise`, (3, n).

    """
    start, table = stencils(len(x), interval)
    posterior, passed = factor.posterior_and_noise_variance(start, table)
    total = passed + _lost_share(factor, x / noise, interval) * np.maximum(posterior - passed, 0.0)
    for errors in line_frequency_errors(factor, x / noise, interval):
        total += errors**2
    return np.asarray(np.sqrt(total))


def line_frequency_errors(factor: FactoredSmoother, x: Array, interval: float) -> Iterator[Array]:
    """Yield for each line the change of x, v and a by one standard deviation of its frequency, (3, n), for unit noise.

    A frequency error changes the phase of the line along the record; the smoother removes a part of that. A line found
    in n frames is known to half a Rayleigh cell, pi/n per frame, in any case.
    """
    n, d = factor.n, factor.data
    if not factor.k:
        return
    found = factor.unknowns_of(x - weighted_cubic(x, d.w)).components
    frames_from_centre = np.arange(n) - 0.5 * (n - 1)
    for line, omega in zip(found[1:], factor.lines.omega, strict=False):
        phase_error = frames_from_centre * np.gradient(line) / omega
        left = phase_error - factor.smooth(phase_error)
        information = max(float(np.sum(d.apply_inverse_covariance(phase_error) * left)), 0.0)
        yield stencil_derivatives(left, interval) / np.sqrt(information + (n / np.pi) ** 2)


def weighted_cubic(y: Array, w: Array) -> Array:
    """Fit a weighted least-squares cubic; smoothers leave it unchanged, but it would cost digits.

    Parameters
    ----------
    y, w
        Values and their weights, (n,) each.

    Returns
    -------
    Array
        The cubic, (n,).

    """
    u, information = np.linspace(-1.0, 1.0, len(y)), w > 0
    fit = np.polynomial.Polynomial.fit(
        u[information], y[information], TREND_ORDER - 1, domain=[-1, 1], w=np.sqrt(w[information])
    )
    return np.asarray(fit(u))


def _lost_share(factor: FactoredSmoother, x: Array, interval: float) -> Array:
    """Variance of the lost signal over that expected by the penalties, averaged along the record, (3, n)."""
    n = len(x)
    if factor.data.second_difference_weights is not None:  # a sensor recovers what smoothing loses
        return np.ones((3, n))
    once = factor.smooth(factor.data.probes(np.random.default_rng(PROBE_SEED), N_PROBES))
    kept = factor.smooth(once)
    lost = np.subtract(once, kept, out=once)
    residual = x - weighted_cubic(x, factor.data.w)
    taken = stencil_derivatives(residual - factor.smooth(residual), interval) ** 2
    noise, expected = np.empty((2, 3, n))
    for k in range(3):
        lost_k = stencil_derivative(lost, k)
        noise[k] = np.einsum("np,np->n", lost_k, lost_k) / (N_PROBES * interval ** (2 * k))
        expected[k] = np.einsum("np,np->n", stencil_derivative(kept, k), lost_k) / (N_PROBES * interval ** (2 * k))
    window: NDArray[np.float64] = np.ones(n // MIN_PARTS | 1)
    observed, expected_sum = (np.maximum(_moving_sum(m, window), 0.0) for m in (taken - noise, expected))
    expected_sum += _moving_sum(
        NOISE_SHARE * noise, window
    )  # signal far below the noise cannot be distinguished from it
    return np.minimum((observed + PRIOR_WEIGHT * expected_sum) / ((1.0 + PRIOR_WEIGHT) * expected_sum), MAX_LOST_RATIO)


def _moving_sum(rows: Array, window: Array) -> Array:
    """Moving sum of rows (k, n), reflected at the ends."""
    half = len(window) // 2
    return np.stack([np.convolve(np.pad(row, half, mode="reflect"), window, mode="valid") for row in rows])
