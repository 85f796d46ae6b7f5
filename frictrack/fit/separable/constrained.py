"""Fit models with waves of a common amplitude, such as ATM2: free amplitudes first, then constrained ones.

The effect defines its relaxed form: waves of free amplitude, which are linear, and its other columns. Parameters that
several parts share, such as v_s, are tried at a few values. Slow waves of two sums are confused with each other and
with everything smooth. They are scanned together over frequency and phase, with their common amplitudes. The run with
the most frames is solved first; the other runs add only their own parameters.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from frictrack.effects import Effect, Parameter, Span
from frictrack.fit.parameters import ParameterLayout, known_value
from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.newton import ProjectedProblem, SeparableSolution
from frictrack.fit.separable.relaxed import RelaxedWaves
from frictrack.fit.separable.varpro import VariableProjection
from frictrack.models import Model
from frictrack.records import Array

SCAN_PLACES_FROM_END = (3, 6, 8)  # grid points from the end of the shared parameter's scan at which waves are searched
LAST_VALUES = 10  # last grid points of that scan, at which slow waves are searched
MAX_WAVE_SETS = 4  # sets of waves that are refined with common amplitudes
MAX_RELAXED_MISFIT_RATIO = 1.5  # times the best misfit; relaxed fits beyond have the wrong waves
MAX_SLOW_PLACES = 5  # start positions of two slow waves
MAX_SLOW_PLACES_AGAIN = 8  # the same beside the best fit
FIRST_STEPS, MAX_STEPS = 4, 30  # steps before a trial may be given up, and in all
MAX_MISFIT_RATIO = 4.0  # times the best misfit beyond which a trial is given up
ROUGH_MIN_FALL = 1e-4  # predicted fall of a step, share of the misfit, during comparisons
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
        self.single = {r: _single_run(separable, r, separable.layout.model) for r in self.runs}
        first = self.single[self.runs[0]]
        shared = _shared_values(separable.layout, self.effect)
        last = len(shared)
        start_places = {max(last - k, 0) for k in SCAN_PLACES_FROM_END}
        scanned = sorted(start_places | set(range(max(last - LAST_VALUES, 0), last)))
        self.relaxed = [RelaxedWaves(first, self.effect, shared[i]) for i in scanned]
        self.slow_wave_positions = [r for i, r in zip(scanned, self.relaxed, strict=True) if i in start_places]

    def __call__(self, data: Array | None = None) -> SeparableSolution:
        """Return the best solution for data (M,); default those of the blocks."""
        data = self.separable.data if data is None else data
        state = self._fit_longest_run(self._data_of_run(self.runs[0], data))
        first = self.single[self.runs[0]]
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
        effect = next(e for e in fixed_model.effects if e.relaxed)
        shared_values = {
            name: found.get(f"{effect.name}.{name}", v) for name, v in self.relaxed[0].shared_values.items()
        }
        relaxed = RelaxedWaves(separable, effect, shared_values)
        _, p = min(relaxed.free_amplitude_fits(data), key=lambda law: law[0])
        state = self._best_refined(
            ProjectedProblem(separable, data), [p, *(q for _, q in relaxed.slow_wave_positions(p, data))], None
        )
        return dict(zip(separable.layout.names, separable.law(state.nonlinear_values, state.coefficients), strict=True))

    def _data_of_run(self, run: int, data: Array) -> Array:
        """The data of one run."""
        pairs = zip(self.separable.blocks, self.separable.slices, strict=True)
        return np.concatenate([data[s] for block, s in pairs if block.run == run])

    def _fit_longest_run(self, data: Array) -> SeparableSolution:
        """The solution of the run with the most frames."""
        first = self.single[self.runs[0]]
        problem = ProjectedProblem(first, data)
        best: SeparableSolution | None = None
        for misfit, p in self._start_values(data):
            if best is not None and misfit > MAX_RELAXED_MISFIT_RATIO * best.misfit:
                break
            best = self._best_refined(problem, [p, *self._other_slow_positions(p, data)[:MAX_SLOW_PLACES]], best)
        assert best is not None
        p = first.law(best.nonlinear_values, best.coefficients)
        for q in [p, *self.relaxed[0].with_waves_exchanged(p)]:
            best = self._best_refined(problem, self._other_slow_positions(q, data)[:MAX_SLOW_PLACES_AGAIN], best)
        return problem.refine(best, steps=MAX_STEPS)

    def _start_values(self, data: Array) -> list[tuple[float, Array]]:
        """Misfits and parameter vectors (P,) of the best relaxed fits, the best one of every set of waves."""
        found = sorted(
            (law for r in self.slow_wave_positions for law in r.free_amplitude_fits(data)), key=lambda law: law[0]
        )
        chosen: list[tuple[float, Array]] = []
        for misfit, p in found:
            periods = self.relaxed[0].fast_periods(p)
            if all(np.any(np.abs(periods - self.relaxed[0].fast_periods(q)) > SAME_WAVE_PERIODS) for _, q in chosen):
                chosen.append((misfit, p))
        return chosen[:MAX_WAVE_SETS]

    def _other_slow_positions(self, p: Array, data: Array) -> list[Array]:
        """Parameter vectors (P,) with the slowest waves of two sums at other positions, most promising first."""
        found = [place for r in self.relaxed for place in r.slow_wave_positions(p, data)]
        costs = np.array([c for c, _ in found])
        return [found[i][1] for i in np.argsort(costs)]

    def _best_refined(
        self, problem: ProjectedProblem, trials: Iterable[Array], best: SeparableSolution | None
    ) -> SeparableSolution:
        """The best refined trial; trials that stay far behind are given up early."""
        for p in trials:
            state = problem.refine(problem.at(p), steps=FIRST_STEPS, enough=ROUGH_MIN_FALL)
            if best is not None and state.misfit > MAX_MISFIT_RATIO * best.misfit:
                continue
            limit = np.inf if best is None else best.misfit
            state = problem.refine(state, steps=MAX_STEPS, enough=ROUGH_MIN_FALL, below=limit)
            if best is None or state.misfit < best.misfit:
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


def _shared_values(layout: ParameterLayout, effect: Effect) -> list[dict[str, float]]:
    """Values to try for the parameters that several parts share."""
    shared = [q for q in effect.nonlinear if sum(q.name in part.names for part in effect.relaxed) > 1]
    axes = [_values_to_try(q, layout.span) for q in shared]
    return [dict(zip((q.name for q in shared), map(float, values), strict=True)) for values in product(*axes)]


def _values_to_try(q: Parameter, span: Span) -> Sequence[float]:
    """Values to try for one parameter: its known value, or its scan."""
    known = known_value(q, span)
    if known is not None:
        return [known]
    return [1.0] if q.scan is None else list(q.scan(span))
