"""What a series that has nothing to do with a law tells of its residual by chance.

A series that drifts is like much else that drifts. So it is held against random paths: sums of cosines with the power
that the series has in every octave, sizes and signs drawn. They are drawn for every run anew, and once for all runs,
along the time since release and along the place: what repeats with either is alike in all runs by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import dct

from frictrack.records import Array

N_DRAWS = 499
MAX_HALF_PERIODS = 127  # half periods over a run, most
MIN_INDEPENDENT_SHARE = 1e-9  # share of a second column's square that is not the first's

Columns = Callable[[Sequence[Array | None]], dict[str, Array]]  # (n_i, 3, D) per piece -> way -> (M, 2, D)


@dataclass(frozen=True)
class SmoothedSignal:
    """A series along one piece: times and places (n,), the series with two derivatives in time (n, 3), no trend."""

    t: Array
    x: Array
    u: Array


def detrend(t: Array, u: Array) -> Array:
    """A series with its derivatives (n, 3, ...) without its mean and its trend."""
    out = u.reshape(len(u), 3, -1).copy()
    line = np.stack([np.ones_like(t), t], axis=1)
    constant, slope = np.linalg.lstsq(line, out[:, 0], rcond=None)[0]
    out[:, 0] -= constant + t[:, None] * slope
    out[:, 1] -= slope
    return out.reshape(u.shape)


def surrogate_p_value(
    best: float, series: Sequence[SmoothedSignal | None], columns: Columns, left: Array, rng: np.random.Generator
) -> float:
    """Chance of a fall of chi-squared: the largest p over all ways to draw; `left` (M,) is what is to be explained."""
    return max(_p_value(best, columns(paths), left) for paths in _drawn(series, rng))


def chi2_gains(columns: Array, left: Array) -> Array:
    """Fall of chi-squared with the best coefficients of pairs of columns (M, 2, D), (D,)."""
    size = np.linalg.norm(columns, axis=0)
    first, second = columns.transpose(1, 0, 2) / np.where(size > 0, size, np.inf)[:, None]
    a, b, alike = left @ first, left @ second, np.sum(first * second, axis=0)
    free = 1 - alike**2
    return np.where(
        free > MIN_INDEPENDENT_SHARE,
        a**2 + (b - alike * a) ** 2 / np.maximum(free, MIN_INDEPENDENT_SHARE),
        np.maximum(a**2, b**2),
    )


def _p_value(best: float, columns: dict[str, Array], left: Array) -> float:
    null = np.max([chi2_gains(c, left) for c in columns.values()], axis=0)
    return float((1 + np.sum(null >= best)) / (len(null) + 1))


def _drawn(series: Sequence[SmoothedSignal | None], rng: np.random.Generator) -> Iterator[list[Array | None]]:
    """Random paths along every piece, (n, 3, DRAWS): for each anew, alike in time, alike in place."""
    there = [s for s in series if s is not None]
    yield [
        None if s is None else _path(_share(s.t, s.t), s.t, _sizes(_share(s.t, s.t), s.u[:, 0], rng)) for s in series
    ]
    for axis in ("t", "x"):
        whole = np.concatenate([getattr(s, axis) for s in there])
        longest = max(there, key=lambda s: float(np.ptp(getattr(s, axis))))
        sizes = _sizes(_share(getattr(longest, axis), whole), longest.u[:, 0], rng)
        yield [None if s is None else _path(_share(getattr(s, axis), whole), s.t, sizes) for s in series]


def _share(along: Array, whole: Array) -> Array:
    """From 0 to 1 over the whole."""
    return (along - whole.min()) / max(float(np.ptp(whole)), 1e-12)


def _sizes(at: Array, u: Array, rng: np.random.Generator) -> Array:
    """Sizes of cosines (WAVES, DRAWS), drawn with the power that a series has in every octave along an axis."""
    order = np.argsort(at)
    even = np.interp(np.linspace(at.min(), at.max(), max(len(at), 2 * MAX_HALF_PERIODS)), at[order], u[order])
    power = dct(even - even.mean(), norm="ortho")[1 : MAX_HALF_PERIODS + 1] ** 2
    octave = np.log2(np.arange(1, MAX_HALF_PERIODS + 1)).astype(int)
    mean = np.bincount(octave, power) / np.bincount(octave)
    return np.sqrt(mean[octave])[:, None] * rng.standard_normal((MAX_HALF_PERIODS, N_DRAWS))


def _path(at: Array, t: Array, sizes: Array) -> Array:
    """Random paths (n, 3, DRAWS) along an axis that a piece goes along as `at` (n,), with derivatives in time."""
    speed = np.gradient(at, t)
    bend = np.gradient(speed, t)
    wave = np.pi * np.arange(1, MAX_HALF_PERIODS + 1)
    cosine, sine = np.cos(np.outer(at, wave)), np.sin(np.outer(at, wave))
    first = -(sine * wave) @ sizes
    second = -(cosine * wave**2) @ sizes
    u = np.stack([cosine @ sizes, speed[:, None] * first, speed[:, None] ** 2 * second + bend[:, None] * first], axis=1)
    return detrend(t, u)
