"""The equations of a structural smoother: a trend, lines, and noise (Harvey 1989, Forecasting, ch. 4).

    minimise    sum_i w_i (y_i - x_i - sum_k z_ki)^2  +  sum_j lambda_j (D x)_j^2  +  sum_k mu_k sum_j (D_k z_k)_j^2

D is the fourth difference, D_k = 1 - 2 cos(omega_k) B + B^2 the difference that a sine of frequency omega_k obeys. What
a difference leaves at zero passes free: cubics, and sines of any amplitude and phase. Without lines and with one lambda
this is the smoother of Whittaker (1923) and Henderson (1924), away from the ends the zero-phase Butterworth filter of
order 4, |H(f)| = 1 / (1 + lambda (2 sin(pi f / fs))^8); unlike that filter it needs no padding, has no end transient
and takes a missing frame as a weight of zero. It is also the posterior mean of a signal whose differences are white
noise, the one that Kalman's filter and Rauch, Tung and Striebel's smoother find by recursion: hence a likelihood
(restricted maximum likelihood; Wahba 1985, Ann. Stat. 13) and a covariance. Noise that is correlated from frame to
frame is one more component c, which no frame tells from x but its own difference, c_j - rho c_(j-1), and which is no
part of the signal (Harvey 1989, ch. 3).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_banded
from scipy.linalg.lapack import dgbtrf, dgbtrs
from scipy.signal import lfilter

from frictrack.motion import selected_inverse
from frictrack.records import Array

FOURTH_DIFFERENCE, SECOND_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0]), np.array([1.0, -2.0, 1.0])  # differences
TREND_ORDER = 4  # of the trend's difference, and free numbers of the trend
BLOCK_FRAMES = 8  # frames per block of the covariance
LOG_PENALTY_STEP = 0.01  # of the log of all penalties, for the derivative that parts noise from lost signal
MISSING_WEIGHT = 1e-10  # of a missing frame in the covariance: keeps that of an extrapolation finite
Index = NDArray[np.int64]


def penalty(cutoff: float, interval: float) -> float:
    """Lambda for which |H(cutoff)| = 1/2; `cutoff` in Hz, frame `interval` in s."""
    return float((2.0 * np.sin(np.pi * cutoff * interval)) ** (-2 * TREND_ORDER))


def cutoff_of(lam: float, interval: float) -> float:
    """Cut-off in Hz of a lambda; half the frame rate at most."""
    half = 0.5 * float(lam) ** (-0.5 / TREND_ORDER)
    return float(np.arcsin(min(half, 1.0)) / np.pi / interval)


@dataclass(frozen=True, eq=False)
class LineParameters:
    """Frequencies (K,) in radians per frame and penalties mu (K,)."""

    omega: Array
    mu: Array


NO_LINES = LineParameters(np.empty(0), np.empty(0))


@dataclass(frozen=True)
class NoiseColour:
    """Noise of which a `share` of the variance has a `correlation` from frame to frame; the rest is white."""

    correlation: float
    share: float

    def spectrum(self, omega: Array) -> Array:
        """Density at frequencies in radians per frame, one on average."""
        turned = np.abs(1.0 - self.correlation * np.exp(-1j * omega)) ** 2
        return np.asarray(1.0 - self.share + self.share * (1.0 - self.correlation**2) / turned)

    @property
    def shocks(self) -> float:
        """Variance of c_j - rho c_(j-1) over that of the noise."""
        return self.share * (1.0 - self.correlation**2)

    def surprise(self, seen: int, n: int) -> float:
        """What it adds to twice the negative log-likelihood of n frames, so many of them measured."""
        return float((n - 1) * np.log(self.shocks) + np.log(self.share) + seen * np.log(1.0 - self.share))

    def drawn(self, white: Array, driving: Array) -> Array:
        """A series of such noise from two white ones (n, ...) of unit variance."""
        driven = np.concatenate([np.sqrt(self.share) * driving[:1], np.sqrt(self.shocks) * driving[1:]])
        return np.asarray(np.sqrt(1.0 - self.share) * white + lfilter([1.0], [1.0, -self.correlation], driven, axis=0))


@dataclass(frozen=True, eq=False)
class SmootherData:
    """Positions y (n,) with weights w (n,), 0 where none was measured, and accelerations where a sensor knew them.

    `bent` (n - 2,) are second differences of the position, `worth` (n - 2,) their weights, 0 where there is none.
    The noise is white where it has no `colour`.
    """

    y: Array
    w: Array
    bent: Array | None = None
    worth: Array | None = None
    colour: NoiseColour | None = None

    @property
    def precision(self) -> Array:
        """Weights (n,) of the white part of the noise."""
        return self.w / (1.0 - self.colour.share) if self.colour else self.w

    def probes(self, rng: np.random.Generator, many: int) -> Array:
        """Series (n, many) of the covariance of the noise, from random signs."""
        white = rng.choice([-1.0, 1.0], (len(self.w), many))
        return self.colour.drawn(white, rng.choice([-1.0, 1.0], white.shape)) if self.colour else white

    def whitened(self, y: Array) -> Array:
        """The inverse covariance of the noise (n, n) times columns y (n, ...), for unit noise."""
        weighed = _weighted(self.precision, y)
        if not self.colour:
            return weighed
        n, rho, shock = len(self.w), self.colour.correlation, 1.0 / self.colour.shocks
        banded = np.zeros((3, n))
        banded[0, 1:] = banded[2, :-1] = -rho * shock
        banded[1] = self.precision + shock * (1.0 + rho**2 * (np.arange(n) < n - 1))
        banded[1, 0] += 1.0 / self.colour.share - shock
        flat = solve_banded((1, 1), banded, weighed.reshape(n, -1)).reshape(weighed.shape)
        return weighed - _weighted(self.precision, flat)

    @property
    def count(self) -> int:
        """Numbers that were measured."""
        return int(np.sum(self.w > 0)) + (0 if self.worth is None else int(np.sum(self.worth > 0)))


class EquationLayout:
    """The places of all unknowns in the banded equations of n frames and K lines.

    They are the augmented equations [A, P'; P, -1] [u; s] = [W y; p] with the weighted differences P and what they
    should be, p: their condition is the square root of that of A + P'P, which a low cut-off would spoil. The unknowns
    of a frame stand together.
    """

    def __init__(self, n: int, lines: int, sensed: bool, coloured: bool) -> None:
        self.n, self.k = n, lines
        # Components and order of every difference.
        self.terms: list[tuple[tuple[int, ...], int]] = [((0,), TREND_ORDER), *[((k,), 2) for k in range(1, lines + 1)]]
        if coloured:
            self.terms.append(((lines + 1,), 1))
        if sensed:
            self.terms.append((tuple(range(lines + 1)), 2))
        every = 1 + lines + coloured  # components of the positions
        keys = [np.arange(n) + 0.01 * k for k in range(every)]
        keys += [np.arange(n - d) + d / 2 + 0.3 + 0.01 * k for k, (_, d) in enumerate(self.terms)]
        order = np.argsort(np.concatenate(keys), kind="stable")
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        found = np.split(place, np.cumsum([len(k) for k in keys])[:-1])
        self.components, self.multiplier = found[:every], found[every:]
        self.frame = self.components[: 1 + lines]  # those of the signal
        self.size, self.group = len(order), every + len(self.terms)
        steps = [
            int(np.abs(m - self.components[k][i : len(m) + i]).max())
            for (components, d), m in zip(self.terms, self.multiplier, strict=True)
            for k in components
            for i in range(d + 1)
        ]
        self.band = max([*steps, every - 1])

    @property
    def block(self) -> int:
        """Unknowns per block: some frames, and no last block of a few, which could not tell trend from line."""
        sizes = range(BLOCK_FRAMES * self.group, 2 * BLOCK_FRAMES * self.group)
        return next(b for b in sizes if self.size % b == 0 or self.size % b >= b // 2)

    def equations(self, data: SmootherData, w: Array, lam: Array, lines: LineParameters) -> Array:
        """In LAPACK band storage (3 band + 1, size), the top `band` rows left for fill-in; w of the white noise."""
        b, colour = self.band, data.colour
        out = np.zeros((3 * b + 1, self.size))
        for row in self.components:
            for column in self.components:
                out[2 * b + row - column, column] = w
        if colour:
            out[2 * b, self.components[-1][0]] += 1.0 / colour.share
        weighted = _differences(data, lam, lines)
        for (components, _), m, (strength, difference) in zip(self.terms, self.multiplier, weighted, strict=True):
            out[2 * b, m] = -1.0
            for x in (self.components[k] for k in components):
                for i, c in enumerate(difference):
                    column = x[i : len(m) + i]
                    out[2 * b + m - column, column] = out[2 * b + column - m, m] = strength * c
        return out


def _differences(data: SmootherData, lam: Array, lines: LineParameters) -> Iterator[tuple[Array | float, Array]]:
    """Strength of every difference, and its coefficients."""
    yield np.sqrt(lam), FOURTH_DIFFERENCE
    for omega, mu in zip(lines.omega, lines.mu, strict=True):
        yield np.sqrt(mu), np.array([1.0, -2.0 * np.cos(omega), 1.0])
    if data.colour:
        yield data.colour.shocks**-0.5, np.array([-data.colour.correlation, 1.0])
    if data.worth is not None:
        yield np.sqrt(data.worth), SECOND_DIFFERENCE


@lru_cache(maxsize=64)
def equation_layout(n: int, lines: int, sensed: bool, coloured: bool) -> EquationLayout:
    """The places for n frames, made once."""
    return EquationLayout(n, lines, sensed, coloured)


@dataclass(frozen=True, eq=False)
class FactoredSmoother:
    """The equations of data, penalties lambda (n - 4,) and lines, factored when they are first solved."""

    layout: EquationLayout
    data: SmootherData
    lam: Array
    lines: LineParameters

    @cached_property
    def _lu(self) -> tuple[Array, Array]:
        """In LAPACK band storage, and its pivots."""
        s = self.layout
        equations = s.equations(self.data, self.data.precision, self.lam, self.lines)
        lu, pivots, _ = dgbtrf(equations, s.band, s.band, overwrite_ab=1)
        return lu, pivots

    def _solve(self, frames: Array, components: list[Index], sensed: Array | None = None) -> Array:
        """All unknowns (size, ...) for a right-hand side (n, ...) of components, and of the sensor (n - 2, ...)."""
        s = self.layout
        full = np.zeros((s.size, *frames.shape[1:]))
        for row in components:
            full[row] = frames
        if sensed is not None:
            full[s.multiplier[-1]] = sensed
        out: Array = dgbtrs(self._lu[0], s.band, s.band, full, self._lu[1])[0]
        return out

    def signal(self, unknowns: Array) -> Array:
        """Trend and lines together (n, ...)."""
        out: Array = np.sum([unknowns[row] for row in self.layout.frame], axis=0)
        return out

    def unknowns(self) -> Array:
        """The solution for the data (size,)."""
        d = self.data
        sensed = None if d.worth is None or d.bent is None else np.sqrt(d.worth) * d.bent
        return self._solve(d.precision * d.y, self.layout.components, sensed)

    def residual(self, unknowns: Array) -> Array:
        """What of the data (n,) is neither signal nor correlated noise; 0 where there are none."""
        explained = np.sum([unknowns[row] for row in self.layout.components], axis=0)
        return np.where(self.data.w > 0, self.data.y - explained, 0.0)

    def shocks(self) -> Array:
        """Weighted differences of the trend (n - 4,): what shakes it."""
        return np.asarray(self.unknowns()[self.layout.multiplier[0]])

    def smooth(self, y: Array) -> Array:
        """Smoothed columns (n, ...) of y (n, ...), which counts nowhere that w is 0; no sensor is looked at."""
        return self.signal(self.unknowns_of(y))

    def unknowns_of(self, y: Array) -> Array:
        """The solution for other positions y (n, ...), no sensor being looked at (size, ...)."""
        return self._solve(_weighted(self.data.precision, y), self.layout.components)

    def posterior_covariance_times(self, frames: Array) -> Array:
        """Signal (n, ...) for a right-hand side (n, ...): the covariance for unit noise times it."""
        return self.signal(self._solve(frames, self.layout.frame))

    def covariance(self, rows: Index) -> Array:
        """Covariance (n, m) of the signal in all frames with that in the frames `rows` (m,), for unit noise."""
        unit = np.zeros((self.layout.n, len(rows)))
        unit[rows, np.arange(len(rows))] = 1.0
        return self.posterior_covariance_times(unit)

    def restricted_likelihood(self) -> tuple[float, float, Array]:
        """Twice the negative restricted log-likelihood, the noise variance that goes with it, all unknowns (size,).

        A line counts with its two amplitudes alike, each as if expected to be about the noise, whatever the unit.
        """
        s, d, lines = self.layout, self.data, self.lines
        unknowns = self.unknowns()
        residual = d.precision @ self.residual(unknowns) ** 2 + sum(
            float(np.sum(unknowns[m] ** 2)) for m in s.multiplier
        )
        if d.colour:
            residual += unknowns[s.components[-1][0]] ** 2 / d.colour.share
        degrees = d.count - TREND_ORDER - 2 * s.k
        variance = max(float(residual), np.finfo(float).tiny) / degrees
        logdet = float(np.sum(np.log(np.abs(self._lu[0][2 * s.band]))))
        penalties = float(np.sum(np.log(self.lam))) + (s.n - 2) * float(np.sum(np.log(lines.mu)))
        amplitudes = 2.0 * float(np.sum(np.log(np.sin(lines.omega))))
        noise = d.colour.surprise(int(np.sum(d.w > 0)), s.n) if d.colour else 0.0
        return (d.count - TREND_ORDER) * np.log(variance) + logdet - penalties + amplitudes + noise, variance, unknowns

    def variances(self, start: Index, stencils: Array) -> Array:
        """Variance of linear combinations of neighbouring frames of the signal, for unit noise.

        Combination i takes the frames from start[i] (n,) on with the weights stencils[..., i, :], at most
        BLOCK_FRAMES of them; the result has the shape of stencils without its last axis.
        """
        return variances_of([self], start, stencils)[0]

    def passed(self, start: Index, stencils: Array) -> Array:
        """The part of those variances that is noise let through, not signal taken away."""
        return self.posterior_and_noise_variance(start, stencils)[1]

    def posterior_and_noise_variance(self, start: Index, stencils: Array) -> tuple[Array, Array]:
        """Those variances, and the part of them that is noise let through.

        With V = (A + P'P)^-1 for all penalties times s, the noise that passes is V W V = V + s dV/ds.
        """
        beside = (self._stiffer(np.exp(d)) for d in (LOG_PENALTY_STEP, -LOG_PENALTY_STEP))
        both, up, down = variances_of([self, *beside], start, stencils)
        rounding = np.finfo(float).eps * np.sum(stencils**2, axis=-1)
        return both, np.asarray(np.maximum(both + (up - down) / (2.0 * LOG_PENALTY_STEP), rounding))

    def _stiffer(self, times: float) -> FactoredSmoother:
        return factor_smoother(self.data, self.lam * times, LineParameters(self.lines.omega, self.lines.mu * times))

    def equations(self) -> Array:
        """In bands (2 band + 1, size), with some weight for every frame."""
        w = np.maximum(self.data.precision, MISSING_WEIGHT)
        return self.layout.equations(self.data, w, self.lam, self.lines)[self.layout.band :]


def variances_of(factors: Sequence[FactoredSmoother], start: Index, stencils: Array) -> Array:
    """Variances (F, ...) as by `Factor.variances`, of several smoothers of the same frames at once."""
    s = factors[0].layout
    m = stencils.shape[-1]
    place = np.concatenate([row[start[:, None] + np.arange(m)] for row in s.frame], axis=1)
    weights = np.concatenate([stencils.reshape(-1, *stencils.shape[-2:])] * len(s.frame), axis=-1)
    found = selected_inverse.selected_variances(np.stack([f.equations() for f in factors]), s.block, place, weights)
    rounding = np.finfo(float).eps * np.sum(stencils**2, axis=-1)  # a stiff cubic is known that well
    return np.asarray(np.maximum(found.reshape(len(factors), *stencils.shape[:-1]), rounding))


def _weighted(w: Array, y: Array) -> Array:
    """Weights (n,) times columns (n, ...)."""
    return np.asarray(w.reshape(-1, *[1] * (y.ndim - 1)) * y)


def factor_smoother(data: SmootherData, lam: Array, lines: LineParameters = NO_LINES) -> FactoredSmoother:
    """The smoother of the data with penalties lambda (n - 4,) of the trend and those of the lines."""
    made = equation_layout(len(data.w), len(lines.omega), data.worth is not None, data.colour is not None)
    return FactoredSmoother(made, data, lam, lines)
