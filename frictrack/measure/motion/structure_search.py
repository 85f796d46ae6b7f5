"""Select the structure of a displacement: trend, lines and events are added while the likelihood gains.

All parameters maximise the restricted likelihood. One more line, event or set of knots is accepted when it gains more
than its parameters would by chance (Schwarz 1978, Ann. Stat. 6).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from frictrack.measure.motion.banded_equations import TREND_ORDER, SmootherData, penalty, weighted_cubic
from frictrack.measure.motion.smoother import Event, Structure
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
    """A structure and its loss: twice the negative log-likelihood with the prior."""

    structure: Structure
    loss: float


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
        return likelihood + float(steps @ steps) + bent + self._coincidence(structure)

    def _coincidence(self, structure: Structure) -> float:
        """Prior that keeps lines apart: two within a Rayleigh cell are one, and their amplitudes would only cancel."""
        cells = np.diff(np.sort([omega for omega, _ in structure.lines])) * self.n / (2 * np.pi)
        return -2.0 * float(np.sum(np.log(np.maximum(-np.expm1(-(cells**2)), np.finfo(float).tiny))))

    @cached_property
    def stiff(self) -> Structure:
        """Structure with a trend of one stiffness, at the highest likelihood."""
        scan = np.linspace(self.lowest, self.highest, N_SCANNED)
        best = min((Structure((float(s),)) for s in scan), key=self.loss)
        return self.refine(ScoredStructure(best, self.loss(best))).structure

    def search(self) -> Structure:
        """Add the change that gains most until nothing gains more than it costs."""
        knotted = self._best(self._with_more_knots(self.stiff))
        state = self.refine(
            knotted if np.isfinite(knotted.loss) else ScoredStructure(self.stiff, self.loss(self.stiff)), TRIAL_STEPS
        )
        while self.remaining_work > 0:
            kinds = (
                self._with_more_knots,
                self._with_line,
                self._with_event,
                self._with_narrower_event,
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
        """Loss plus what the parameters of structure and noise would gain by chance."""
        return self._penalised(ScoredStructure(structure, self.loss(structure)))

    def _penalised(self, g: ScoredStructure) -> float:
        return g.loss + self._parameter_cost(g.structure)

    def _parameter_cost(self, s: Structure) -> float:
        """What the parameters of a structure would gain by chance.

        A frequency counts three times, because its information grows with the cube of the record (Djuric 1996, IEEE
        Trans. Signal Process. 44), and it is searched. An event is also searched in place and width.
        """
        noise = COLOUR_COST if self.data.colour else 0
        return self.cost * (len(s.stiffness) + LINE_COST * len(s.lines) + EVENT_COST * len(s.events) + noise)

    def _best(self, trials: Iterator[Structure]) -> ScoredStructure:
        """The trial of the smallest loss; an infinite loss if there is none."""
        found = [ScoredStructure(t, self.loss(t)) for t in trials]
        return min(found, key=lambda g: g.loss, default=ScoredStructure(Structure((self.lowest,)), np.inf))

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

        def loss(numbers: Array) -> float:
            return self.loss(self.bounded(numbers, s))

        start, scale = self._scaled(loss, s, g.loss)
        bounds = list(zip((limits[0] - start) / scale, (limits[1] - start) / scale, strict=True))
        options: Any = {
            "method": "L-BFGS-B",
            "bounds": bounds,
            "options": {"eps": PARAMETER_STEP, "ftol": 3e-6, "maxiter": steps},
        }

        def scaled_loss(step: Array) -> float:
            return loss(start + step * scale)

        found = scipy.optimize.minimize(scaled_loss, np.zeros(len(start)), **options)
        return ScoredStructure(self.bounded(start + found.x * scale, s), float(found.fun))

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
MAX_WINDOW_WORK = 1_500_000  # frames in all likelihoods of one window
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
            search = StructureSearch(part)
            search.remaining_work = MAX_WINDOW_WORK
            last = search.search()
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
    search = StructureSearch(data)
    used = np.zeros(0)
    cell = 2 * np.pi / WINDOW_FRAMES
    for omega in _frequencies(windows, cell):
        if np.any(np.abs(used - omega) < cell):
            continue
        used = np.append(used, omega)
        structure = _refine_last_line(
            replace(structure, lines=(*structure.lines, (_peak(search, structure, omega, cell), LINE_STIFFNESSES[1]))),
            search,
        )
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


def _refine_last_line(structure: Structure, search: StructureSearch) -> Structure:
    """Choose frequency and penalty of the last line by the highest likelihood."""
    *others, (omega, _) = structure.lines

    def with_line(omega: float, log_mu: float) -> Structure:
        return replace(structure, lines=(*others, (omega, log_mu)))

    best = min((with_line(omega, log_mu) for log_mu in LINE_STIFFNESSES), key=search.loss)
    log_mu = best.lines[-1][1]
    tried = [best, *(with_line(omega + 2 * np.pi * turn / search.n, log_mu) for turn in FREQUENCY_STEPS)]
    return min(tried, key=search.loss)
