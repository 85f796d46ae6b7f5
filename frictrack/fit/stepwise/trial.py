"""Try an effect added to a fitted model: refine both along the measured motion, where coefficients are linear.

The whole model is fitted together with the effect, so strong and weak effects are judged alike. A trial takes
milliseconds. Several positions of the scan are tried, because the best grid point need not lead to the best fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.effects import Effect, Parameter
from frictrack.effects.models import Model
from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import CandidateScan, LinearisedModel, has_per_run_coefficients
from frictrack.fit.parameters import LEVEL, ParameterLayout
from frictrack.fit.penalties import SCATTER_BOUNDS
from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.projected import ProjectedProblem, SeparableSolution
from frictrack.fit.separable.varpro import VariableProjection
from frictrack.fit.stepwise.starts import EVENT_PARAMETERS, StartValues, bic_penalty, starts_of_scans
from frictrack.fit.uncertainty import describe_level_outliers
from frictrack.records import Array

MIN_RUNS_OF_LEVELS = 3  # two differ in one way, which any part of friction may imitate
MAX_SCATTER_ESTIMATES = 8  # of the scatter of the levels with a trial
# by which levels that start at one may explain less at first, at the scatter that hides the effect
MAX_START_LOSS = 4.0
MIN_CHI2_OF_LEVELS = 6.0  # by which other friction levels must explain more: evidence of 20 to 1
MAX_SCATTER_RATIO = 0.7  # scatter of the levels over that without the effect, below which it is estimated again
MAX_EXCESS_RATIO, MAX_EXCESS_CHI2 = 4.0, 40.0  # of the misfit that events leave to that of the best, and beyond it
MIN_SHARE_OF_BEST = 0.1  # of what the best effect explains, below which another one is not refined
ROUGH_STEPS, SET_STEPS, FINAL_STEPS = 4, 10, 25  # for every grid point, for a set of effects, and for the best two
ROUGH_MIN_FALL, SET_MIN_FALL, FINAL_MIN_FALL = 1e-3, 1e-4, 1e-6  # predicted fall of a step, share of the misfit


@dataclass(frozen=True, eq=False)
class CandidateTrial:
    """A model with one more effect: its layout, its unknowns p (P,) and its misfit along the measured motion.

    `tau` is the scatter of its friction levels; None if it is that of the model without the effect.
    """

    effect: Effect
    layout: ParameterLayout
    p: Array
    misfit: float
    tau: float | None = None


def try_effects(
    linearised: LinearisedModel, scanned: Sequence[tuple[Effect, list[CandidateScan]]], data: Array
) -> list[CandidateTrial]:
    """Fit a model with each of several effects along the measured motion, the most promising scan first.

    An effect that cannot come near the best of them is not refined further.

    Parameters
    ----------
    linearised : LinearisedModel
        The fitted model.
    scanned : sequence of (Effect, list of CandidateScan)
        The effects, each with its scans.
    data : array of shape (L,)
        Coordinates of the measured series in `linearised`.

    Returns
    -------
    list of CandidateTrial
        The best trial of every effect.

    """
    trials: list[CandidateTrial] = []
    misfit = baseline_misfit(linearised)
    for effect, scans in sorted(scanned, key=lambda own: -sum(float(s.gains.max()) for s in own[1])):
        trial = try_effect(linearised, effect, scans, data, below=_near_best(linearised, trials, misfit))
        trials.append(replace(trial, misfit=min(trial.misfit, misfit)))  # without the effect it has that
    return trials


def _near_best(linearised: LinearisedModel, trials: Sequence[CandidateTrial], misfit: float) -> float:
    """Misfit above which a trial does not come near the best one, which may need more unknowns."""
    # `misfit` is that of the model without any effect
    possible = [t for t in trials if not physical_objection(t.layout, t.p, t.effect)]
    if not possible:
        return np.inf
    frames = sum(len(b.data) for b in linearised.blocks)
    best = min(possible, key=lambda t: t.misfit)
    more = len(best.layout.slots) - len(linearised.solution.problem.layout.slots)
    excess = max(best.misfit - frames, 0.0)
    near = frames + MAX_EXCESS_CHI2 + MAX_EXCESS_RATIO * excess + bic_penalty(more, frames)
    return min(near, misfit - MIN_SHARE_OF_BEST * (misfit - best.misfit))


def try_effect(
    linearised: LinearisedModel,
    effect: Effect,
    scans: list[CandidateScan],
    data: Array,
    *,
    below: float = np.inf,
) -> CandidateTrial:
    """Fit a model with one more effect along the measured motion.

    One amplitude serves all runs, unless an amplitude per run lowers the BIC.

    Parameters
    ----------
    linearised : LinearisedModel
        The fitted model.
    effect : Effect
        The candidate.
    scans : list of CandidateScan
        Its scans.
    data : array of shape (L,)
        Coordinates of the measured series in `linearised`.
    below : float
        A fit ends where its misfit is not expected to fall below this value.

    Returns
    -------
    CandidateTrial
        The best trial.

    """
    runs = len(linearised.solution.problem.layout.run_names)
    amplitudes = {
        p.name: {"per_run": True} for p in effect.parameters if p.role in ("amplitude", "depth") and is_unconstrained(p)
    }
    shared = effect.single or not has_per_run_coefficients(effect) or runs == 1 or not amplitudes
    free = effect if shared else effect.adjusted(**amplitudes)
    free_amplitudes = _best_of_starts(linearised, free, *starts_of_scans(linearised, free, scans, data), below)
    if shared:
        return free_amplitudes
    count = len(amplitudes) * (runs - 1)
    limit = free_amplitudes.misfit + bic_penalty(count, linearised.solution.problem.n_frames)
    shared_amplitude = _with_shared_amplitude(linearised, free_amplitudes, effect, limit)
    return free_amplitudes if shared_amplitude.misfit > limit else shared_amplitude


def try_together(
    linearised: LinearisedModel,
    effects: Sequence[Effect],
    values: Mapping[tuple[str, str, int | None], float],
    absent: frozenset[tuple[str, int]] = frozenset(),
) -> CandidateTrial:
    """Fit a model with several more effects along the measured motion, from given values.

    Parameters
    ----------
    linearised : LinearisedModel
        The fitted model.
    effects : sequence of Effect
        The effects.
    values : mapping
        First values of all unknowns by effect, parameter and run (None for all runs).
    absent : frozenset of (str, int)
        Effects that are absent in a run.

    Returns
    -------
    CandidateTrial
        The trial of the last effect, its layout with all of them.

    """
    old = linearised.solution.problem.layout
    model = old.model
    for effect in effects:
        model = model + effect
    layout = replace(old, model=model, absent=old.absent | absent)
    problem = _projected_problem(linearised, layout)
    p = np.array([values.get((s.effect, s.parameter, s.run), 1.0 if s.effect == LEVEL else 0.0) for s in layout.slots])
    state = problem.refine(problem.at(p), steps=SET_STEPS, enough=SET_MIN_FALL)
    return _trial(effects[-1], problem, state)


def physical_objection(layout: ParameterLayout, p: Array, effect: Effect) -> str:
    """Return the effect's own objection to its fitted values, if it holds in every run in which it acts."""
    if effect.plausible is None:
        return ""
    found = []
    for run in range(len(layout.run_names)):
        values, _ = layout.values(p, run)
        if effect.name not in values or (effect.name, run) in layout.absent:
            continue
        span = layout.spans[run] if any(p.per_run for p in effect.parameters if p.linear) else layout.span
        found.append(effect.plausible(values[effect.name], span))
    return found[0] if found and all(found) else ""


def with_levels(
    linearised: LinearisedModel, trials: Sequence[CandidateTrial], misfit: float
) -> Sequence[CandidateTrial]:
    """Return trials, best first, with the most likely levels of those that come near the best with them.

    `misfit` is that of the model without any effect.
    """
    out: list[CandidateTrial] = []
    for trial in sorted(trials, key=lambda t: t.misfit):
        below = _near_best(linearised, out, misfit)
        out.append(with_likely_levels(linearised, trial, below) if trial.misfit < below else trial)
    return out


def can_choose_levels(layout: ParameterLayout, p: Array) -> bool:
    """Return whether enough runs have levels that tell what they multiply; none whose mass or clock may be wrong."""
    levels = p[layout.levels]
    is_off = any(describe_level_outliers(layout.run_names, levels, np.zeros((len(levels), len(levels)))))
    return len(levels) >= MIN_RUNS_OF_LEVELS and not is_off


def with_likely_levels(linearised: LinearisedModel, trial: CandidateTrial, below: float = np.inf) -> CandidateTrial:
    """Return a trial in which the friction levels of the runs multiply those parts that leave the least misfit.

    Nobody knows whether what changes the dry friction of a run changes its viscous friction too, or a patch. Where a
    law assumes the wrong one, effects imitate what is left. All such laws have equally many parameters. One that is
    not expected to fall below `below` is not refined.
    """
    best = trial
    while can_choose_levels(best.layout, best.p):
        other = _with_other_level(linearised, best, below)
        if other.misfit > best.misfit - MIN_CHI2_OF_LEVELS:
            return best
        best = other
    return best


def likely_levels(linearised: LinearisedModel) -> CandidateTrial:
    """Return the model itself, without an effect more, with the friction levels that leave the least misfit."""
    solution, layout = linearised.solution, linearised.solution.problem.layout
    own = CandidateTrial(layout.model.effects[0], layout, solution.p, baseline_misfit(linearised))
    return with_likely_levels(linearised, own)


def _with_other_level(linearised: LinearisedModel, trial: CandidateTrial, below: float) -> CandidateTrial:
    """The best trial in which another effect follows the friction levels, or no longer does; refined if it promises."""
    layout, problem, p = trial.layout, _projected_problem(linearised, trial.layout), trial.p.copy()
    p[layout.levels] = 1.0  # they mean something else then
    start = problem.at(p)
    rough: list[tuple[SeparableSolution, ParameterLayout]] = []
    for changed in (e for e in layout.model.effects if e.may_follow_level):
        effects = tuple(e.with_other_level() if e is changed else e for e in layout.model.effects)
        other = replace(layout, model=Model(effects))
        if len(other.slots) == len(p):  # something is left that the levels multiply, as before
            toggled = problem.with_other_level(changed.name)
            state = toggled.refine(toggled.solved_again(start), (), steps=ROUGH_STEPS, enough=ROUGH_MIN_FALL)
            state = toggled.refine(state, steps=ROUGH_STEPS, enough=ROUGH_MIN_FALL)
            rough.append((state, other))
    if not rough:
        return trial
    state, other = min(rough, key=lambda one: one[0].misfit)
    problem, below = _projected_problem(linearised, other), min(below, trial.misfit - MIN_CHI2_OF_LEVELS)
    state = problem.at(state.nonlinear_values)
    return _trial(trial.effect, problem, problem.refine(state, steps=SET_STEPS, enough=SET_MIN_FALL, below=below))


def refine_on_measured_motion(linearised: LinearisedModel, layout: ParameterLayout, p: Array) -> Array:
    """Return the unknowns (P,) of another model of the same runs, refined along the measured motion from `p`."""
    problem = _projected_problem(linearised, layout)
    state = _refined(problem, problem.at(p))
    return np.clip(problem.separable.law(state.nonlinear_values, state.coefficients), *layout.bounds)


def baseline_misfit(linearised: LinearisedModel) -> float:
    """Compute the misfit of the model itself along the measured motion."""
    problem = _projected_problem(linearised, linearised.solution.problem.layout)
    return _refined(problem, problem.at(np.array(linearised.solution.p))).misfit


def with_smaller_scatter(linearised: LinearisedModel, trial: CandidateTrial) -> tuple[CandidateTrial, float]:
    """Return a trial with the scatter of the friction levels estimated with its effect, and what it gains by that.

    A trial keeps the scatter of the model without the effect. Of an effect that explains why runs differ, that hides
    nearly all: the levels would need no scatter. The scatter that is left is estimated from the levels, and again from
    those that it leaves, since levels that may scatter share what runs differ in with the effect.

    Parameters
    ----------
    linearised : LinearisedModel
        The model without the effect.
    trial : CandidateTrial
        The effect on trial.

    Returns
    -------
    trial : CandidateTrial
        The trial with that scatter and the unknowns there, from which it is simulated; its misfit stays.
    gain : float
        Fall of minus twice the log-likelihood, levels integrated out.

    """
    solution = linearised.solution
    if not solution.levels_are_random:
        return trial, 0.0
    if not trial.layout.levels:
        return trial, solution.scatter_penalty(solution.tau)
    gain, best, tau = 0.0, trial, solution.tau
    for _ in range(MAX_SCATTER_ESTIMATES):
        problem, p = _projected_problem(linearised, best.layout, tau), np.array(best.p)
        p[best.layout.levels] = 1.0  # from the trial's own levels, a curved valley leads to this in tiny steps
        groups = () if tau == solution.tau else None  # the levels alone, at the scatter of the trial
        state = problem.refine(problem.at(p), groups, steps=SET_STEPS, enough=SET_MIN_FALL)
        fall = trial.misfit - state.misfit + solution.scatter_penalty(solution.tau) - solution.scatter_penalty(tau)
        if fall < gain - MAX_START_LOSS:
            break
        gain, best = max(fall, gain), replace(_trial(trial.effect, problem, state), tau=tau)
        left = float(np.clip(np.sqrt(np.mean((best.p[best.layout.levels] - 1) ** 2)), *SCATTER_BOUNDS))
        if left > MAX_SCATTER_RATIO * tau:
            break
        tau = left
    return replace(trial, p=best.p, tau=best.tau), gain


def most_by_smaller_scatter(solution: Solution) -> float:
    """Compute the most that any effects can gain as in `with_smaller_scatter`: friction levels need no scatter."""
    if not solution.levels_are_random:
        return 0.0
    return solution.scatter_penalty(solution.tau) - solution.scatter_penalty(SCATTER_BOUNDS[0])


def misfit_left_by_other(linearised: LinearisedModel, true: CandidateTrial, other: CandidateTrial) -> float:
    """Compute the chi-squared that another effect leaves of data made by a true one, along the measured motion.

    Parameters
    ----------
    linearised : LinearisedModel
        The model without either effect.
    true, other : CandidateTrial
        The effect that makes the data, and the one that is fitted to them.

    Returns
    -------
    float
        Expected difference of chi-squared between the two.

    """
    true_problem, other_problem = (_projected_problem(linearised, t.layout) for t in (true, other))
    ideal = true_problem.data - true_problem.at(np.array(true.p)).residual
    true_problem, other_problem = true_problem.for_data(ideal), other_problem.for_data(ideal)
    found = other_problem.refine(other_problem.at(np.array(other.p)), steps=FINAL_STEPS, enough=ROUGH_MIN_FALL)
    return found.misfit - true_problem.at(np.array(true.p)).misfit


class TiedSeparableModel(SeparableModel):
    """A separable model in which waves share their amplitude between runs. Their phases are then non-linear."""

    def is_sinusoid(self, effect: Effect) -> bool:
        """Return whether quadratures are linear: not if runs share an amplitude and have their own phases."""
        own = {p.per_run for p in effect.parameters if p.role in ("amplitude", "phase")}
        return super().is_sinusoid(effect) and (len(own) == 1 or len(self.runs) == 1)


def _projected_problem(
    linearised: LinearisedModel, layout: ParameterLayout, tau: float | None = None
) -> ProjectedProblem:
    separable = TiedSeparableModel(layout, linearised.blocks)
    tau, budget = tau or linearised.solution.tau or 0.03, linearised.solution.problem.budget
    return ProjectedProblem(separable, separable.data, tau, budget)


def _best_of_starts(
    linearised: LinearisedModel,
    effect: Effect,
    starts: Sequence[StartValues],
    absent: frozenset[tuple[str, int]],
    below: float,
) -> CandidateTrial:
    """The best of the fits from several starts."""
    old = linearised.solution.problem.layout
    layout = replace(old, model=old.model + effect, absent=old.absent | absent)
    problem = _projected_problem(linearised, layout)
    own_groups = [g for g, group in enumerate(problem.separable.groups) if effect.name in group.names]
    known = old.by_address(linearised.solution.p)
    first: SeparableSolution | None = None
    found = []
    for values in starts:
        new = [1.0 if s.effect == LEVEL else values.get((s.parameter, s.run), 0.0) for s in layout.slots]
        p = layout.unknowns(known, np.array(new))
        state = problem.at(p) if first is None else problem.at(p, first, own_groups)  # the rest is the same
        first = first or state
        # friction levels first: until they give back what they took up of the effect, it has no size to refine
        state = problem.refine(state, (), steps=ROUGH_STEPS, enough=ROUGH_MIN_FALL)
        found.append(problem.refine(state, steps=ROUGH_STEPS, enough=ROUGH_MIN_FALL, below=below))
    found.sort(key=lambda state: state.misfit)
    best = _refined(problem, found[0], below)
    if best.misfit < below:
        for state in found[1:2]:
            best = min(best, _refined(problem, state, below=best.misfit), key=lambda state: state.misfit)
    return _trial(effect, problem, best)


def _with_levels_at_one(problem: ProjectedProblem, state: SeparableSolution) -> list[SeparableSolution]:
    """The same start with all friction levels at one: those of the model without the effect may imitate it."""
    p, levels = problem.separable.law(state.nonlinear_values, state.coefficients), problem.layout.levels
    if len(levels) < 2:
        return []
    p[levels] = 1.0
    return [problem.refine(problem.at(p), steps=ROUGH_STEPS, enough=ROUGH_MIN_FALL)]


def deepen_trials(
    linearised: LinearisedModel, trials: list[CandidateTrial], *, every: bool = True
) -> list[CandidateTrial]:
    """Search trials again with all quick scans repeated, those of the model too.

    A model that lacks something imitates it with what it has, such as a Stribeck velocity far from the true one: no
    small step from there leads to the law with the effect. Events of single runs were found one by one, in a model that
    lacked them all; those that may be best are found again together.

    Parameters
    ----------
    linearised : LinearisedModel
        The fitted model.
    trials : list of CandidateTrial
        First trials.
    every : bool
        Whether those far behind the best are searched again, too.

    Returns
    -------
    list of CandidateTrial
        The trials, best first.

    """
    near = _near_best(linearised, trials, baseline_misfit(linearised))
    trials = [_with_own_events(linearised, t) if t.effect.single and t.misfit < near else t for t in trials]
    again = (_search_again(linearised, t, t.misfit < near) if every or t.misfit < near else t for t in trials)
    return sorted(again, key=lambda t: t.misfit)


def _search_again(linearised: LinearisedModel, trial: CandidateTrial, is_near: bool) -> CandidateTrial:
    """A trial with the positions of all quickly scanned effects exchanged; near the best, with levels of one too."""
    problem = _projected_problem(linearised, trial.layout)
    search, found = VariableProjection(problem.separable, problem.tau), problem.at(trial.p)
    starts = [found, *(_with_levels_at_one(problem, found) if is_near else [])]
    ends = [_refined(problem, search.exchange_positions(problem, start, "")) for start in starts]
    return _trial(trial.effect, problem, min(ends, key=lambda one: one.misfit))


def _with_own_events(linearised: LinearisedModel, trial: CandidateTrial) -> CandidateTrial:
    """A trial with events searched jointly in all runs, kept where they gain more than their penalty."""
    name, penalty = trial.effect.name, bic_penalty(EVENT_PARAMETERS, linearised.solution.problem.n_frames)
    layout = replace(trial.layout, absent=linearised.solution.problem.layout.absent)
    problem = _projected_problem(linearised, layout)
    search = VariableProjection(problem.separable, problem.tau)
    p = layout.unknowns(trial.layout.by_address(trial.p), search.start_values())
    state = search.restart_effect(problem, problem.at(p), name)
    found = layout.by_address(problem.separable.law(state.nonlinear_values, state.coefficients))
    removed = {pair for pair in search.unneeded_events(state, penalty) if pair[0] == name}
    kept = replace(layout, absent=layout.absent | removed)
    problem = _projected_problem(linearised, kept)
    state = _refined(problem, problem.at(kept.unknowns(found)))
    new = _trial(trial.effect, problem, state)
    return min(new, trial, key=lambda t: t.misfit + penalty * len(t.layout.slots))


def _refined(problem: ProjectedProblem, state: SeparableSolution, below: float = np.inf) -> SeparableSolution:
    return problem.refine(state, steps=FINAL_STEPS, enough=FINAL_MIN_FALL, below=below)


def _trial(effect: Effect, problem: ProjectedProblem, state: SeparableSolution) -> CandidateTrial:
    layout = problem.layout
    p = problem.separable.law(state.nonlinear_values, state.coefficients)
    return CandidateTrial(effect, layout, np.clip(p, *layout.bounds), state.misfit)


def _with_shared_amplitude(
    linearised: LinearisedModel, free_amplitudes: CandidateTrial, effect: Effect, limit: float
) -> CandidateTrial:
    """The same effect with one amplitude for all runs, started at the mean; refined while it may reach a misfit."""
    old = free_amplitudes.layout
    effects = tuple(effect if e.name == effect.name else e for e in old.model.effects)
    layout = replace(old, model=replace(old.model, effects=effects))
    problem = _projected_problem(linearised, layout)
    p = layout.unknowns(old.by_address(free_amplitudes.p))
    return _trial(effect, problem, _refined(problem, problem.at(p), limit))


def is_unconstrained(p: Parameter) -> bool:
    """Return whether a parameter is free and has no prior."""
    return p.free and p.prior is None
