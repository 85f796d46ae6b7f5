"""What a displacement is made of: a trend as stiff as the data say, lines, events; grown while the likelihood gains.

The stiffness of the trend (log lambda) runs through knots over the record, so that it may be smooth in the middle of a
slide and bend where it stops; in an event (a push, an impact, a stop) it is softer. A line is a vibration whose
amplitude and phase may wander. All numbers are of the highest restricted likelihood; one more line, event or set of
knots is taken when it gains more than its numbers would by chance (Schwarz 1978, Ann. Stat. 6).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import minimize

from frictrack.motion.system import (
    TREND_ORDER,
    FactoredSmoother,
    LineParameters,
    SmootherData,
    factor_smoother,
    penalty,
)
from frictrack.records import Array

MIN_PERIODS = 0.3  # of the cut-off over the record; a stiffer trend is a cubic
N_SCANNED = 24  # cut-offs that are tried first
KNOT_COUNTS = (1, 3, 5, 9, 17)  # of the stiffness
FRAMES_PER_KNOT = 60
KNOT_SPREAD = 4.0  # standard deviation of the change of log lambda from knot to knot, beforehand
MAX_LINES, MAX_EVENTS = 4, 40
LINE_COST, EVENT_COST, COLOUR_COST = 5, 3, 2  # numbers that one more of them costs, and that correlated noise does
STIFF_LINE = 40.0  # log mu of a sine that does not wander
START_LINE_STIFFNESSES = (7.0, 12.0, 20.0)  # log mu of a line
MAX_REFINEMENT_GAIN = 10.0  # that a trial may still gain when its numbers are refined
TRIAL_STEPS, MAX_STEPS = 6, 15  # of the refinement, on the way and at the end
STIFFENINGS = (0.0, 4.0, 8.0, 14.0)  # log, that the rest of the trend may gain
START_BOOSTS = (2.0, 6.0)  # log of how much softer the trend may be in an event
MIN_EVENT_RATIO = 8.0  # times their mean square; smaller differences are those of a smooth signal
START_WIDTHS = (1, 3, 8, 20, 60)  # differences that an event may take
MAX_SHRINKS, MAX_BEND = 6, 20.0  # times that a step is shortened while it bends the loss by more
MIN_LINE_CYCLES = 2.0  # over the record
MAX_WORK = 3_000_000  # frames in all likelihoods (lines cost more), after which a long record is left as it is
NUMBER_STEP = 0.02  # of the numbers, for slopes


@dataclass(frozen=True)
class Event:
    """Differences first to last (inclusive) in which the trend is softer, by exp(boost).

    All of them alike, or more and more to the last one (`rises` 1) or to the first one (-1).
    """

    first: int
    last: int
    boost: float
    rises: int = 0

    @property
    def boosts(self) -> Array:
        """By how much each difference is softer, log."""
        width = self.last - self.first + 1
        if not self.rises:
            return np.full(width, self.boost)
        ramp = self.boost * np.arange(1, width + 1) / width
        return ramp if self.rises > 0 else ramp[::-1]


@dataclass(frozen=True)
class Structure:
    """Stiffness log lambda at equally spaced knots; lines as (radians per frame, log mu); events."""

    stiffness: tuple[float, ...]
    lines: tuple[tuple[float, float], ...] = ()
    events: tuple[Event, ...] = ()

    @classmethod
    def low_pass(cls, cutoff: float, interval: float) -> Structure:
        """A plain low-pass."""
        return cls((float(np.log(penalty(cutoff, interval))),))

    def log_lambda(self, n: int) -> Array:
        """Stiffness of every difference of n frames."""
        place = np.linspace(0.0, 1.0, n - TREND_ORDER)
        out = np.interp(place, np.linspace(0.0, 1.0, max(len(self.stiffness), 2)), self._knots())
        for e in self.events:
            out[e.first : e.last + 1] -= e.boosts
        return np.asarray(out)

    def _knots(self) -> tuple[float, ...]:
        return self.stiffness * 2 if len(self.stiffness) == 1 else self.stiffness

    def factor_smoother(self, data: SmootherData) -> FactoredSmoother:
        """The smoother of some data."""
        return self.part(data, (0, len(data.w), len(data.w)))

    def part(self, data: SmootherData, window: tuple[int, int, int]) -> FactoredSmoother:
        """The smoother of data from a first frame to a stop, of so many frames."""
        first, stop, n = window
        omega, log_mu = np.array(self.lines).reshape(-1, 2).T
        return factor_smoother(
            data, np.exp(self.log_lambda(n)[first : stop - TREND_ORDER]), LineParameters(omega, np.exp(log_mu))
        )

    def numbers(self) -> Array:
        """All that likelihood settles, in one vector."""
        return np.array([*self.stiffness, *(v for line in self.lines for v in line), *(e.boost for e in self.events)])

    def with_numbers(self, numbers: Array) -> Structure:
        """The same structure with other numbers."""
        values = [float(v) for v in numbers]
        s, k = len(self.stiffness), len(self.lines)
        lines = tuple(zip(values[s : s + 2 * k : 2], values[s + 1 : s + 2 * k : 2], strict=True))
        events = tuple(replace(e, boost=b) for e, b in zip(self.events, values[s + 2 * k :], strict=True))
        return Structure(tuple(values[:s]), lines, events)

    def with_knots(self, count: int) -> Structure:
        """The same stiffness through another number of knots."""
        place = np.linspace(0.0, 1.0, max(len(self.stiffness), 2))
        return replace(self, stiffness=tuple(np.interp(np.linspace(0, 1, count), place, self._knots()).tolist()))


def undetectable_amplitude(n: int) -> float:
    """Amplitude, over the noise of a frame, of the largest line that n frames would not be granted.

    It gains n A^2 / 2 in twice the log-likelihood, and costs its numbers and what its amplitudes are known to.
    """
    return float(np.sqrt(2.0 * (LINE_COST * np.log(n) + 2.0 * np.log(n / 2.0)) / n))


@dataclass
class ScoredStructure:
    """A structure and how badly it explains the data: twice the negative log-likelihood, and what it costs."""

    structure: Structure
    loss: float


class StructureSearch:
    """Builds the structure of some data up, one part at a time; a cubic was taken out of them."""

    def __init__(self, data: SmootherData) -> None:
        self.data, self.n = data, len(data.w)
        self.remaining_work = MAX_WORK  # that may still be spent
        self.lowest = float(np.log(penalty(0.49, 1.0)))
        self.highest = float(np.log(penalty(max(MIN_PERIODS / self.n, 1e-5), 1.0)))
        self.cost = float(np.log(data.count))  # of one number

    def loss(self, structure: Structure) -> float:
        """Twice the negative log-likelihood, with what is known of the stiffness beforehand."""
        steps = np.diff(structure.stiffness) / KNOT_SPREAD
        # A cubic is no likely slide: the rest of its variance is kept off zero (Chung et al. 2013, Psychometrika 78).
        bent = 0.5 * float(np.mean(structure.stiffness))
        self.remaining_work -= self.n * (1 + len(structure.lines)) ** 2
        return structure.factor_smoother(self.data).restricted_likelihood()[0] + float(steps @ steps) + bent

    @cached_property
    def stiff(self) -> Structure:
        """A trend of one stiffness."""
        scan = np.linspace(self.lowest, self.highest, N_SCANNED)
        best = min((Structure((float(s),)) for s in scan), key=self.loss)
        return self.refine(ScoredStructure(best, self.loss(best))).structure

    def search(self) -> Structure:
        """Add what gains most, again and again, until nothing gains more than it costs."""
        knotted = self._best(self._with_more_knots(self.stiff))
        state = self.refine(
            knotted if np.isfinite(knotted.loss) else ScoredStructure(self.stiff, self.loss(self.stiff)), TRIAL_STEPS
        )
        while self.remaining_work > 0:
            kinds = (
                self._with_more_knots,
                self._with_line,
                self._with_event,
                self._with_line_and_event,
                self._with_narrower_event,
                self._with_fewer_events,
            )
            trials = [self._best(kind(state.structure)) for kind in kinds]
            for trial in sorted(trials, key=self._penalised):
                if self._penalised(trial) > self._penalised(state) + MAX_REFINEMENT_GAIN:
                    return self.refine(state).structure
                better = self.refine(trial, TRIAL_STEPS)
                if self._penalised(better) < self._penalised(state):
                    state = better
                    break
            else:
                return self.refine(state).structure
        return state.structure

    def penalised_loss(self, structure: Structure) -> float:
        """The loss, and what the numbers of structure and noise would gain by chance."""
        return self._penalised(ScoredStructure(structure, self.loss(structure)))

    def _penalised(self, g: ScoredStructure) -> float:
        return g.loss + self._price(g.structure)

    def _price(self, s: Structure) -> float:
        """What the numbers of a structure would gain by chance.

        What is known of a frequency grows with the cube of the record (Djuric 1996, IEEE Trans. Signal Process. 44),
        and it is sought; an event is also sought in place and width.
        """
        noise = COLOUR_COST if self.data.colour else 0
        return self.cost * (len(s.stiffness) + LINE_COST * len(s.lines) + EVENT_COST * len(s.events) + noise)

    def _best(self, trials: Iterator[Structure]) -> ScoredStructure:
        found = [ScoredStructure(t, self.loss(t)) for t in trials]
        return min(found, key=lambda g: g.loss, default=ScoredStructure(Structure((self.lowest,)), np.inf))

    def _with_more_knots(self, s: Structure) -> Iterator[Structure]:
        """More knots, the ends of the record softer or stiffer."""
        more = [k for k in KNOT_COUNTS if k > len(s.stiffness)]
        if not more or more[0] * FRAMES_PER_KNOT > self.n:
            return
        knots = s.with_knots(more[0])
        for end in (0, -1):
            for change in (-4.0, -8.0):
                values = np.array(knots.stiffness)
                values[end] += change
                yield replace(knots, stiffness=tuple(values.tolist()))

    def _with_line(self, s: Structure) -> Iterator[Structure]:
        """One line more, the trend as stiff as it was or stiffer."""
        if len(s.lines) < MAX_LINES:
            for stiffer in STIFFENINGS:
                trend = self._stiffer(s, stiffer)
                peak = self._peak(trend)
                for log_mu in START_LINE_STIFFNESSES:
                    yield replace(trend, lines=(*s.lines, (peak, log_mu)))

    def _with_event(self, s: Structure) -> Iterator[Structure]:
        """One event more, the rest of the trend as stiff as it was or stiffer."""
        if len(s.events) < MAX_EVENTS:
            shocks = s.factor_smoother(self.data).shocks() ** 2
            if np.max(shocks) > MIN_EVENT_RATIO * np.mean(shocks):
                for stiffer in STIFFENINGS:
                    yield from self._events(self._stiffer(s, stiffer), stiffer)
            most, least = max(s.stiffness), min(s.stiffness)
            if most - least > START_BOOSTS[-1]:  # what softens the whole of one end may be an event there
                yield from self._events(replace(s, stiffness=(most,) * len(s.stiffness)), most - least)

    def _with_line_and_event(self, s: Structure) -> Iterator[Structure]:
        """A line and an event, each of which hides the other."""
        if not s.lines and not s.events:
            for trial in list(self._with_line(s))[len(START_LINE_STIFFNESSES) + 2 :: len(START_LINE_STIFFNESSES)]:
                stiffer = trial.stiffness[0] - s.stiffness[0]
                yield from self._events(trial, stiffer)

    def _with_narrower_event(self, s: Structure) -> Iterator[Structure]:
        """The last event in less room."""
        if not s.events:
            return
        *others, e = s.events
        for width in (w for w in START_WIDTHS if w <= e.last - e.first):
            step = max(1, width // 2, (e.last - e.first) // 16)
            for first in range(e.first, e.last - width + 2, step):
                yield replace(s, events=(*others, Event(first, first + width - 1, e.boost + 3.0)))

    def _with_fewer_events(self, s: Structure) -> Iterator[Structure]:
        """One event less, its place taken by the stiffness of the trend or by another one."""
        for e in s.events:
            rest = replace(s, events=tuple(o for o in s.events if o is not e))
            yield rest
            half = 0.5 * (e.first + e.last) / (self.n - TREND_ORDER)
            nearest = round(half * (len(s.stiffness) - 1))
            knots = np.array(s.stiffness)
            knots[nearest] = max(knots[nearest] - e.boost, self.lowest)
            yield replace(rest, stiffness=tuple(knots.tolist()))

    def _stiffer(self, s: Structure, by: float) -> Structure:
        return replace(s, stiffness=tuple(min(v + by, self.highest) for v in s.stiffness))

    def _peak(self, s: Structure) -> float:
        """Frequency at which the residual has most, beside what the trend takes away, radians per frame."""
        factor = s.factor_smoother(self.data)
        m = 16 * self.n
        omega = 2 * np.pi * np.arange(m // 2 + 1) / m
        power = np.abs(np.fft.rfft(factor.residual(factor.unknowns()), m)) ** 2
        if self.data.colour:
            power *= self.data.colour.spectrum(omega)  # of noise, what is left has the inverse spectrum
        lam = np.exp(np.median(s.log_lambda(self.n)))
        kept = 1.0 / (1.0 + 1.0 / (lam * (2.0 * np.sin(omega / 2)) ** (2 * TREND_ORDER) + 1e-300))
        kept[: int(16 * MIN_LINE_CYCLES)] = np.inf
        kept[-32:] = np.inf
        return float(omega[np.argmax(power / np.maximum(kept, 1e-3))])

    def _events(self, s: Structure, stiffer: float) -> Iterator[Structure]:
        """One event more, where the differences are largest."""
        shocks = s.factor_smoother(self.data).shocks() ** 2
        for width in START_WIDTHS:
            if 4 * width > self.n:
                break
            total = np.convolve(shocks, np.ones(width), mode="valid")
            first = int(np.argmax(total))
            for boost in START_BOOSTS:
                yield replace(s, events=(*s.events, Event(first, first + width - 1, boost + stiffer)))

    def refine(self, g: ScoredStructure, steps: int = MAX_STEPS) -> ScoredStructure:
        """All numbers at the highest likelihood near where they are."""
        if not np.isfinite(g.loss):
            return g
        s, box = g.structure, self._box(g.structure)

        def loss(numbers: Array) -> float:
            return self.loss(s.with_numbers(np.clip(numbers, *box)))

        start, scale = self._scaled(loss, s, g.loss)
        bounds = list(zip((box[0] - start) / scale, (box[1] - start) / scale, strict=True))
        how: Any = {
            "method": "L-BFGS-B",
            "bounds": bounds,
            "options": {"eps": NUMBER_STEP, "ftol": 3e-6, "maxiter": steps},
        }

        def stepped(step: Array) -> float:
            return loss(start + step * scale)

        found = minimize(stepped, np.zeros(len(start)), **how)
        return ScoredStructure(s.with_numbers(np.clip(start + found.x * scale, *box)), float(found.fun))

    def _scaled(self, loss: Callable[[Array], float], s: Structure, now: float) -> tuple[Array, Array]:
        """Each number by itself at its best, and the step of it that costs about one."""
        line = [2 * np.pi / self.n / 10, 2.0]
        scale = np.array([1.0] * len(s.stiffness) + line * len(s.lines) + [1.0] * len(s.events))
        numbers = s.numbers()
        for i in range(len(numbers)):
            for _ in range(MAX_SHRINKS):
                unit = np.eye(len(numbers))[i] * scale[i]
                up, down = loss(numbers + unit), loss(numbers - unit)
                bend = up + down - 2 * now
                if bend < MAX_BEND:
                    break
                scale[i] /= 4.0
            if bend > 0:
                trial = numbers + unit * np.clip(0.5 * (down - up) / bend, -2.0, 2.0)
                after = loss(trial)
                if after < now:
                    numbers, now = trial, after
            elif min(up, down) < now:
                numbers, now = (numbers + unit, up) if up < down else (numbers - unit, down)
        return numbers, scale

    def _box(self, s: Structure) -> tuple[Array, Array]:
        k, e = len(s.lines), len(s.events)
        low = [self.lowest] * len(s.stiffness) + [MIN_LINE_CYCLES * 2 * np.pi / self.n, 0.0] * k + [0.0] * e
        high = [self.highest] * len(s.stiffness) + [3.1, STIFF_LINE] * k + [40.0] * e
        return np.array(low), np.array(high)
