"""Compute the chance that an unrelated series matches the residual of a model (surrogate data).

Series that drift resemble each other, so the series is compared with random paths: sums of cosines with random
amplitudes and the power of the series in every octave. They are drawn anew for every run, and once for all runs along
time since release and along place, because whatever repeats with either is equal in all runs.

References
----------
Theiler et al. (1992), Physica D 58, 77-94.
Schreiber & Schmitz (2000), Physica D 142, 346-382.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import dct

from frictrack.records import Array

N_DRAWS = 499
MAX_HALF_PERIODS = 127  # of the cosines over a run
MIN_INDEPENDENT_SHARE = 1e-9  # of a second column's square that is independent of the first

Columns = Callable[[Sequence[Array | None]], dict[str, Array]]  # (n_i, 3, D) per piece -> way -> (M, 2, D)


@dataclass(frozen=True)
class SmoothedSignal:
    """A series along one piece, without trend.

    Parameters
    ----------
    t, x
        Times s and positions m, (n,).
    u
        The series with two derivatives in time, (n, 3).

    """

    t: Array
    x: Array
    u: Array


def detrend(t: Array, u: Array) -> Array:
    """Remove mean and linear trend from a series and its derivatives.

    Parameters
    ----------
    t
        Times, (n,).
    u
        Series with two derivatives, (n, 3, ...).

    Returns
    -------
    ndarray, same shape as `u`

    Examples
    --------
    >>> t = np.arange(4.0)
    >>> u = np.stack([2 * t + 1, np.full(4, 2.0), np.zeros(4)], axis=1)
    >>> float(np.abs(detrend(t, u)).max().round(12))
    0.0

    """
    out = u.reshape(len(u), 3, -1).copy()
    line = np.stack([np.ones_like(t), t], axis=1)
    constant, slope = np.linalg.lstsq(line, out[:, 0], rcond=None)[0]
    out[:, 0] -= constant + t[:, None] * slope
    out[:, 1] -= slope
    return out.reshape(u.shape)


def surrogate_p_value(
    best: float, series: Sequence[SmoothedSignal | None], columns: Columns, residual: Array, rng: np.random.Generator
) -> float:
    """Probability that a random path lowers chi-squared as much as the series.

    Parameters
    ----------
    best
        Fall of chi-squared with the series.
    series
        The series along every piece; None if not measured.
    columns
        Function that converts paths (n_i, 3, D) per piece to traces (M, 2, D) per mode of action.
    residual
        Compressed residual, (M,).
    rng
        Random generator.

    Returns
    -------
    float
        The largest p-value over the three ways of drawing.

    """
    return max(_p_value(best, columns(paths), residual) for paths in _random_paths(series, rng))


def chi2_gains(columns: Array, residual: Array) -> Array:
    """Fall of chi-squared with the best coefficients of pairs of columns (M, 2, D), (D,)."""
    size = np.linalg.norm(columns, axis=0)
    first, second = columns.transpose(1, 0, 2) / np.where(size > 0, size, np.inf)[:, None]
    a, b, correlation = residual @ first, residual @ second, np.sum(first * second, axis=0)
    free = 1 - correlation**2
    return np.where(
        free > MIN_INDEPENDENT_SHARE,
        a**2 + (b - correlation * a) ** 2 / np.maximum(free, MIN_INDEPENDENT_SHARE),
        np.maximum(a**2, b**2),
    )


def _p_value(best: float, columns: dict[str, Array], residual: Array) -> float:
    null = np.max([chi2_gains(c, residual) for c in columns.values()], axis=0)
    return float((1 + np.sum(null >= best)) / (len(null) + 1))


def _random_paths(series: Sequence[SmoothedSignal | None], rng: np.random.Generator) -> Iterator[list[Array | None]]:
    """Random paths along every piece, (n, 3, D): new for each run, common in time, common in place."""
    available = [s for s in series if s is not None]
    yield [
        None
        if s is None
        else _random_path(_normalise(s.t, s.t), s.t, _amplitudes(_normalise(s.t, s.t), s.u[:, 0], rng))
        for s in series
    ]
    for axis in ("t", "x"):
        whole = np.concatenate([getattr(s, axis) for s in available])
        longest = max(available, key=lambda s: float(np.ptp(getattr(s, axis))))
        amplitudes = _amplitudes(_normalise(getattr(longest, axis), whole), longest.u[:, 0], rng)
        yield [
            None if s is None else _random_path(_normalise(getattr(s, axis), whole), s.t, amplitudes) for s in series
        ]


def _normalise(values: Array, whole: Array) -> Array:
    """Values scaled to 0 ... 1 over the whole range."""
    return (values - whole.min()) / max(float(np.ptp(whole)), 1e-12)


def _amplitudes(at: Array, u: Array, rng: np.random.Generator) -> Array:
    """Random amplitudes of cosines (W, D) with the power of a series in every octave along an axis."""
    order = np.argsort(at)
    even = np.interp(np.linspace(at.min(), at.max(), max(len(at), 2 * MAX_HALF_PERIODS)), at[order], u[order])
    power = dct(even - even.mean(), norm="ortho")[1 : MAX_HALF_PERIODS + 1] ** 2
    octave = np.log2(np.arange(1, MAX_HALF_PERIODS + 1)).astype(int)
    mean = np.bincount(octave, power) / np.bincount(octave)
    return np.sqrt(mean[octave])[:, None] * rng.standard_normal((MAX_HALF_PERIODS, N_DRAWS))


def _random_path(at: Array, t: Array, amplitudes: Array) -> Array:
    """Random paths (n, 3, D) along an axis that a piece passes as `at` (n,), with derivatives in time."""
    speed = np.gradient(at, t)
    bend = np.gradient(speed, t)
    wave = np.pi * np.arange(1, MAX_HALF_PERIODS + 1)
    cosine, sine = np.cos(np.outer(at, wave)), np.sin(np.outer(at, wave))
    first = -(sine * wave) @ amplitudes
    second = -(cosine * wave**2) @ amplitudes
    u = np.stack(
        [cosine @ amplitudes, speed[:, None] * first, speed[:, None] ** 2 * second + bend[:, None] * first], axis=1
    )
    return detrend(t, u)
