"""Fit models with waves of a common amplitude, such as ATM2: fast waves, then slow waves, then everything together.

The effect defines its relaxed form: waves of free amplitude, which are linear, and its other columns. One wave of
every sum is taken as slow. The fast waves are found with free amplitudes beside anything slow, at a few values of the
parameter that several parts share, such as v_s. The slow waves are found beside them with the common amplitudes. At
the value found, the fast waves are searched again. The run with the most frames is solved first; the other runs add
only their own parameters.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, product

import numpy as np

from frictrack.effects import Effect
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.separable.fast_waves import FastWaves, WaveSet
from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.newton import ProjectedProblem, SeparableSolution
from frictrack.fit.separable.relaxed import RelaxedWaves
from frictrack.fit.separable.slow_waves import SlowWaves
from frictrack.fit.separable.varpro import VariableProjection
from frictrack.models import Model
from frictrack.records import Array

SCAN_PLACES_FROM_END = (3, 6, 8)  # grid points from the end of the shared parameter's scan at which waves are searched
MAX_WAVE_SETS = 4  # sets of fast waves; the slow waves are searched for with each of these sets
MAX_RELAXED_MISFIT_RATIO = 1.5  # times the best misfit; relaxed fits beyond have the wrong waves
MAX_FINALISTS = 3  # sets of slow waves that are refined together with the fast waves
MAX_STEPS = 30
MIN_GAIN_SHARE = 1e-5  # least gain of a trial, share of the misfit
ROUGH_MIN_FALL = 1e-4  # predicted fall of a step, share of the misfit, during comparisons
MIN_FAST_PERIODS = 1.9  # periods per run above which a wave may be a fast one
MAX_MIXED_PERIODS = 4.5  # periods per run up to which a fast wave may be confused with slow ones
MIXED_PERIODS = (2.2, 2.7, 3.2, 3.7, 4.2)  # frequencies in between, which may be hidden by slow waves
MAX_CONFUSED_PERIODS = 1.5  # periods per run within which fast waves of two sums may be confused
MAX_ASSIGNMENTS = 100  # choices of frequencies that are refined
SAME_WAVE_PERIODS = 0.25  # periods per run; closer waves count as the same


def variable_projection(separable: SeparableModel) -> VariableProjection | ConstrainedVariableProjection:
    """Create the search that fits a model along the measured motion.

    Parameters
    ----------
    separable : SeparableModel
        The model over its data.

    Returns
    -------
    VariableProjection or ConstrainedVariableProjection
        Callable that returns a `SeparableSolution`.

    """
    return (
        ConstrainedVariableProjection(separable)
        if any(e.relaxed for e in separable.layout.model.effects)
        else VariableProjection(separable)
    )


class ConstrainedVariableProjection:
    """The search for a model with a relaxed effect. Its tables are reused for further data sets."""

    def __init__(self, separable: SeparableModel, tau: float = 0.03) -> None:
        self.separable, self.tau = separable, tau
        self.effect = next(e for e in separable.layout.model.effects if e.relaxed)
        length = {r: sum(len(b.data) for b in separable.blocks if b.run == r) for r in separable.runs}
        self.runs = sorted(separable.runs, key=lambda r: -length[r])
        self.first = _RunSearch(_single_run(separable, self.runs[0], separable.layout.model), self.effect)

    def __call__(self, data: Array | None = None) -> SeparableSolution:
        """Return the best solution for data (M,); default those of the blocks."""
        data = self.separable.data if data is None else data
        state, first = self.first(self._data_of_run(self.runs[0], data)), self.first.separable
        if first is self.separable:
            return state
        found = dict(zip(first.layout.names, first.law(state.nonlinear_values, state.coefficients), strict=True))
        for run in self.runs[1:]:
            found = self._fit_run(run, found, self._data_of_run(run, data)) | found
        problem = ProjectedProblem(self.separable, data, self.tau)
        nonlinear_values = np.array([found.get(name, 1.0) for name in self.separable.layout.names])
        return problem.refine(problem.at(nonlinear_values), steps=MAX_STEPS)

    def unneeded_events(self, state: SeparableSolution, penalty: float) -> frozenset[tuple[str, int]]:
        """Return the events of single runs, (effect, run), that gain less than a penalty."""
        return VariableProjection(self.separable, self.tau).unneeded_events(state, penalty)

    def _fit_run(self, run: int, found: dict[str, float], data: Array) -> dict[str, float]:
        """Parameters of one run by address, the shared ones held at their values."""
        fixed_model = Model(tuple(_with_fixed_values(e, found) for e in self.separable.layout.model.effects))
        separable = _single_run(self.separable, run, fixed_model)
        state = _RunSearch(separable, next(e for e in fixed_model.effects if e.relaxed))(data)
        return dict(zip(separable.layout.names, separable.law(state.nonlinear_values, state.coefficients), strict=True))

    def _data_of_run(self, run: int, data: Array) -> Array:
        """The data of one run."""
        pairs = zip(self.separable.blocks, self.separable.slices, strict=True)
        return np.concatenate([data[s] for block, s in pairs if block.run == run])


class _RunSearch:
    """The search in one run."""

    def __init__(self, separable: SeparableModel, effect: Effect) -> None:
        self.separable, self.relaxed = separable, RelaxedWaves(separable, effect)
        slow = [min(waves, key=lambda w: self.relaxed.bounds(w.frequency)[0]) for waves in self.relaxed.sums.values()]
        one, other = slow
        self.slow = SlowWaves(self.relaxed, (one, other))
        self.fast = [w for w in self.relaxed.waves if w not in slow]
        self.shared_values = self.relaxed.shared.values if self.relaxed.shared is not None else (1.0,)
        self._fast_searches: dict[int, FastWaves] = {}

    def __call__(self, data: Array) -> SeparableSolution:
        """Return the best solution for data (M,)."""
        problem, best = ProjectedProblem(self.separable, data), None
        places = self._first_places() if self.fast else []
        tried = self._promising([self._fast_search(i).first_found(data) for i in places])
        for waves in tried or [self._no_waves()]:
            best = self._with_slow_waves(problem, waves, best)
        assert best is not None
        searched: list[int] = []
        misses = not self.fast
        while self.fast and (place := self._place_of(best)) not in searched:
            searched.append(place)
            waves = self._fast_search(place)(data)
            misses |= waves.misses_wave
            if not any(waves.resembles(other, SAME_WAVE_PERIODS) for other in tried):
                tried.append(waves)
                best = self._with_slow_waves(problem, waves, best)
        if self.fast and self._is_ambiguous(best):
            best = self._with_waves_reassigned(problem, best, tried)
        if misses:
            best = self._with_any_waves(problem, best)
        return problem.refine(best, steps=MAX_STEPS)

    def _with_any_waves(self, problem: ProjectedProblem, best: SeparableSolution) -> SeparableSolution:
        """The best solution with waves that were all found with free amplitudes, none taken as slow."""
        for value in (self.shared_values[i] for i in self._first_places()):
            others = self.relaxed.other_parts(np.array([value]))[0]
            waves = FastWaves(self.relaxed, self.relaxed.waves, value, others).first_found(problem.data)
            trials = [waves.p, *self.relaxed.exchanged(waves.p)]
            for p in [q for trial in trials for _, q in self.slow.near(trial, problem.data)]:
                trial = problem.refine(problem.at(p), steps=MAX_STEPS, below=best.misfit)
                best = trial if trial.misfit < best.misfit else best
        return best

    def _periods(self, state: SeparableSolution) -> list[Array]:
        """Periods per run of the waves of every sum."""
        duration = self.separable.layout.span.duration
        return [
            np.array([duration * self.relaxed.value(state.nonlinear_values, w.frequency) for w in waves])
            for waves in self.relaxed.sums.values()
        ]

    def _is_ambiguous(self, state: SeparableSolution) -> bool:
        """Whether fast waves of two sums are close enough to be confused, or a wave is neither slow nor fast."""
        one, other = self._periods(state)
        both = np.concatenate([one, other])
        close = np.abs(one[:, None] - other) < MAX_CONFUSED_PERIODS
        fast = np.minimum(one[:, None], other) > MIN_FAST_PERIODS
        return bool(np.any(close & fast) or np.any((both > MIN_FAST_PERIODS) & (both < MAX_MIXED_PERIODS)))

    def _with_waves_reassigned(
        self, problem: ProjectedProblem, best: SeparableSolution, tried: list[WaveSet]
    ) -> SeparableSolution:
        """The best solution with every frequency that was found in either sum, until nothing is better."""
        refined: list[WaveSet] = []
        better: SeparableSolution | None = best
        while better is not None:
            again = WaveSet(self._full_vector(best), best.misfit, self._fast_periods(best))
            searches = [self._fast_search(i) for i in {*self._first_places(), self._place_of(best)}]
            mixed = MAX_MIXED_PERIODS / self.separable.layout.span.duration
            sets = [fast.refined(f, problem.data, mixed) for f in self._assignments(best, tried) for fast in searches]
            better = None
            for waves in [again, *self._promising(sets, 2 * MAX_WAVE_SETS)]:
                if waves is not again and any(waves.resembles(other, SAME_WAVE_PERIODS / 5) for other in refined):
                    continue
                refined.append(waves)
                state = self._with_slow_waves(problem, waves, best, all_waves=True)
                if state.misfit < (1 - MIN_GAIN_SHARE) * best.misfit:
                    best = better = state
        return best

    def _full_vector(self, state: SeparableSolution) -> Array:
        """The parameter vector (P,) of a solution."""
        return self.separable.law(state.nonlinear_values, state.coefficients)

    def _fast_periods(self, state: SeparableSolution) -> Array:
        """Periods per run of the fast waves, sum after sum, (f,)."""
        pairs = zip(self.relaxed.sums.values(), self._periods(state), strict=True)
        return np.concatenate(
            [sorted(f for w, f in zip(waves, own, strict=True) if w in self.fast) for waves, own in pairs]
        )

    def _assignments(self, state: SeparableSolution, tried: list[WaveSet]) -> list[tuple[float, ...]]:
        """Frequencies of the fast waves, in their order: every choice out of all that were found."""
        duration = self.separable.layout.span.duration
        seen = np.concatenate([*self._periods(state), *(w.periods for w in tried)])
        pool: list[float] = []
        for f in [*seen[seen > MIN_FAST_PERIODS], *MIXED_PERIODS]:
            if not any(abs(f - g) < SAME_WAVE_PERIODS for g in pool):
                pool.append(float(f))
        counts = [sum(w in self.fast for w in waves) for waves in self.relaxed.sums.values()]
        choices = product(*(combinations(pool, k) for k in counts))
        return [tuple(f / duration for part in choice for f in part) for choice in choices][:MAX_ASSIGNMENTS]

    def _first_places(self) -> list[int]:
        """Positions among the values of the shared parameter at which fast waves are searched first."""
        last = len(self.shared_values)
        return sorted({max(last - k, 0) for k in SCAN_PLACES_FROM_END})

    def _place_of(self, state: SeparableSolution) -> int:
        """Position of the value nearest to that of a solution."""
        shared = self.relaxed.shared
        value = self.relaxed.value(state.nonlinear_values, shared.name) if shared is not None else 1.0
        return int(np.argmin(np.abs(np.log(np.array(self.shared_values) / value))))

    def _fast_search(self, place: int) -> FastWaves:
        """The search for the fast waves at one value of the shared parameter."""
        if place not in self._fast_searches:
            value = self.shared_values[place]
            self._fast_searches[place] = FastWaves(self.relaxed, self.fast, value, self.slow.span)
        return self._fast_searches[place]

    def _no_waves(self) -> WaveSet:
        """The set without fast waves."""
        return WaveSet(VariableProjection(self.separable).start_values(), np.inf, np.zeros(0))

    @staticmethod
    def _promising(sets: list[WaveSet], most: int = MAX_WAVE_SETS) -> list[WaveSet]:
        """The best of every set of waves, best first."""
        chosen: list[WaveSet] = []
        for waves in sorted(sets, key=lambda w: w.misfit):
            near = waves.misfit <= MAX_RELAXED_MISFIT_RATIO * (chosen or sets)[0].misfit or not chosen
            if near and not any(waves.resembles(other, SAME_WAVE_PERIODS) for other in chosen):
                chosen.append(waves)
        return chosen[:most]

    def _with_slow_waves(
        self, problem: ProjectedProblem, waves: WaveSet, best: SeparableSolution | None, all_waves: bool = False
    ) -> SeparableSolution:
        """The best refined solution with these fast waves, or with `all_waves` with others near them."""
        for _, p in self.slow(waves.p, problem.data, all_waves)[: MAX_FINALISTS * (1 + all_waves)]:
            limit = np.inf if best is None else best.misfit
            state = problem.refine(problem.at(p), steps=MAX_STEPS, enough=ROUGH_MIN_FALL, below=limit)
            if state.misfit < limit:
                best = state
        assert best is not None
        return best


def _single_run(separable: SeparableModel, run: int, model: Model) -> SeparableModel:
    """The model of one run alone, without a level."""
    layout = separable.layout
    if len(layout.run_names) == 1 and model is layout.model:
        return separable
    absent = frozenset((e, 0) for e, r in layout.absent if r == run)
    alone = ParameterLayout(model, (layout.run_names[run],), (layout.spans[run],), absent)
    return SeparableModel(alone, [replace(b, run=0) for b in separable.blocks if b.run == run])


def _with_fixed_values(effect: Effect, found: dict[str, float]) -> Effect:
    """An effect with those non-linear parameters fixed that the runs share."""
    known = {q.name: found.get(f"{effect.name}.{q.name}") for q in effect.nonlinear if q.free}
    return effect.adjusted(**{name: {"fixed": value} for name, value in known.items() if value is not None})
