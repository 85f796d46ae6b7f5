"""The equations of a structural smoother: a trend, lines, and noise (Harvey 1989, Forecasting, ch. 4).

    minimise    sum_i w_i (y_i - x_i - sum_k z_ki)^2  +  sum_j lambda_j (D x)_j^2  +  sum_k mu_k sum_j (D_k z_k)_j^2

D is the fourth difference, D_k = 1 - 2 cos(omega_k) B + B^2 the difference that a sine of frequency omega_k obeys. What
a difference leaves at zero passes free: cubics, and sines of any amplitude and phase. Without lines and with one lambda
this is the smoother of Whittaker (1923) and Henderson (1924), away from the ends the zero-phase Butterworth filter of
order 4, |H(f)| = 1 / (1 + lambda (2 sin(pi f / fs))^8); unlike that filter it needs no padding, has no end transient
and takes a missing frame as a weight of zero. It is also the posterior mean of a signal whose differences are white
noise, the one that Kalman's filter and Rauch, Tung and Striebel's smoother find by recursion: hence a likelihood
(restricted maximum likelihood; Wahba 1985, Ann. Stat. 13) and a covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgbtrf, dgbtrs

from frictrack.records import Array

FOURTH, SECOND = np.array([1.0, -4.0, 6.0, -4.0, 1.0]), np.array([1.0, -2.0, 1.0])  # differences
ORDER = 4  # of the trend's difference, and free numbers of the trend
BLOCK = 8  # frames per block of the covariance
STEP = 0.01  # of the log of all penalties, for the derivative that parts noise from lost signal
NO_WEIGHT = 1e-10  # of a missing frame in the covariance, which keeps that of an extrapolation finite
Index = NDArray[np.int64]


def penalty(cutoff: float, interval: float) -> float:
    """Lambda for which |H(cutoff)| = 1/2; `cutoff` in Hz, frame `interval` in s."""
    return float((2.0 * np.sin(np.pi * cutoff * interval)) ** (-2 * ORDER))


def cutoff_of(lam: float, interval: float) -> float:
    """Cut-off in Hz of a lambda; half the frame rate at most."""
    half = 0.5 * float(lam) ** (-0.5 / ORDER)
    return float(np.arcsin(min(half, 1.0)) / np.pi / interval)


@dataclass(frozen=True, eq=False)
class Lines:
    """Frequencies (K,) in radians per frame and penalties mu (K,)."""

    omega: Array
    mu: Array


NO_LINES = Lines(np.empty(0), np.empty(0))


@dataclass(frozen=True, eq=False)
class Data:
    """Positions y (n,) with weights w (n,), 0 where none was measured, and accelerations where a sensor knew them.

    `bent` (n - 2,) are second differences of the position, `worth` (n - 2,) their weights, 0 where there is none.
    """

    y: Array
    w: Array
    bent: Array | None = None
    worth: Array | None = None

    @property
    def count(self) -> int:
        """Numbers that were measured."""
        return int(np.sum(self.w > 0)) + (0 if self.worth is None else int(np.sum(self.worth > 0)))


class System:
    """The places of all unknowns in the banded equations of n frames and K lines.

    They are the augmented equations [A, P'; P, -1] [u; s] = [W y; p] with the weighted differences P and what they
    should be, p: their condition is the square root of that of A + P'P, which a low cut-off would spoil. The unknowns
    of a frame stand together.
    """

    def __init__(self, n: int, lines: int, sensed: bool) -> None:
        self.n, self.k = n, lines
        # Components and order of every difference.
        self.terms: list[tuple[tuple[int, ...], int]] = [((0,), ORDER), *[((k,), 2) for k in range(1, lines + 1)]]
        if sensed:
            self.terms.append((tuple(range(lines + 1)), 2))
        keys = [np.arange(n) + 0.01 * k for k in range(1 + lines)]
        keys += [np.arange(n - d) + d / 2 + 0.3 + 0.01 * k for k, (_, d) in enumerate(self.terms)]
        order = np.argsort(np.concatenate(keys), kind="stable")
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        found = np.split(place, np.cumsum([len(k) for k in keys])[:-1])
        self.frame, self.multiplier = found[: 1 + lines], found[1 + lines :]
        self.size, self.group = len(order), 1 + lines + len(self.terms)
        steps = [
            int(np.abs(m - self.frame[k][i : len(m) + i]).max())
            for (components, d), m in zip(self.terms, self.multiplier, strict=True)
            for k in components
            for i in range(d + 1)
        ]
        self.band = max([*steps, lines])

    def equations(self, w: Array, strengths: list[Array], lines: Lines) -> Array:
        """In LAPACK band storage (3 band + 1, size), the top `band` rows left for fill-in."""
        b = self.band
        out = np.zeros((3 * b + 1, self.size))
        for row in self.frame:
            for column in self.frame:
                out[2 * b + row - column, column] = w
        differences = [FOURTH, *[np.array([1.0, -2.0 * np.cos(o), 1.0]) for o in lines.omega], SECOND]
        for (components, _), m, difference, strength in zip(
            self.terms, self.multiplier, differences, strengths, strict=False
        ):
            out[2 * b, m] = -1.0
            for x in (self.frame[k] for k in components):
                for i, c in enumerate(difference):
                    column = x[i : len(m) + i]
                    out[2 * b + m - column, column] = out[2 * b + column - m, m] = strength * c
        return out


@lru_cache(maxsize=64)
def system(n: int, lines: int, sensed: bool) -> System:
    """The places for n frames, made once."""
    return System(n, lines, sensed)


@dataclass(frozen=True, eq=False)
class Factor:
    """The factored equations of data, penalties lambda (n - 4,) and lines."""

    system: System
    data: Data
    lam: Array
    lines: Lines
    lu: Array
    pivots: Array

    def _solve(self, frames: Array, sensed: Array | None = None) -> Array:
        """All unknowns (size, ...) for a right-hand side (n, ...) of the frames, and of the sensor (n - 2, ...)."""
        s = self.system
        full = np.zeros((s.size, *frames.shape[1:]))
        for row in s.frame:
            full[row] = frames
        if sensed is not None:
            full[s.multiplier[-1]] = sensed
        out: Array = dgbtrs(self.lu, s.band, s.band, full, self.pivots)[0]
        return out

    def signal(self, unknowns: Array) -> Array:
        """Trend and lines together (n, ...)."""
        out: Array = np.sum([unknowns[row] for row in self.system.frame], axis=0)
        return out

    def unknowns(self) -> Array:
        """The solution for the data (size,)."""
        d = self.data
        return self._solve(d.w * d.y, None if d.worth is None or d.bent is None else np.sqrt(d.worth) * d.bent)

    def shocks(self) -> Array:
        """Weighted differences of the trend (n - 4,): what shakes it."""
        return np.asarray(self.unknowns()[self.system.multiplier[0]])

    def smooth(self, y: Array) -> Array:
        """Smoothed columns (n, ...) of y (n, ...), which counts nowhere that w is 0; no sensor is looked at."""
        w = self.data.w.reshape(-1, *[1] * (y.ndim - 1))
        return self.answer(w * y)

    def unknowns_of(self, y: Array) -> Array:
        """The solution for other positions y (n,), no sensor being looked at (size,)."""
        return self._solve(self.data.w * y)

    def answer(self, frames: Array) -> Array:
        """Signal (n, ...) for a right-hand side (n, ...): the covariance for unit noise times it."""
        return self.signal(self._solve(frames))

    def covariance(self, rows: Index) -> Array:
        """Covariance (n, m) of the signal in all frames with that in the frames `rows` (m,), for unit noise."""
        unit = np.zeros((self.system.n, len(rows)))
        unit[rows, np.arange(len(rows))] = 1.0
        return self.answer(unit)

    def judged(self) -> tuple[float, float, Array]:
        """Twice the negative restricted log-likelihood, the noise variance that goes with it, all unknowns (size,).

        A line counts with its two amplitudes alike, each as if expected to be about the noise, whatever the unit.
        """
        s, d, lines = self.system, self.data, self.lines
        unknowns = self.unknowns()
        left = d.w @ (d.y - self.signal(unknowns)) ** 2 + sum(float(np.sum(unknowns[m] ** 2)) for m in s.multiplier)
        degrees = d.count - ORDER - 2 * s.k
        variance = max(float(left), np.finfo(float).tiny) / degrees
        logdet = float(np.sum(np.log(np.abs(self.lu[2 * s.band]))))
        penalties = float(np.sum(np.log(self.lam))) + (s.n - 2) * float(np.sum(np.log(lines.mu)))
        amplitudes = 2.0 * float(np.sum(np.log(np.sin(lines.omega))))
        return (d.count - ORDER) * np.log(variance) + logdet - penalties + amplitudes, variance, unknowns

    def variances(self, start: Index, stencils: Array) -> Array:
        """Variance of linear combinations of neighbouring frames of the signal, for unit noise.

        Combination i takes the frames from start[i] (n,) on with the weights stencils[..., i, :], at most BLOCK of
        them; the result has the shape of stencils without its last axis.
        """
        s = self.system
        block = self._block()
        m = stencils.shape[-1]
        place = np.concatenate([row[start[:, None] + np.arange(m)] for row in s.frame], axis=1)
        window = np.minimum(place.min(axis=1) // block, max(-(-s.size // block), 2) - 2)
        inside = place - window[:, None] * block
        weights = np.concatenate([stencils] * len(s.frame), axis=-1)
        inverse = self._windows(block)
        near = inverse[window[:, None, None], inside[:, :, None], inside[:, None, :]]
        found = np.einsum("...ij,ijk,...ik->...i", weights, near, weights)
        rounding = np.finfo(float).eps * np.sum(stencils**2, axis=-1)  # a stiff cubic is known that well
        return np.asarray(np.maximum(found, rounding))

    def passed(self, start: Index, stencils: Array) -> Array:
        """The part of those variances that is noise let through, not signal taken away."""
        return self.parted(start, stencils)[1]

    def parted(self, start: Index, stencils: Array) -> tuple[Array, Array]:
        """Those variances, and the part of them that is noise let through.

        With V = (A + P'P)^-1 for all penalties times s, the noise that passes is V W V = V + s dV/ds.
        """
        both = self.variances(start, stencils)
        up, down = (self._stiffer(np.exp(d)).variances(start, stencils) for d in (STEP, -STEP))
        rounding = np.finfo(float).eps * np.sum(stencils**2, axis=-1)
        return both, np.asarray(np.maximum(both + (up - down) / (2.0 * STEP), rounding))

    def _stiffer(self, times: float) -> Factor:
        return factored(self.data, self.lam * times, Lines(self.lines.omega, self.lines.mu * times))

    def _block(self) -> int:
        """Unknowns per block: some frames, and no last block of a few, which could not tell trend from line."""
        s = self.system
        sizes = range(BLOCK * s.group, 2 * BLOCK * s.group)
        return next(b for b in sizes if s.size % b == 0 or s.size % b >= b // 2)

    def _windows(self, block: int) -> Array:
        """Inverse (m, 2 block, 2 block) of the equations at each two neighbouring blocks of unknowns, exact, in O(n).

        Eliminating all unknowns to one side of a block alters only the corner of its equations that they couple to;
        with the corners from both sides, the inverse of two blocks is that part of the whole inverse.
        """
        b = self.system.band
        pairs, ends = self._pairs(block), slice(block - b, block)
        links = pairs[:, block : block + b, ends]
        before, after = np.zeros((len(pairs), b, b)), np.zeros((len(pairs), b, b))
        for k in range(1, len(pairs)):
            one = pairs[k - 1, :block, :block].copy()
            one[:b, :b] += before[k - 1]
            before[k] = -links[k - 1] @ _inverse(one)[-b:, -b:] @ links[k - 1].T
            one = pairs[-k, block:, block:].copy()
            one[-b:, -b:] += after[-k]
            after[-k - 1] = -links[-k].T @ _inverse(one)[:b, :b] @ links[-k]
        pairs[:, :b, :b] += before
        pairs[:, -b:, -b:] += after
        return _inverse(pairs)

    def _pairs(self, block: int) -> Array:
        """Equations (m, 2 block, 2 block) of each two neighbouring blocks of unknowns, the last one padded."""
        s, d = self.system, self.data
        strengths = _strengths(self.lam, self.lines, d.worth)
        known = s.equations(np.maximum(d.w, NO_WEIGHT), strengths, self.lines)[s.band :]
        m = max(-(-s.size // block), 2)
        padded = np.zeros((2 * s.band + 1, m * block))
        padded[s.band] = 1.0
        padded[:, : s.size] = known
        row, column = np.indices((2 * block, 2 * block))
        offset = row - column
        values = padded[np.clip(s.band + offset, 0, 2 * s.band), block * np.arange(m - 1)[:, None, None] + column]
        return np.where(np.abs(offset) <= s.band, values, 0.0)


def _inverse(a: Array) -> Array:
    """Inverse of symmetric equations (..., n, n); pseudo-inverse where frames without weight leave them singular."""
    try:
        return np.asarray(np.linalg.inv(a))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(a, hermitian=True))


def _strengths(lam: Array, lines: Lines, worth: Array | None) -> list[Array]:
    return [np.sqrt(lam), *np.sqrt(lines.mu), *([] if worth is None else [np.sqrt(worth)])]


def factored(data: Data, lam: Array, lines: Lines = NO_LINES) -> Factor:
    """Factor the equations of the data with penalties lambda (n - 4,) of the trend and those of the lines."""
    made = system(len(data.w), len(lines.omega), data.worth is not None)
    equations = made.equations(data.w, _strengths(lam, lines, data.worth), lines)
    lu, pivots, _ = dgbtrf(equations, made.band, made.band, overwrite_ab=1)
    return Factor(made, data, lam, lines, lu, pivots)
