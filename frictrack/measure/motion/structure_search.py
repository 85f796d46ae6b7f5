"""Select the structure of a displacement: trend, lines and events are added while the likelihood gains.

All parameters maximise the restricted likelihood. One more line, event or set of knots is accepted when it gains more
than its parameters would by chance (Schwarz 1978, Ann. Stat. 6).

The signal is averaged over structures that explain the data about as well as the best one does (Bayesian model
averaging: Hoeting et al. 1999, Stat. Sci. 14). Few frames determine how soft the trend is at the ends, and how wide an
event is. Near each end and event the structure is therefore changed: by a ramp of the stiffness toward the end or
event, as large as stiffnesses differ from knot to knot, and by events of other widths, places and shapes. A record may
begin and end at rest, a cubic, however soft the trend is beside it. Each change is weighted by its likelihood and its
prior. It alters only the trend nearby, so that it is evaluated in a window, and windows are treated as independent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from frictrack.measure.motion.banded_equations import TREND_ORDER, SmootherData, penalty, weighted_cubic
from frictrack.measure.motion.grid import stencil_derivatives, stencils
from frictrack.measure.motion.smoother import Event, FactoredSmoother, Structure, variances_of
from frictrack.records import Array

MIN_PERIODS = 0.3  # of the cut-off within the record; a stiffer trend is a cubic
N_SCANNED = 24  # cut-offs tried first
KNOT_COUNTS = (1, 3, 5, 9, 17)  # of the stiffness
FRAMES_PER_KNOT = 60
KNOT_SPREAD = 4.0  # prior standard deviation of the change of log lambda from knot to knot
MAX_LINES, MAX_EVENTS = 4, 40
LINE_COST, EVENT_COST, COLOUR_COST = 5, 3, 2  # parameters that one more line or event, or coloured noise, counts as
STIFF_LINE = 40.0  # log mu of a sine of constant amplitude and phase
START_LINE_STIFFNESSES = (7.0, 12.0, 20.0)  # log mu of a line
MAX_REFINEMENT_GAIN = 10.0  # that a trial may still gain when its parameters are refined
TRIAL_STEPS, MAX_STEPS = 6, 15  # iterations of a refinement, of trials and of the result
STIFFENINGS = (0.0, 4.0, 8.0, 14.0)  # log, by which the rest of the trend may become stiffer
START_BOOSTS = (2.0, 6.0)  # log of how much softer the trend is in a new event
MIN_EVENT_RATIO = 8.0  # of a squared difference over their mean; smaller ones belong to a smooth signal
START_WIDTHS = (1, 3, 8, 20, 60)  # differences of a new event
MAX_SHRINKS, MAX_CURVATURE = 6, 20.0  # a step is shortened at most so often while the loss curves by more
MIN_LINE_CYCLES = 2.0  # within the record
MAX_WORK = 3_000_000  # frames in all likelihoods (more with lines), after which the search ends
PARAMETER_STEP = 0.02  # of finite differences


def undetectable_amplitude(n: int) -> float:
    """Largest amplitude of a line that would not be accepted in n frames.

    A line gains n A^2 / 2 in twice the log-likelihood; it costs its parameters and the volume of its amplitudes.

    Examples
    --------
    >>> round(undetectable_amplitude(1000), 3)
    0.306

    """
    return float(np.sqrt(2.0 * (LINE_COST * np.log(n) + 2.0 * np.log(n / 2.0)) / n))


@dataclass
class ScoredStructure:
    """A structure, its loss, and the loss plus what its parameters and those of the noise would gain by chance.

    The loss is twice the negative log-likelihood with the prior.
    """

    structure: Structure
    loss: float
    penalised: float


class StructureSearch:
    """Search for the structure of data, from which a cubic was subtracted.

    Attributes
    ----------
    remaining_work
        Frames in likelihoods that may still be evaluated.

    """

    def __init__(self, data: SmootherData) -> None:
        self.data, self.n = data, len(data.w)
        self.remaining_work = MAX_WORK
        self.lowest = float(np.log(penalty(0.49, 1.0)))
        self.highest = float(np.log(penalty(max(MIN_PERIODS / self.n, 1e-5), 1.0)))
        self.cost = float(np.log(data.count))  # of one parameter

    def loss(self, structure: Structure) -> float:
        """Twice the negative log-likelihood, with the priors of the stiffness and of the distance between lines."""
        steps = np.diff(structure.stiffness) / KNOT_SPREAD
        # A pure cubic is unlikely: keep the variance of the rest off zero (Chung et al. 2013, Psychometrika 78).
        bent = 0.5 * float(np.mean(structure.stiffness))
        self.remaining_work -= self.n * (1 + len(structure.lines)) ** 2
        likelihood = structure.factor_smoother(self.data).restricted_likelihood()[0]
        # two lines within a Rayleigh cell are one, and their amplitudes would only cancel
        cells = np.diff(np.sort([omega for omega, _ in structure.lines])) * self.n / (2 * np.pi)
        coincidence = -2.0 * float(np.sum(np.log(np.maximum(-np.expm1(-(cells**2)), np.finfo(float).tiny))))
        return likelihood + float(steps @ steps) + bent + coincidence

    @cached_property
    def stiff(self) -> Structure:
        """Structure with a trend of one stiffness, at the highest likelihood."""
        scan = np.linspace(self.lowest, self.highest, N_SCANNED)
        return self.refine(self._best(Structure((float(s),)) for s in scan)).structure

    def search(self) -> Structure:
        """Add the change that gains most until nothing gains more than it costs."""
        knotted = self._best(self._with_more_knots(self.stiff))
        state = self.refine(knotted if np.isfinite(knotted.loss) else self.scored(self.stiff), TRIAL_STEPS)
        kinds = self._with_more_knots, self._with_line, self._with_event, self._with_narrower_event
        while self.remaining_work > 0:
            trials = [self._best(kind(state.structure)) for kind in kinds]
            for trial in sorted(trials, key=lambda g: g.penalised):
                if trial.penalised > state.penalised + MAX_REFINEMENT_GAIN:
                    return self.refine(state).structure
                better = self.refine(trial, TRIAL_STEPS)
                if better.penalised < state.penalised:
                    state = better
                    break
            else:
                return self.refine(state).structure
        return state.structure

    def scored(self, s: Structure, loss: float | None = None) -> ScoredStructure:
        """Score a structure, of which the loss may be known.

        A frequency counts three times, because its information grows with the cube of the record (Djuric 1996, IEEE
        Trans. Signal Process. 44), and it is searched. An event is also searched in place and width.
        """
        loss = self.loss(s) if loss is None else loss
        noise = COLOUR_COST if self.data.colour else 0
        parameters = len(s.stiffness) + LINE_COST * len(s.lines) + EVENT_COST * len(s.events) + noise
        return ScoredStructure(s, loss, loss + self.cost * parameters)

    def _best(self, trials: Iterable[Structure]) -> ScoredStructure:
        """The trial of the smallest loss; an infinite loss if there is none."""
        none = self.scored(Structure((self.lowest,)), np.inf)
        return min((self.scored(t) for t in trials), key=lambda g: g.loss, default=none)

    def _with_more_knots(self, s: Structure) -> Iterator[Structure]:
        """Trials with more knots and softer ends."""
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
        """Trials with one more line and a trend as stiff as before or stiffer."""
        if len(s.lines) < MAX_LINES:
            for stiffer in STIFFENINGS:
                trend = self.stiffer(s, stiffer)
                peak = self._peak(trend)
                for log_mu in START_LINE_STIFFNESSES:
                    yield replace(trend, lines=(*s.lines, (peak, log_mu)))

    def _with_event(self, s: Structure) -> Iterator[Structure]:
        """Trials with one more event and a trend as stiff as before or stiffer."""
        if len(s.events) < MAX_EVENTS:
            shocks = s.factor_smoother(self.data).shocks() ** 2
            if np.max(shocks) > MIN_EVENT_RATIO * np.mean(shocks):
                for stiffer in STIFFENINGS:
                    yield from self._events(self.stiffer(s, stiffer), stiffer)
            most, least = max(s.stiffness), min(s.stiffness)
            if most - least > START_BOOSTS[-1]:  # a soft end may be an event there
                yield from self._events(replace(s, stiffness=(most,) * len(s.stiffness)), most - least)

    def _with_narrower_event(self, s: Structure) -> Iterator[Structure]:
        """Trials with a narrower last event."""
        if not s.events:
            return
        *others, e = s.events
        for width in (w for w in START_WIDTHS if w <= e.last - e.first):
            step = max(1, width // 2, (e.last - e.first) // 16)
            for first in range(e.first, e.last - width + 2, step):
                yield replace(s, events=(*others, Event(first, first + width - 1, e.boost + 3.0)))

    def stiffer(self, s: Structure, by: float) -> Structure:
        """The same structure with a stiffer trend, within limits."""
        return replace(s, stiffness=tuple(min(v + by, self.highest) for v in s.stiffness))

    def _peak(self, s: Structure) -> float:
        """Frequency of the largest residual relative to what the trend removes, radians per frame."""
        factor = s.factor_smoother(self.data)
        m = 16 * self.n
        omega = 2 * np.pi * np.arange(m // 2 + 1) / m
        power = np.abs(np.fft.rfft(factor.residual(factor.unknowns()), m)) ** 2
        if self.data.colour:
            power *= self.data.colour.spectrum(omega)  # the residual of coloured noise has the inverse spectrum
        lam = np.exp(np.median(s.log_lambda(self.n)))
        kept = 1.0 / (1.0 + 1.0 / (lam * (2.0 * np.sin(omega / 2)) ** (2 * TREND_ORDER) + 1e-300))
        kept[: int(16 * MIN_LINE_CYCLES)] = np.inf
        kept[-32:] = np.inf
        return float(omega[np.argmax(power / np.maximum(kept, 1e-3))])

    def _events(self, s: Structure, stiffer: float) -> Iterator[Structure]:
        """Trials with one more event where the differences are largest."""
        shocks = s.factor_smoother(self.data).shocks() ** 2
        for width in START_WIDTHS:
            if 4 * width > self.n:
                break
            total = np.convolve(shocks, np.ones(width), mode="valid")
            first = int(np.argmax(total))
            for boost in START_BOOSTS:
                yield replace(s, events=(*s.events, Event(first, first + width - 1, boost + stiffer)))

    def refine(self, g: ScoredStructure, steps: int = MAX_STEPS) -> ScoredStructure:
        """Refine all continuous parameters to the next maximum of the likelihood (L-BFGS-B)."""
        if not np.isfinite(g.loss):
            return g
        s, limits = g.structure, self._bounds(g.structure)

        def loss(step: Array, start: Array | float = 0.0, scale: Array | float = 1.0) -> float:
            return self.loss(self.bounded(start + step * scale, s))

        start, scale = self._scaled(loss, s, g.loss)
        bounds = list(zip(*((limit - start) / scale for limit in limits), strict=True))
        options: Any = {"eps": PARAMETER_STEP, "ftol": 3e-6, "maxiter": steps}
        how: Any = {"method": "L-BFGS-B", "args": (start, scale), "bounds": bounds, "options": options}
        found = scipy.optimize.minimize(loss, np.zeros(len(start)), **how)
        return self.scored(self.bounded(start + found.x * scale, s), float(found.fun))

    def _scaled(self, loss: Callable[[Array], float], s: Structure, now: float) -> tuple[Array, Array]:
        """Optimise each parameter by itself, and find its step that costs about one."""
        line = [2 * np.pi / self.n / 10, 2.0]
        scale = np.array([1.0] * len(s.stiffness) + line * len(s.lines) + [1.0] * len(s.events))
        numbers = s.numbers()
        for i in range(len(numbers)):
            for _ in range(MAX_SHRINKS):
                unit = np.eye(len(numbers))[i] * scale[i]
                up, down = loss(numbers + unit), loss(numbers - unit)
                curvature = up + down - 2 * now
                if curvature < MAX_CURVATURE:
                    break
                scale[i] /= 4.0
            if curvature > 0:
                trial = numbers + unit * np.clip(0.5 * (down - up) / curvature, -2.0, 2.0)
                after = loss(trial)
                if after < now:
                    numbers, now = trial, after
            elif min(up, down) < now:
                numbers, now = (numbers + unit, up) if up < down else (numbers - unit, down)
        return numbers, scale

    def bounded(self, numbers: Array, s: Structure) -> Structure:
        """The same structure with other values of its parameters, within their bounds."""
        return s.with_numbers(np.clip(numbers, *self._bounds(s)))

    def _bounds(self, s: Structure) -> tuple[Array, Array]:
        """Bounds of the continuous parameters."""
        k, e = len(s.lines), len(s.events)
        low = [self.lowest] * len(s.stiffness) + [MIN_LINE_CYCLES * 2 * np.pi / self.n, 0.0] * k + [0.0] * e
        high = [self.highest] * len(s.stiffness) + [3.1, STIFF_LINE] * k + [40.0] * e
        return np.array(low), np.array(high)


MAX_WHOLE_FRAMES = 4000  # longer records are treated in windows
WINDOW_FRAMES, OVERLAP_FRAMES = 2500, 200  # frames of a window, and on either side of it
MIN_MEASURED_FRAMES = 100  # from which a window's structure can be found
KNOTS_PER_WINDOW = 5  # of the stiffness
POINTS_PER_CYCLE = 128  # per record, at which the residual of a line is largest
FREQUENCY_STEPS = (-0.25, -0.125, -0.0625, 0.0625, 0.125, 0.25)  # cycles per record, tried about a frequency
LINE_STIFFNESSES = (10.0, 14.0, 18.0, 24.0, STIFF_LINE)  # log mu of a line


@dataclass(frozen=True)
class RecordWindow:
    """Frames first to stop (exclusive) of a record; those from core to core_stop belong to no other window."""

    first: int
    stop: int
    core: int
    core_stop: int
    structure: Structure


def find_structure(data: SmootherData) -> Structure:
    """Find the structure of the highest likelihood."""
    if len(data.w) <= MAX_WHOLE_FRAMES:
        return StructureSearch(data).search()
    windows = list(_windows(data))
    structure = Structure(_stiffness(windows, len(data.w)), (), tuple(_events(windows, len(data.w))))
    return _add_lines(structure, data, windows)


def _windows(data: SmootherData) -> Iterator[RecordWindow]:
    """Yield windows of about equal length with their structures."""
    n = len(data.w)
    cores = np.linspace(0, n, round(n / WINDOW_FRAMES) + 1).astype(int)
    last: Structure | None = None
    for core, core_stop in zip(cores[:-1].tolist(), cores[1:].tolist(), strict=True):
        first, stop = max(core - OVERLAP_FRAMES, 0), min(core_stop + OVERLAP_FRAMES, n)
        part = window_data(data, first, stop)
        if part is not None:
            last = StructureSearch(part).search()
        yield RecordWindow(first, stop, core, core_stop, last or StructureSearch(data).stiff)


def window_data(data: SmootherData, first: int, stop: int) -> SmootherData | None:
    """Cut a window out of the data and subtract its own cubic."""
    part = data.part(first, stop)
    if np.sum(part.w > 0) < MIN_MEASURED_FRAMES:
        return None
    cubic = weighted_cubic(part.y, part.w)
    bent = None if part.second_differences is None else part.second_differences - np.diff(cubic, 2)
    return replace(part, y=np.where(part.w > 0, part.y - cubic, 0.0), second_differences=bent)


def _stiffness(windows: Sequence[RecordWindow], n: int) -> tuple[float, ...]:
    """Log lambda at equally spaced knots over the record, interpolated from the windows."""
    places, values = [], []
    for window in windows:
        without_events = replace(window.structure, events=()).log_lambda(window.stop - window.first)
        core_rows = slice(window.core - window.first, min(window.core_stop - window.first, len(without_events)))
        places.append(np.arange(len(without_events))[core_rows] + window.first)
        values.append(without_events[core_rows])
    frequencies = np.linspace(0, n - TREND_ORDER - 1, KNOTS_PER_WINDOW * len(windows) + 1)
    return tuple(np.interp(frequencies, np.concatenate(places), np.concatenate(values)).tolist())


def _events(windows: Sequence[RecordWindow], n: int) -> Iterator[Event]:
    """Yield the events of all windows at their places in the record."""
    for window in windows:
        for e in window.structure.events:
            first, last = e.first + window.first, min(e.last + window.first, n - TREND_ORDER - 1)
            if window.core <= 0.5 * (first + last) + 0.5 * TREND_ORDER < window.core_stop:
                yield Event(first, last, e.boost)


def _add_lines(structure: Structure, data: SmootherData, windows: Sequence[RecordWindow]) -> Structure:
    """Add the lines found in windows, the most frequent ones first, and refine them on the whole record."""
    search, cell = StructureSearch(data), 2 * np.pi / WINDOW_FRAMES
    used: list[float] = []
    for omega in _frequencies(windows, cell):
        if all(abs(omega - other) >= cell for other in used):
            used.append(omega)
            structure = _with_best_line(structure, _peak(search, structure, omega, cell), search)
    return structure


def _frequencies(windows: Sequence[RecordWindow], cell: float) -> list[float]:
    """Frequencies of lines, radians per frame, the `MAX_LINES` that most windows contain."""
    found = np.array([omega for window in windows for omega, _ in window.structure.lines])
    if not len(found):
        return []
    found.sort()
    low, high = np.searchsorted(found, [found - cell, found + cell])  # the same line
    chosen: list[float] = []
    for i in np.argsort(low - high, kind="stable"):
        if len(chosen) < MAX_LINES and all(abs(found[i] - omega) >= cell for omega in chosen):
            chosen.append(float(np.median(found[low[i] : high[i]])))
    return chosen


def _peak(search: StructureSearch, structure: Structure, omega: float, cell: float) -> float:
    """Frequency near `omega` where the residual of the whole record is largest, radians per frame."""
    factor = structure.factor_smoother(search.data)
    residual = factor.residual(factor.unknowns())
    frequencies = np.linspace(omega - cell, omega + cell, int(POINTS_PER_CYCLE * search.n * cell / np.pi))
    amplitudes = scipy.signal.zoom_fft(residual, frequencies[[0, -1]], len(frequencies), fs=2 * np.pi, endpoint=True)
    return float(frequencies[np.argmax(np.abs(amplitudes))])


def _with_best_line(structure: Structure, omega: float, search: StructureSearch) -> Structure:
    """Add a line near a frequency, radians per frame: penalty, then frequency, of the highest likelihood."""

    def with_line(omega: float, log_mu: float) -> Structure:
        return replace(structure, lines=(*structure.lines, (omega, log_mu)))

    best = min((with_line(omega, log_mu) for log_mu in LINE_STIFFNESSES), key=search.loss)
    log_mu = best.lines[-1][1]
    tried = [best, *(with_line(omega + 2 * np.pi * turn / search.n, log_mu) for turn in FREQUENCY_STEPS)]
    return min(tried, key=search.loss)


RAMP_DEPTHS = np.array([1.0, 2.0, 3.0])  # over the prior standard deviation of the stiffness
RAMP_LENGTHS = (0.15, 0.4, 1.0)  # over the period of the trend's cut-off
REST_LENGTHS = (1.0, 1.4, 2.0, 2.8, 4.0, 5.7, 8.0)  # the same, of a rest
WIDTH_FACTORS = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)  # width of another event over that of the event
RAMP_WIDTH_FACTORS = (1, 2, 4, 8)  # the same of an event that rises to its end or falls from its beginning
SHIFTS = (-0.25, 0.0, 0.25)  # of an event, over its width
BOOST_CHANGES = (-2.0, 0.0, 2.0)  # log, change of its softness
WIDTH_EXPONENT = 6.0  # the squared fourth differences of a pulse grow with this power of the inverse width
MAX_GAIN = 100.0  # of twice the log-likelihood; larger ones count the same, so that exp does not overflow
MIN_WEIGHT, MAX_CHANGES = 0.02, 8  # smallest weight of a change that is kept, and number of changes
REACH_PERIODS, MIN_REACH_FRAMES = 3.0, 500  # half width of a window: periods of the cut-off, and frames at least


Window = tuple[int, int, int]  # first frame, stop, and frames of the record


@dataclass(frozen=True)
class StructureChange:
    """A further event (a ramp), or one that replaces event number `instead`; with its weight in the average."""

    weight: float
    event: Event
    instead: int = -1


@dataclass(frozen=True)
class ChangeGroup:
    """Changes that exclude each other, evaluated in the frames first to stop (exclusive)."""

    first: int
    stop: int
    changes: tuple[StructureChange, ...]

    @classmethod
    def read(cls, settings: Mapping[str, Any]) -> ChangeGroup:
        """Read a group from its JSON."""
        changes = (StructureChange(c["weight"], Event(**c["event"]), c["instead"]) for c in settings["changes"])
        return cls(settings["first"], settings["stop"], tuple(changes))


def alternatives(data: SmootherData, structure: Structure) -> tuple[ChangeGroup, ...]:
    """Find the changes of a structure that the data do not exclude."""
    groups = [_weigh_changes(data, structure, list(changes)) for changes in _changes(structure, len(data.w))]
    return tuple(g for g in groups if g is not None and g.changes)


def _changes(s: Structure, n: int) -> Iterator[Iterator[StructureChange]]:
    """Yield possible changes by place; their weights are priors."""
    events = sorted((e.first, e.last + 1) for e in s.events)
    edges = [0, *(edge for e in events for edge in e), n - TREND_ORDER]
    for begin, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - begin > 1:
            yield _ramps(s, begin, stop, -1, n)
            yield _ramps(s, begin, stop, 1, n)
    for i in range(len(s.events)):
        yield _changed_events(s, i, n)


def _ramps(s: Structure, begin: int, stop: int, rises: int, n: int) -> Iterator[StructureChange]:
    """Yield softer ramps, and rests, at one end of the differences from begin to stop (exclusive)."""
    edge = stop - 1 if rises > 0 else begin
    period = _period(s, edge, n)
    for length in RAMP_LENGTHS:
        width = int(min(round(length * period), (stop - begin) // 2))
        first = stop - width if rises > 0 else begin
        for depth in RAMP_DEPTHS if width > 1 else ():
            ramp = Event(first, first + width - 1, KNOT_SPREAD * depth, rises)
            yield StructureChange(float(np.exp(-0.5 * depth**2)), ramp)
    is_end = begin == 0 if rises < 0 else stop == n - TREND_ORDER
    widths = {int(min(round(length * period), (stop - begin) // 2)) for length in REST_LENGTHS if is_end}
    for width in sorted(widths - {0, 1}):
        first = stop - width if rises > 0 else begin
        yield StructureChange(1.0, Event(first, first + width - 1, -KNOT_SPREAD * RAMP_DEPTHS[-1]))


def _changed_events(s: Structure, i: int, n: int) -> Iterator[StructureChange]:
    """Yield event i with other widths, places and shapes."""
    e = s.events[i]
    prior = max((o.last + 1 for o in s.events if o.last < e.first), default=0)
    after = min((o.first for o in s.events if o.first > e.last), default=n - TREND_ORDER)
    width, middle = e.last - e.first + 1, 0.5 * (e.first + e.last)
    tried = {
        (round(middle + move * width - 0.5 * (times * width - 1)), max(round(times * width), 1), 0)
        for times in WIDTH_FACTORS
        for move in SHIFTS
    }
    tried |= {(e.last + 1 - times * width, times * width, 1) for times in RAMP_WIDTH_FACTORS}
    tried |= {(e.first, times * width, -1) for times in RAMP_WIDTH_FACTORS}
    for first, new_width, rises in sorted(tried):
        usual_boost = e.boost - (WIDTH_EXPONENT * np.log(new_width / width) if not rises else 0.0)
        for boost in BOOST_CHANGES if prior <= first and first + new_width <= after else ():
            other = Event(first, first + new_width - 1, max(usual_boost + boost, 0.0), rises)
            if other != e:
                yield StructureChange(1.0, other, i)


def _period(s: Structure, place: int, n: int) -> float:
    """Period of the trend's cut-off at a difference, frames."""
    without_events = replace(s, events=()).log_lambda(n, place, place + 1)
    return float(2.0 * np.pi * np.exp(without_events[0] / (2 * TREND_ORDER)))


def _weigh_changes(data: SmootherData, s: Structure, changes: Sequence[StructureChange]) -> ChangeGroup | None:
    """Weigh changes by the data; return those that are kept."""
    if not changes:
        return None
    window = _window(s, changes, len(data.w))
    part = window_data(data, *window[:2])
    if part is None:
        return None
    base = _factor(part, s, window, None).restricted_likelihood()[0]
    gains = np.array([base - _factor(part, s, window, c).restricted_likelihood()[0] for c in changes])
    rests = np.array([c.event.boost < 0 for c in changes])
    rested = np.max(gains[rests], initial=0.0) > np.log(part.count)  # more than a parameter, the length, by chance
    prior = np.where(rests == rested, [c.weight for c in changes], 0.0)
    if changes[0].instead < 0:  # the prior of the ramps includes one of no depth
        prior = prior / np.sum(prior)
    posterior = prior * np.exp(0.5 * np.minimum(gains, MAX_GAIN))
    shares = posterior / (float(not rested) + np.sum(posterior))
    kept = [i for i in np.argsort(-shares)[:MAX_CHANGES].tolist() if shares[i] > MIN_WEIGHT]
    if rested:
        shares /= np.sum(shares[kept])
    return ChangeGroup(*window[:2], tuple(replace(changes[i], weight=float(shares[i])) for i in kept))


def _window(s: Structure, changes: Sequence[StructureChange], n: int) -> Window:
    """Frames near the changes."""
    events = [c.event for c in changes]
    first, last = min(e.first for e in events), max(e.last for e in events) + TREND_ORDER
    periods = max(_period(s, min(place, n - TREND_ORDER - 1), n) for place in (first, last))
    reach = max(round(REACH_PERIODS * periods), MIN_REACH_FRAMES)
    return max(first - reach, 0), min(last + reach + 1, n), n


def _factor(part: SmootherData, s: Structure, window: Window, change: StructureChange | None) -> FactoredSmoother:
    """Set up the smoother of a part of the data, with a changed structure."""
    if change is not None:
        others = (e for i, e in enumerate(s.events) if i != change.instead)
        s = replace(s, events=(*others, change.event))
    return s.factor_smoother(part, window)


def _signal_changes(data: SmootherData, s: Structure, group: ChangeGroup) -> Array:
    """Change of the signal in the window by each change, (k, stop - first)."""
    window = group.first, group.stop, len(data.w)
    part = window_data(data, *window[:2])
    assert part is not None
    unchanged, *changed = (_factor(part, s, window, c) for c in (None, *group.changes))
    base = unchanged.signal(unchanged.unknowns())
    # 1 near the changes, fading to 0 where the window cuts the record
    rise = np.sin(0.5 * np.pi * np.minimum(np.arange(len(base)) / (MIN_REACH_FRAMES // 2), 1.0)) ** 2
    fade = (rise if group.first else 1.0) * (rise[::-1] if group.stop < len(data.w) else np.ones(len(rise)))
    return np.array([f.signal(f.unknowns()) - base for f in changed]) * fade


def mean_shift(data: SmootherData, s: Structure, groups: Sequence[ChangeGroup]) -> Array:
    """Change of the signal of the best structure by the average."""
    out = np.zeros(len(data.w))
    for g in groups:
        out[g.first : g.stop] += np.array([c.weight for c in g.changes]) @ _signal_changes(data, s, g)
    return out


def added_variances(
    data: SmootherData, s: Structure, groups: Sequence[ChangeGroup], interval: float
) -> Iterator[tuple[slice, Array, Array]]:
    """Yield the frames of each group, and by which factor and by what the average changes the variances of x, v, a."""
    for g in groups:
        weights = np.array([c.weight for c in g.changes])
        moves = np.array([stencil_derivatives(move, interval) for move in _signal_changes(data, s, g)])
        between = np.einsum("k,kqn->qn", weights, moves**2) - np.einsum("k,kqn->qn", weights, moves) ** 2
        window = g.first, g.stop, len(data.w)
        part = SmootherData(np.zeros(g.stop - g.first), data.w[g.first : g.stop], colour=data.colour)
        stencil = stencils(g.stop - g.first, interval)
        found = variances_of([_factor(part, s, window, c) for c in (None, *g.changes)], *stencil)
        within = np.einsum("k,kqn->qn", weights, found[1:] - found[0])
        left = 1.0 + np.minimum(within, 0.0) / found[0]
        yield slice(g.first, g.stop), left, np.maximum(between, 0.0) + np.maximum(within, 0.0)
