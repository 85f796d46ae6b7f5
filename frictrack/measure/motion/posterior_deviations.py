"""Compute standard deviations of smoothed x, v and a: noise let through, signal lost, and errors of line frequencies.

The posterior covariance assumes a signal that is as rough as the penalties say, on average over the record. Smoothing
the smoothed series once more (twicing; Tukey 1977, Exploratory Data Analysis, ch. 16) shows where it is smoother or
rougher: with the smoother A, (1 - A) A y of such a signal has the covariance A^2 (1 - A), of which A^2 (1 - A)^2 is
noise and A^3 (1 - A) is signal.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import scipy

from frictrack.measure.motion.grid import stencil_derivative, stencil_derivatives, stencil_start, stencil_weights
from frictrack.measure.motion.smoother import FactoredSmoother
from frictrack.measure.motion.smoother_data import TREND_ORDER
from frictrack.records import Array

N_PROBES, PROBE_SEED = 24, 20261121  # random signs that estimate diagonals within a fifth (Hutchinson 1990)
PERIODS_OF_PROBES = 250  # of the cut-off; a longer record needs fewer probes for averages as precise
MAX_LOST_RATIO = 4.0  # times the lost signal that the penalties expect
NOISE_SHARE = 0.1  # of the noise in what is taken, below which signal cannot be distinguished from it
PRIOR_WEIGHT = 0.1  # of what the penalties expect, against what a part of the record shows
CUBIC_FRAMES = 1 << 16  # taken at once to fit a cubic
PROBE_VALUES = 1 << 21  # of the probes that are smoothed at once
MAX_BINS = 1 << 17  # of the lost signal along the record
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
    weights = partial(stencil_weights, len(x), interval)
    share = _lost_share(factor, x / noise, interval)

    def with_lost(both: Array, rows: slice) -> Array:
        posterior, passed = both
        lost = share[:, np.arange(rows.start, rows.stop) // _bin_frames(len(x))] * np.maximum(posterior - passed, 0.0)
        return np.asarray(passed + lost)

    total = factor.posterior_and_noise_variance(stencil_start(len(x)), weights, with_lost)
    return np.asarray(np.sqrt(total, out=total))


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
    u = np.linspace(-1.0, 1.0, len(y))
    triangle: Array = np.empty((0, TREND_ORDER + 1))  # of the QR factors of the frames so far
    for first in range(0, len(y), CUBIC_FRAMES):
        rows = slice(first, first + CUBIC_FRAMES)
        equations = np.column_stack([np.vander(u[rows], TREND_ORDER), np.where(w[rows] > 0, y[rows], 0.0)])
        rows_so_far = np.concatenate([triangle, equations * np.sqrt(w[rows, None])])
        triangle = np.asarray(np.linalg.qr(rows_so_far, mode="r"))
    return np.asarray(np.polyval(np.linalg.lstsq(triangle[:, :-1], triangle[:, -1])[0], u))


def _lost_share(factor: FactoredSmoother, x: Array, interval: float) -> Array:
    """Variance of the lost signal over that expected by the penalties, averaged along the record, (3, bins)."""
    bins = np.arange(0, len(x), _bin_frames(len(x)))
    out = np.ones((3, len(bins)))
    if factor.data.second_difference_weights is not None:  # a sensor recovers what smoothing loses
        return out
    residual = x - weighted_cubic(x, factor.data.w)
    residual -= factor.smooth(residual)
    taken = np.array([np.add.reduceat(stencil_derivative(residual, k) ** 2, bins) for k in range(3)])
    rng, many, at_once = np.random.default_rng(PROBE_SEED), _count_probes(factor), max(PROBE_VALUES // len(x), 1)
    del x, residual  # the largest memory is needed now
    noise, expected = np.zeros((2, *out.shape))
    for first in range(0, many, at_once):
        once = factor.smooth(factor.data.probes(rng, min(at_once, many - first)))
        kept = factor.smooth(once)
        lost = np.subtract(once, kept, out=once)
        for k in range(3):
            lost_k = stencil_derivative(lost, k)
            noise[k] += np.add.reduceat(np.einsum("np,np->n", lost_k, lost_k), bins) / many
            lost_k *= stencil_derivative(kept, k)
            expected[k] += np.add.reduceat(np.sum(lost_k, axis=1), bins) / many
    for k in range(3):
        observed = np.maximum(_moving_sum(taken[k] - noise[k]), 0.0)
        # signal far below the noise cannot be distinguished from it
        expected_sum = np.maximum(_moving_sum(expected[k]), 0.0) + _moving_sum(NOISE_SHARE * noise[k])
        share = (observed + PRIOR_WEIGHT * expected_sum) / ((1.0 + PRIOR_WEIGHT) * expected_sum)
        out[k] = np.minimum(share, MAX_LOST_RATIO)
    return out


def _count_probes(factor: FactoredSmoother) -> int:
    """Number of probes: fewer for a record of many periods of the cut-off, over which their products are averaged."""
    period = 2.0 * np.pi * float(np.max(factor.lam)) ** (0.5 / TREND_ORDER)
    return int(np.clip(np.ceil(N_PROBES * PERIODS_OF_PROBES * period / factor.n), 1, N_PROBES))


def _bin_frames(n: int) -> int:
    """Frames whose products are summed before they are averaged along a record of n frames."""
    return max(n // MAX_BINS, 1)


def _moving_sum(row: Array) -> Array:
    """Moving sum of a row (n,) over a part of the record, reflected at the ends."""
    window = len(row) // MIN_PARTS | 1
    return np.asarray(window * scipy.ndimage.uniform_filter1d(row, window, mode="mirror"))
