"""The structure of a displacement, and the equations of its smoother: a trend, lines and noise (Harvey 1989, ch. 4).

    minimise    sum_i w_i (y_i - x_i - sum_k z_ki)^2  +  sum_j lambda_j (D x)_j^2  +  sum_k mu_k sum_j (D_k z_k)_j^2

D is the fourth difference; D_k = 1 - 2 cos(omega_k) B + B^2 is the difference that a sine of frequency omega_k obeys.
What a difference maps to zero is not penalised: cubics, and sines of any amplitude and phase. Without lines and with
one lambda this is the smoother of Whittaker (1923) and Henderson (1924). Away from the ends it equals the zero-phase
Butterworth filter of order 4, |H(f)| = 1 / (1 + lambda (2 sin(pi f / fs))^8). Unlike that filter it needs no padding,
has no end transient and treats a missing frame as a weight of zero. It is also the posterior mean of a signal whose
differences are white noise, which Kalman's filter and the smoother of Rauch, Tung & Striebel (1965) find by recursion.
Hence it has a likelihood (restricted maximum likelihood; Wahba 1985, Ann. Stat. 13) and a covariance. Noise that is
correlated from frame to frame is one more component c with the difference c_j - rho c_(j-1), not part of the signal
(Harvey 1989, ch. 3).

The stiffness of the trend (log lambda) is interpolated between knots over the record, so that it may be smooth in the
middle of a slide and bend where the slide stops. In an event (a push, an impact, a stop) the trend is softer. A line is
a vibration whose amplitude and phase may vary slowly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby, islice, pairwise

import numpy as np

from frictrack.measure.motion.banded_equations import (
    NO_LINES,
    TREND_ORDER,
    BlockEquations,
    EquationLayout,
    EquationPart,
    FactoredPart,
    Index,
    LineParameters,
    SmootherData,
    add_corners,
    equation_layout,
    factor_part,
    following_corner,
    penalty,
    reversed_part,
    weighted_columns,
)
from frictrack.records import Array

PART_UNKNOWNS = 8000  # unknowns of a part: 4000 frames of a trend alone, 800 with four lines
END_FRAMES, MIN_END_MEASURED = 100, 12  # last frames of a part, and how many of them are measured
MAX_KEPT_PARTS = 24  # whose factors are kept
REACH = 8  # frames of a combination at most
PARTS_AT_ONCE = 4  # of which variances are computed together
LOG_PENALTY_STEP = 0.01  # of the log of all penalties, for the derivative that separates noise from lost signal
MISSING_WEIGHT = 1e-10  # of a missing frame in the covariance: keeps that of an extrapolation finite
Stencils = Array | Callable[[slice], Array]


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Solution of a smoother.

    Attributes
    ----------
    components
        Trend, lines and correlated noise, (components, n, ...).
    differences
        Weighted differences of each penalty, (n - order, ...) each.

    """

    components: Array
    differences: list[Array]


@dataclass(frozen=True, eq=False)
class FactoredSmoother:
    """Equations of a smoother, factored part by part when they are solved.

    Attributes
    ----------
    data
        Measurements of n frames.
    lam
        Penalties of the trend, (n - 4,).
    lines
        Frequencies and penalties of the lines.
    penalty_factor
        Factor on all penalties.
    min_weight
        Smallest weight of a frame.

    """

    data: SmootherData
    lam: Array
    lines: LineParameters = NO_LINES
    penalty_factor: float = 1.0
    min_weight: float = 0.0
    _kept: dict[int, FactoredPart] = field(default_factory=dict, init=False, repr=False)
    _corners: list[Array] = field(default_factory=list, init=False, repr=False)
    _logdets: list[float] = field(default_factory=list, init=False, repr=False)

    @property
    def n(self) -> int:
        """Number of frames."""
        return len(self.data.w)

    @property
    def k(self) -> int:
        """Number of lines."""
        return len(self.lines.omega)

    @cached_property
    def layout(self) -> EquationLayout:
        """Layout of these equations for the first part."""
        return self._layout(min(self.cuts[1] + TREND_ORDER, self.n))

    @cached_property
    def cuts(self) -> list[int]:
        """First frames of all parts, and n; no part ends in a gap, beyond which rounding errors would grow."""
        w = self.data.w
        frames = PART_UNKNOWNS // self._layout(END_FRAMES).group
        cuts = range(frames, self.n - frames + 1, frames)
        return [0, *(i for i in cuts if np.count_nonzero(w[i - END_FRAMES : i]) >= MIN_END_MEASURED), self.n]

    def _layout(self, n: int) -> EquationLayout:
        """Layout of these equations for n frames."""
        return equation_layout(n, self.k, self.data.second_difference_weights is not None, self.data.colour is not None)

    def part(self, first: int, stop: int) -> EquationPart:
        """Equations of the frames first to stop (exclusive)."""
        begin, end = max(first - TREND_ORDER, 0), min(stop + TREND_ORDER, self.n)
        layout, data = self._layout(end - begin), self.data.part(begin, end)
        w = np.maximum(data.precision, self.min_weight)
        lines = LineParameters(self.lines.omega, self.lines.mu * self.penalty_factor)
        bands = layout.equations(data, w, self.lam[begin : end - TREND_ORDER] * self.penalty_factor, lines)
        return layout.part(bands, first - begin, stop - begin, begin)

    def _factored(self, i: int) -> FactoredPart:
        """Part i, factored; the parts before it were eliminated."""
        if i not in self._kept:
            part = self.part(*self.cuts[i : i + 2])
            found = factor_part(part, self._corners[i - 1] if i else None)
            if i == len(self._logdets):
                self._logdets.append(found.logdet)
                if part.frames.stop < self.n:
                    self._corners.append(following_corner(found))
            if len(self._kept) == MAX_KEPT_PARTS:
                self._kept.popitem()
            self._kept[i] = found
        return self._kept[i]

    def corners(self) -> list[Array]:
        """Corrections of the first equations of each part but the first, by eliminating all earlier frames."""
        for i in range(len(self._logdets), len(self.cuts) - 1):
            self._factored(i)
            self._kept.clear()  # no solution was asked for
        return self._corners

    def _solutions(self, right: Callable[[FactoredPart], Array]) -> Iterator[tuple[FactoredPart, Array]]:
        """Yield the parts, the last one first, and their solutions (size, ...) for right-hand sides."""
        count = len(self.cuts) - 1
        carried: list[Array | float] = [0.0]
        for i in range(count - 1):
            part = self._factored(i)
            carried.append(part.carry(part.solve(right(part), carried[i])))
        found: Array | None = None
        for i in reversed(range(count)):
            part = self._factored(i)
            following = 0.0 if found is None else part.after @ found[: len(part.after)]
            found = part.solve(right(part), carried[i], following)
            yield part, found

    def _right(self, frames: Array, *, weighted: bool, sensor: Array | None = None) -> Callable[[FactoredPart], Array]:
        """Right-hand sides of frames (n, ...): of the signal, or weighted ones of all components; of the sensor."""

        def right(part: FactoredPart) -> Array:
            out = np.zeros((part.size, *frames.shape[1:]))
            own = frames[part.frames]
            if weighted:
                own = weighted_columns(self.data.part(part.frames.start, part.frames.stop).precision, own)
            for row in part.components[: None if weighted else 1 + self.k]:
                out[row] = own
            if sensor is not None:
                rows, place = part.differences[-1]
                out[place] = sensor[rows]
            return out

        return right

    def _signal(self, right: Callable[[FactoredPart], Array], shape: tuple[int, ...]) -> Array:
        """Trend plus lines of a solution."""
        out = np.empty(shape)
        for part, found in self._solutions(right):
            out[part.frames] = np.sum([found[row] for row in part.components[: 1 + self.k]], axis=0)
        return out

    def _unknowns(self, right: Callable[[FactoredPart], Array]) -> Unknowns:
        """All unknowns of a solution."""
        components = np.empty((len(self.layout.components), self.n))
        differences = [np.empty(self.n - order) for _, order in self.layout.terms]
        for part, found in self._solutions(right):
            for column, row in zip(components, part.components, strict=True):
                column[part.frames] = found[row]
            for difference, (rows, place) in zip(differences, part.differences, strict=True):
                difference[rows] = found[place]
        return Unknowns(components, differences)

    def signal(self, unknowns: Unknowns) -> Array:
        """Sum of trend and lines, (n,)."""
        return np.asarray(sum(unknowns.components[1 : 1 + self.k], start=unknowns.components[0]))

    def unknowns(self) -> Unknowns:
        """Solution for the data."""
        d = self.data
        if d.second_difference_weights is None or d.second_differences is None:
            return self.unknowns_of(d.y)
        sensor = np.sqrt(d.second_difference_weights) * d.second_differences
        return self._unknowns(self._right(d.y, weighted=True, sensor=sensor))

    def residual(self, unknowns: Unknowns) -> Array:
        """Data minus signal and correlated noise, (n,); 0 in missing frames."""
        return np.where(self.data.w > 0, self.data.y - np.sum(unknowns.components, axis=0), 0.0)

    def shocks(self) -> Array:
        """Weighted fourth differences of the trend, (n - 4,): its innovations."""
        return self.unknowns().differences[0]

    def smooth(self, y: Array) -> Array:
        """Smooth columns with the weights of the data, without the sensor.

        Parameters
        ----------
        y
            Columns, (n, ...); values in missing frames do not count.

        Returns
        -------
        Array
            Trend plus lines, (n, ...).

        """
        return self._signal(self._right(y, weighted=True), y.shape)

    def unknowns_of(self, y: Array) -> Unknowns:
        """Solution for other positions y (n,), without the sensor."""
        return self._unknowns(self._right(y, weighted=True))

    def posterior_covariance_times(self, frames: Array) -> Array:
        """Posterior covariance of the signal for unit noise times columns (n, ...)."""
        return self._signal(self._right(frames, weighted=False), frames.shape)

    def restricted_likelihood(self) -> tuple[float, float, Unknowns]:
        """Compute the restricted likelihood (REML) of the data.

        Each of the two amplitudes of a line has a prior of the size of the noise, so the result does not depend on the
        unit.

        Returns
        -------
        tuple
            Twice the negative log-likelihood, the noise variance at its maximum, and all unknowns.

        References
        ----------
        Wahba 1985, Ann. Stat. 13, 1378-1402.

        """
        d, lines = self.data, self.lines
        unknowns = self.unknowns()
        residual = d.precision @ self.residual(unknowns) ** 2 + sum(float(q @ q) for q in unknowns.differences)
        if d.colour:
            residual += unknowns.components[-1, 0] ** 2 / d.colour.share
        degrees = d.count - TREND_ORDER - 2 * self.k
        variance = max(float(residual), np.finfo(float).tiny) / degrees
        self.corners()
        logdet = sum(self._logdets)
        penalties = float(np.sum(np.log(self.lam))) + (self.n - 2) * float(np.sum(np.log(lines.mu)))
        amplitudes = 2.0 * float(np.sum(np.log(np.sin(lines.omega))))
        noise = d.colour.log_likelihood_cost(int(np.sum(d.w > 0)), self.n) if d.colour else 0.0
        return (d.count - TREND_ORDER) * np.log(variance) + logdet - penalties + amplitudes + noise, variance, unknowns

    def variances(self, start: Index, stencils: Stencils) -> Array:
        """Posterior variance of linear combinations of neighbouring frames of the signal, for unit noise.

        Parameters
        ----------
        start
            First frame of each combination, (n,), not falling.
        stencils
            Weights, (..., n, m) with m at most `REACH`, or a function that returns those of a slice of the rows.

        Returns
        -------
        Array
            Variances, (..., n).

        """
        return np.asarray(variances_of([self], start, stencils)[0])

    def noise_variances(self, start: Index, stencils: Stencils) -> Array:
        """The part of those variances that is noise let through, not signal removed; arguments as in `variances`."""
        return self.posterior_and_noise_variance(start, stencils)[1]

    def posterior_and_noise_variance(
        self, start: Index, stencils: Stencils, combine: Callable[[Array, slice], Array] = lambda both, _: both
    ) -> Array:
        """Posterior variances, and the part of them that is noise let through.

        With V = (A + P'P)^-1 for all penalties times s, the noise that passes is V W V = V + s dV/ds.

        Parameters
        ----------
        start, stencils
            As in `variances`.
        combine
            Function of both variances (2, ..., m) of a slice of rows that returns what is wanted of them.

        Returns
        -------
        Array
            Both variances for unit noise, (2, ..., n), or what is wanted of them.

        """
        neighbours = [replace(self, penalty_factor=float(np.exp(d))) for d in (LOG_PENALTY_STEP, -LOG_PENALTY_STEP)]

        def with_noise(found: Array, rows: slice) -> Array:
            posterior, up, down = found
            return combine(np.stack([posterior, posterior + (up - down) / (2.0 * LOG_PENALTY_STEP)]), rows)

        return variances_of([self, *neighbours], start, stencils, with_noise)

    def following_corners(self) -> list[Array]:
        """Corrections of the last equations of each part and `REACH` frames more, by eliminating all later frames."""
        stops = [*(cut + REACH for cut in self.cuts[1:-1]), self.n]
        corners: list[Array] = []
        for first, stop in reversed(list(pairwise(stops))):
            part = reversed_part(self.part(first, stop))
            corners.append(following_corner(factor_part(part, corners[-1] if corners else None)))
        return [corner[::-1, ::-1] for corner in reversed(corners)]

    def enclosed_parts(self) -> Iterator[EquationPart]:
        """Yield the equations of each part and `REACH` frames more, after all other frames were eliminated."""
        before, after = [None, *self.corners()], [*self.following_corners(), None]
        for i, (first, stop) in enumerate(pairwise(self.cuts)):
            part = self.part(first, min(stop + REACH, self.n))
            add_corners(part, before[i], after[i])
            yield part


def variances_of(
    factors: Sequence[FactoredSmoother],
    start: Index,
    stencils: Stencils,
    combine: Callable[[Array, slice], Array] = lambda found, _: found,
) -> Array:
    """Posterior variances of several smoothers of the same frames at once."""
    factors = [replace(f, min_weight=MISSING_WEIGHT) for f in factors]
    signal = 1 + factors[0].k  # components
    out: Array | None = None
    for group in _equally_placed(zip(*(f.enclosed_parts() for f in factors), strict=True)):
        blocks = BlockEquations([part for parts in group for part in parts], factors[0].layout)
        for i, (part, *_) in enumerate(group):
            first, stop = part.frames.start, part.frames.stop - (REACH if part.frames.stop < factors[0].n else 0)
            rows = slice(*np.searchsorted(start, [first, stop]).tolist())
            weights = stencils(rows) if callable(stencils) else stencils[..., rows, :]
            place = start[rows, None] - first + np.arange(weights.shape[-1])
            found = blocks.variances(
                slice(i * len(factors), (i + 1) * len(factors)),
                np.concatenate([row[place] for row in part.components[:signal]], axis=1),
                np.concatenate([weights.reshape(-1, *weights.shape[-2:])] * signal, axis=-1),
            ).reshape(len(factors), *weights.shape[:-1])
            rounding = np.finfo(float).eps * np.sum(weights**2, axis=-1)  # a stiff cubic is that accurate
            found = np.maximum(combine(np.maximum(found, rounding), rows), rounding)
            out = np.empty((*found.shape[:-1], len(start))) if out is None else out
            out[..., rows] = found
    assert out is not None
    return out


def _equally_placed(parts: Iterable[tuple[EquationPart, ...]]) -> Iterator[list[tuple[EquationPart, ...]]]:
    """Yield neighbouring parts of one size together, at most `PARTS_AT_ONCE`."""
    for _, some in groupby(parts, key=lambda found: found[0].bands.shape[1]):
        while group := list(islice(some, PARTS_AT_ONCE)):
            yield group


@dataclass(frozen=True)
class Event:
    """Fourth differences first to last (inclusive) in which the trend is softer by exp(boost).

    The boost is constant, or rises linearly to the last difference (`rises` 1) or to the first one (-1).
    """

    first: int
    last: int
    boost: float
    rises: int = 0

    @property
    def boosts(self) -> Array:
        """Log of how much softer each difference is, (last - first + 1,)."""
        width = self.last - self.first + 1
        if not self.rises:
            return np.full(width, self.boost)
        ramp = self.boost * np.arange(1, width + 1) / width
        return ramp if self.rises > 0 else ramp[::-1]


@dataclass(frozen=True)
class Structure:
    """Structure of a record.

    Attributes
    ----------
    stiffness
        Log lambda at equally spaced knots.
    lines
        Frequency (radians per frame) and log mu of each line.
    events
        Events.

    """

    stiffness: tuple[float, ...]
    lines: tuple[tuple[float, float], ...] = ()
    events: tuple[Event, ...] = ()

    @classmethod
    def low_pass(cls, cutoff: float, interval: float) -> Structure:
        """A plain low-pass with a cut-off (Hz) at a frame interval (s)."""
        return cls((float(np.log(penalty(cutoff, interval))),))

    def log_lambda(self, n: int, first: int = 0, stop: int | None = None) -> Array:
        """Log lambda of the fourth differences first to stop (exclusive, by default all) of n frames."""
        rows = np.arange(first, n - TREND_ORDER if stop is None else stop) / max(n - TREND_ORDER - 1, 1)
        out = np.interp(rows, np.linspace(0.0, 1.0, len(self.stiffness)), self.stiffness)
        for e in self.events:
            low, high = max(e.first - first, 0), min(e.last + 1 - first, len(out))
            if low < high:
                out[low:high] -= e.boosts[low + first - e.first : high + first - e.first]
        return np.asarray(out)

    def factor_smoother(self, data: SmootherData, window: tuple[int, int, int] | None = None) -> FactoredSmoother:
        """Set up the smoother of data, or of a part of a record: `window` is its first frame, stop, and all frames."""
        first, stop, n = window or (0, len(data.w), len(data.w))
        omega, log_mu = np.array(self.lines).reshape(-1, 2).T
        lam = np.exp(self.log_lambda(n, first, stop - TREND_ORDER))
        return FactoredSmoother(data, lam, LineParameters(omega, np.exp(log_mu)))

    def numbers(self) -> Array:
        """All continuous parameters as one vector."""
        return np.array([*self.stiffness, *(v for line in self.lines for v in line), *(e.boost for e in self.events)])

    def with_numbers(self, numbers: Array) -> Structure:
        """The same structure with other values of its continuous parameters."""
        values = [float(v) for v in numbers]
        s, k = len(self.stiffness), len(self.lines)
        lines = tuple(zip(values[s : s + 2 * k : 2], values[s + 1 : s + 2 * k : 2], strict=True))
        events = tuple(replace(e, boost=b) for e, b in zip(self.events, values[s + 2 * k :], strict=True))
        return Structure(tuple(values[:s]), lines, events)

    def with_knots(self, count: int) -> Structure:
        """The same stiffness with another number of knots."""
        place = np.linspace(0.0, 1.0, len(self.stiffness))
        return replace(self, stiffness=tuple(np.interp(np.linspace(0, 1, count), place, self.stiffness).tolist()))
