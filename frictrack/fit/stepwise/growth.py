"""Add an effect to a fitted model where its scan gains most, or remove one, and refine the other parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.effects import Effect
from frictrack.effects.models import Model
from frictrack.fit.least_squares import (
    LeastSquaresProblem,
    Solution,
    fit_with_scatter,
    refine,
    refit_with_scatter,
)
from frictrack.fit.linearised import LinearisedModel, linearise, measured_series
from frictrack.fit.pieces import Piece
from frictrack.fit.stepwise.trial import (
    EVENT_PARAMETERS,
    CandidateTrial,
    bic_penalty,
    deepen_trials,
    entry_order,
    model_without,
    refine_on_measured_motion,
    scan_effect,
    ties_are_resolved,
    try_effect,
)
from frictrack.records import Array

TRIAL_MIN_CHI2_FALL = 0.1  # smallest predicted fall of chi-squared; less does not change a ranking
TRIAL_MIN_EXCESS_SHARE = 1e-3  # the same as a share of the chi-squared beyond noise
SETTLING_STEPS = 2  # Gauss-Newton steps after which the starts of the motions belong to the law
TRIAL_MAX_STEPS = 16  # Gauss-Newton steps; the true effect needs fewer, a wrong one need not converge


def guess_coefficients(problem: LeastSquaresProblem) -> Array:
    """Compute first coefficients of a linear model by least squares on the smoothed acceleration.

    Parameters
    ----------
    problem : LeastSquaresProblem
        The problem of a model without scanned parameters.

    Returns
    -------
    array of shape (P,)
        Unknowns; friction levels one.

    """
    layout = problem.layout
    rows, right = [], []
    p = np.array([1.0 if s.effect == "level" else 0.0 for s in layout.slots])
    linear = [i for i, s in enumerate(layout.slots) if s.linear]
    for piece in problem.pieces:
        no_force = _acceleration(problem, piece, p)
        units = [_acceleration(problem, piece, p + np.eye(len(p))[i]) - no_force for i in linear]
        rows.append(np.stack(units, axis=1) if units else np.empty((len(no_force), 0)))
        right.append(piece.a_hat - piece.known - no_force)
    p[linear] = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=1e-8)[0]
    return p


def _acceleration(problem: LeastSquaresProblem, piece: Piece, p: Array) -> Array:
    """Acceleration (3 p,) that the model with unknowns p (P,) adds along the smoothed motion."""
    values, level = problem.layout.values(p, piece.run)
    return np.asarray(-problem.model.force(piece.path_at_nodes(piece.x_hat, piece.v_hat, level), values) / piece.mass)


def add_effect(solution: Solution, effect: Effect) -> Solution:
    """Add an effect to a fitted model.

    Without the effect that it lacks, a fitted model may not be integrable with the new one. In that case the effect
    is added before the scanned ones.

    Parameters
    ----------
    solution : Solution
        The fitted model.
    effect : Effect
        The effect to add.

    Returns
    -------
    Solution
        The larger model, refined as far as a trial needs; see `refine_to_end`.

    Raises
    ------
    FrictrackError
        If the runs lack what the effect needs, or the motion cannot be integrated.

    """
    without_scan, scanned = entry_order(solution.problem.model)
    try:
        return _add_effect(solution, effect)
    except FrictrackError:
        if not scanned:
            raise
    if not without_scan:
        raise FrictrackError(f"{effect.name} cannot be added to this law: its motion cannot be integrated")
    layout = replace(solution.problem.layout, model=Model(tuple(without_scan)), absent=frozenset())
    problem = solution.problem.rebuild(layout, solution.problem.pieces)
    grown_solution = fit_with_scatter(problem, guess_coefficients(problem), problem.first_starts())
    for e in [effect, *scanned] if ties_are_resolved(effect, without_scan) else [*scanned, effect]:
        grown_solution = _add_effect(grown_solution, e)
    return reorder_effects(grown_solution, Model((*solution.problem.model.effects, effect)))


def _add_effect(solution: Solution, effect: Effect) -> Solution:
    """Add an effect where it explains most along the measured motion, and refine as far as a trial needs."""
    linearised = linearise(solution)
    series = measured_series(linearised)
    scans = scan_effect(linearised, effect, series)
    if not scans:
        raise FrictrackError(effect.lacks([p.path for p in solution.problem.pieces]))
    trial = try_effect(linearised, effect, scans, series.coordinates[:, 0])
    return simulate_trial(linearised, deepen_trials(linearised, [trial])[0])


def simulate_trial(linearised: LinearisedModel, trial: CandidateTrial) -> Solution:
    """Refine a model with an effect on trial in simulation, from its values along the measured motion.

    Along the measured motion the other unknowns may have moved to where the law diverges or is led astray. There it
    begins at the model without the effect.

    Parameters
    ----------
    linearised : LinearisedModel
        The model without the effect.
    trial : CandidateTrial
        The effect on trial.

    Returns
    -------
    Solution
        The larger model.

    """
    model = linearised.solution
    problem, tau = model.problem.rebuild(trial.layout, model.problem.pieces), model.tau or 0.03
    starts = problem.first_starts()
    if problem.simulates:
        starts = [np.array([r.motion.x_edge[0], r.motion.v_edge[0]]) for r in model.responses]
        if model.problem.model.memory:  # its motion takes long to find from afar
            problem = problem.beginning_at(model.responses)
    try:
        first = refine(problem, trial.p, starts, tau=tau, max_steps=SETTLING_STEPS)
    except FrictrackError:
        first = None
    if first is None or first.objective > model.objective:
        first = _without_effect(problem, trial, model)
    frames = problem.n_frames
    excess = (trial.misfit - frames) / max(1.0, trial.misfit / max(frames, 1))  # in units of chi-squared per frame
    min_fall = max(TRIAL_MIN_CHI2_FALL, TRIAL_MIN_EXCESS_SHARE * excess)
    return _with_few_clocks(refit_with_scatter(first, tau, max_steps=TRIAL_MAX_STEPS, min_fall=min_fall), trial.effect)


def _with_few_clocks(solution: Solution, effect: Effect) -> Solution:
    """Remove clock errors of runs that do not need one: the others share the nominal clock.

    The model absorbs a common clock error of all runs. The run nearest to the median clock is therefore removed
    first.
    """
    penalty = bic_penalty(EVENT_PARAMETERS, solution.problem.n_frames)
    while effect.clock is not None:
        layout = solution.problem.layout
        rates = {s.run: float(p) for s, p in zip(layout.slots, solution.p, strict=True) if s.effect == effect.name}
        if len(rates) < 2:
            break
        middle = float(np.median([rates.get(r, 0.0) for r in range(len(layout.run_names))]))
        run = min(rates, key=lambda r: abs(rates[r] - middle))
        fewer_clocks = replace(layout, absent=layout.absent | {(effect.name, int(run or 0))})
        known_values = dict(zip(layout.names, solution.p, strict=True))
        problem = solution.problem.rebuild(fewer_clocks, solution.problem.pieces)
        p = np.array([known_values[n] - rates[run] * n.startswith(f"{effect.name}.") for n in fewer_clocks.names])
        found = fit_with_scatter(
            problem, p, solution.starts, solution.tau, max_steps=TRIAL_MAX_STEPS, min_fall=TRIAL_MIN_CHI2_FALL
        )
        if found.objective - solution.objective > penalty:
            break
        solution = found
    return solution


def _without_effect(problem: LeastSquaresProblem, trial: CandidateTrial, model: Solution) -> Solution:
    """The model without the effect on trial, with its coefficients refined."""
    layout, known = trial.layout, dict(zip(model.problem.layout.names, model.p, strict=True))
    own = [s.linear and s.effect == trial.effect.name for s in layout.slots]
    slots = zip(layout.names, trial.p, own, strict=True)
    p = np.array([known.get(name, 0.0 if removed else value) for name, value, removed in slots])
    problem = problem.beginning_at(model.responses)
    return refine(problem, p, model.starts, tau=model.tau or 0.03, free=layout.coefficients, max_steps=4)


def refine_to_end(solution: Solution) -> Solution:
    """Refine a model that `add_effect` has tried to convergence."""
    return refit_with_scatter(solution, solution.tau or 0.03)


def reorder_effects(solution: Solution, model: Model) -> Solution:
    """Return the same solution with the effects in the order of `model`."""
    old = solution.problem.layout
    made = {e.name: e for e in old.model.effects}
    ordered = tuple(replace(made[e.name], replaces=e.replaces) for e in model.effects)
    if ordered == old.model.effects:
        return solution
    layout = replace(old, model=Model(ordered))
    values = dict(zip(old.names, solution.p, strict=True))
    p = np.array([values[n] for n in layout.names])
    problem = solution.problem.rebuild(layout, solution.problem.pieces)
    problem = problem.beginning_at(solution.responses)  # a motion up to its stop may not be found again from afar
    return refine(problem, p, solution.starts, tau=solution.tau, max_steps=2)


def remove_effect(solution: Solution, name: str) -> Solution:
    """Remove an effect from a fitted model and refine the rest.

    Parameters
    ----------
    solution : Solution
        The fitted model.
    name : str
        Name of the effect.

    Returns
    -------
    Solution
        The smaller model.

    """
    old = solution.problem.layout
    absent = frozenset(pair for pair in old.absent if pair[0] != name)
    layout = replace(old, model=model_without(solution, name), absent=absent)
    values = dict(zip(old.names, solution.p, strict=True))
    problem = solution.problem.rebuild(layout, solution.problem.pieces)
    firsts = [np.array([values[n] for n in layout.names])]
    if problem.simulates:  # the rest takes over what it can of the effect
        firsts.append(refine_on_measured_motion(linearise(solution), layout, firsts[0]))
    found = []
    for p in firsts:
        try:
            found.append(refine(problem, p, solution.starts, tau=solution.tau or 0.03, max_steps=SETTLING_STEPS))
        except FrictrackError as error:
            failure = error
    if not found:
        raise failure
    first = min(found, key=lambda at: at.objective)
    return refit_with_scatter(first, first.tau, max_steps=TRIAL_MAX_STEPS)
