"""Fit displacements from scratch, and add an effect to a fitted model or remove one.

From scratch, variable projection along the measured motion gives the start, output-error Gauss-Newton the result. If
that leaves more than noise, the last effect is added to a fit of the others, where its scan gains most. Where no such
motion can be integrated, all effects with a scan are added so, one by one.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from frictrack.base.errors import FrictrackError, result_or_none
from frictrack.effects import Effect
from frictrack.effects.models import Model
from frictrack.fit.cutting import MIN_FRAMES, cut_into_pieces
from frictrack.fit.least_squares import (
    LeastSquaresProblem,
    PieceResponse,
    Solution,
    fit_with_scatter,
    refine,
    refit_with_scatter,
)
from frictrack.fit.linearised import LinearisedModel, has_per_run_coefficients, linearise, measured_series
from frictrack.fit.parameters import LEVEL
from frictrack.fit.pieces import Piece, displacement_rows, without_starts
from frictrack.fit.separable.common_amplitudes import variable_projection
from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.projected import ProjectedProblem
from frictrack.fit.separable.varpro import is_scannable
from frictrack.fit.stepwise.starts import (
    EVENT_PARAMETERS,
    bic_penalty,
    entry_order,
    model_without,
    reversed_ties,
    scan_effect,
    ties_are_resolved,
)
from frictrack.fit.stepwise.trial import (
    CandidateTrial,
    deepen_trials,
    is_unconstrained,
    refine_on_measured_motion,
    try_effect,
)
from frictrack.records import Array, Mask
from frictrack.simulate.dynamics import NOT_INTEGRATED

MAX_SETTINGS_TRIED = 600  # grid points tried
MAX_REFINEMENTS = 30  # function evaluations beyond the grid
WINDOWS_PER_PIECE = 4  # of the longest piece, in which grid points are compared
FIRST_SEGMENT_FRAMES = 128  # frames of the first, shortest stretches
STEPS_PER_LENGTH = 6  # Gauss-Newton steps per length
STOP_MARGIN_FRAMES = 2.0  # frames left out before a stop
GOOD_CHI2_PER_FRAME = 1.15  # chi-squared per frame below which no second start is tried
# Misfit in simulation over that along the measured motion: they agree within 1 %, whether an effect is missing or not.
MAX_RISE_IN_SIMULATION = 1.2
MAX_REVERSAL_SEGMENTS = 16  # segments used for the first fit of a long record with reversals
COEFFICIENT_SHARES = (1.0, 0.5, 0.2, 0.0)  # factors on start coefficients, until the motion does not diverge
TRIAL_MIN_CHI2_FALL = 0.1  # smallest predicted fall of chi-squared; less does not change a ranking
TRIAL_MIN_EXCESS_SHARE = 1e-3  # the same as a share of the chi-squared beyond noise
SETTLING_STEPS = 4  # Gauss-Newton steps after which the starts of the motions belong to the law
TRIAL_MAX_STEPS = 16  # Gauss-Newton steps; the true effect needs fewer, a wrong one need not converge


def fit_displacement(model: Model, pieces: list[Piece], names: tuple[str, ...], fps: float) -> Solution:
    """Fit a model to displacements from scratch; the best result is returned where several ways are tried.

    Parameters
    ----------
    model : Model
        The model.
    pieces : list of Piece
        Pieces of all runs.
    names : tuple of str
        Names of the runs.
    fps : float
        Frame rate, 1/s.

    Returns
    -------
    Solution
        The fit.

    Raises
    ------
    FrictrackError
        If no effect is linear without a scan, or no motion can be integrated.

    """
    pieces = [p.with_clock(1.0) for p in pieces]  # pieces drawn from a fit may have its clock rate
    of = pieces, names, fps
    LeastSquaresProblem.of(model, *of)  # raises where the runs lack what an effect needs
    if any(p.turns for p in pieces):
        return _through_reversals(model, *of)
    found: list[Solution] = []
    reached = False
    for tied in (model, *reversed_ties(model)):
        with suppress(FrictrackError):  # its motion cannot be integrated; another way may work
            found.append(_with_ties_of(_by_variable_projection(tied, *of), model))
        if reached := any(s.chi2 < GOOD_CHI2_PER_FRAME * s.problem.n_frames for s in found):
            break
    *rest, last = model.effects
    if rest and not reached and not _is_found_in_simulation(last) and all(ties_are_resolved(e, rest) for e in rest):
        with suppress(FrictrackError):  # the last may find what all together miss
            linearised, trial = _tried(_by_variable_projection(Model(tuple(rest)), *of), _alone(last))
            if all(trial.misfit < s.objective for s in found):
                apart = simulate_trial(linearised, trial)
                if all(apart.objective < s.objective for s in found):
                    found = [refine_to_end(reorder_effects(apart, model))]
    return refit_until_stop(min(found, key=lambda s: s.objective) if found else _by_growth(model, *of))


def _is_found_in_simulation(effect: Effect) -> bool:
    """Whether an effect cannot be scanned, or is a clock error, which few runs have."""
    return effect.clock is not None or not is_scannable(effect)


def _problem_of(effects: list[Effect], pieces: list[Piece], names: tuple[str, ...], fps: float) -> LeastSquaresProblem:
    """The problem of some effects over all pieces."""
    if not effects:
        raise FrictrackError("expected an effect without a scan, such as coulomb, in the model to start from")
    return LeastSquaresProblem.of(Model(tuple(effects)), pieces, names, fps)


def _by_variable_projection(model: Model, pieces: list[Piece], names: tuple[str, ...], fps: float) -> Solution:
    """The fit that variable projection starts; effects that it cannot scan are added afterwards."""
    later = [e for e in entry_order(model)[1] if _is_found_in_simulation(e)]
    problem = _problem_of([e for e in model.effects if e not in later], pieces, names, fps)
    blocks = problem.blocks
    separable = SeparableModel(problem.layout, blocks)
    search = variable_projection(separable)
    state = search()
    if absent := search.unneeded_events(state, bic_penalty(EVENT_PARAMETERS, separable.size)):
        known = search.separable.layout.by_address(state.nonlinear_values)
        problem = problem.rebuild(replace(problem.layout, absent=absent))
        separable = SeparableModel(problem.layout, blocks)
        projected = ProjectedProblem(separable, separable.data)
        state = projected.refine(projected.at(problem.layout.unknowns(known)))
    solution = _with_free_amplitudes(_refine_shrunk(problem, separable.law(state.nonlinear_values, state.coefficients)))
    if solution.objective > MAX_RISE_IN_SIMULATION * state.misfit:  # its own motion leads elsewhere
        with suppress(FrictrackError):
            solution = min(solution, _by_growth(solution.problem.model, pieces, names, fps), key=lambda s: s.objective)
    return _add_later(solution, model, later)


def _refine_shrunk(problem: LeastSquaresProblem, p: Array) -> Solution:
    """The fit refined from p (P,), or from a share of its coefficients where the motion cannot be integrated."""
    # along the measured motion a model that lacks an effect may have coefficients with which its own motion diverges
    linear = np.array([s.linear for s in problem.layout.slots])
    for share in COEFFICIENT_SHARES:
        with suppress(FrictrackError):
            return fit_with_scatter(problem, np.where(linear, share * p, p), problem.first_starts())
    raise FrictrackError(NOT_INTEGRATED)


def _with_free_amplitudes(solution: Solution) -> Solution:
    """One amplitude for all runs, or one per run where that lowers the BIC, wave after wave."""
    runs = len(solution.problem.layout.run_names)
    for effect in solution.problem.model.effects if runs > 1 else ():
        own = [p for p in effect.parameters if p.role == "amplitude" and is_unconstrained(p) and not p.per_run]
        if not own or not has_per_run_coefficients(effect):
            continue
        old = solution.problem.layout
        free = effect.adjusted(**{p.name: {"per_run": True} for p in own})
        layout = replace(old, model=Model(tuple(free if e is effect else e for e in old.model.effects)))
        p = layout.unknowns(old.by_address(solution.p))
        freed = fit_with_scatter(solution.problem.rebuild(layout), p, solution.starts, solution.tau)
        if solution.objective - freed.objective > bic_penalty(len(own) * (runs - 1), solution.problem.n_frames):
            solution = freed
    return solution


def _by_growth(model: Model, *of: Any) -> Solution:
    """The fit to which effects are added one after the other."""
    first, later = entry_order(model)
    problem = _problem_of(first, *of)
    return _one_after_the_other(problem, _linear_guess(problem), model, later)


def _one_after_the_other(problem: LeastSquaresProblem, p: Array, model: Model, later: list[Effect]) -> Solution:
    """The fit of a first problem from p (P,), and then of the later effects of a model."""
    return _add_later(_refine_shrunk(problem, p), model, later)


def _with_ties_of(solution: Solution, model: Model) -> Solution:
    """The fit under the ties of `model`, refined from values found under other ties."""
    old = solution.problem.layout
    changes = {e.name: _changed_ties(old.effect(e.name), e) for e in model.effects}
    if not any(changes.values()):
        return solution
    layout = replace(old, model=Model(tuple(old.effect(name).adjusted(**own) for name, own in changes.items())))
    each = [old.values(solution.p, run) for run in range(len(old.run_names))]
    p = [each[s.run or 0][1] if s.effect == LEVEL else each[s.run or 0][0][s.effect][s.parameter] for s in layout.slots]
    return fit_with_scatter(solution.problem.rebuild(layout), np.array(p), solution.starts, solution.tau or 0.03)


def _changed_ties(fitted: Effect, wanted: Effect) -> dict[str, dict[str, Any]]:
    """Tie and fixed value of the parameters of an effect whose tie is to be another one."""
    changed = [p for p in wanted.parameters if p.tie != fitted.parameter(p.name).tie]
    return {p.name: {"tie": p.tie, "fixed": p.fixed} for p in changed}


def _through_reversals(model: Model, pieces: list[Piece], names: tuple[str, ...], fps: float) -> Solution:
    """The fit of runs with stops and reversals; with very many segments, on some of them first."""
    subset = pieces[:: -(-len(pieces) // MAX_REVERSAL_SEGMENTS)]
    if {p.run for p in subset} != {p.run for p in pieces}:
        subset = pieces
    start_effects, later = split_start_effects(model)
    problem = _problem_of(start_effects, subset, names, fps)
    guess = shoot_lengthening if any(p.gain for p in subset) else best_on_grid
    found = _one_after_the_other(problem, guess(problem), model, later)
    if len(subset) == len(pieces):
        return found
    # few segments may show no scatter of the levels, and their law may not drive the others
    return _refine_shrunk(found.problem.rebuild(found.problem.layout, pieces), found.p)


def _add_later(solution: Solution, model: Model, later: list[Effect]) -> Solution:
    """Add the later effects of a model to the fit of the others, and refine to convergence."""
    for effect in later:  # refined as far as a trial needs
        solution = add_effect(solution, _alone(effect))
    return refine_to_end(reorder_effects(solution, model)) if later else solution


def _alone(effect: Effect) -> Effect:
    """An effect that replaces no other: the model names both."""
    return replace(effect, replaces=frozenset())


def refit_until_stop(solution: Solution, free: Mask | None = None) -> Solution:
    """Refit without the frames in which the model's own motion has stopped, or is within two frames of its stop.

    The smoothed velocity changes sign too late at a stop; the simulated one does not.

    Parameters
    ----------
    solution : Solution
        The fit.
    free : array of bool, shape (P,), optional
        Unknowns that may change; default all, with the scatter of the levels.

    Returns
    -------
    Solution
        The fit to the shorter pieces; the given one if the motion cannot be integrated along these.

    """
    for _ in range(2 if solution.problem.simulates else 0):
        kept = [_frames_before_stop(r) for r in solution.responses]
        pieces = solution.problem.pieces
        if all(n == len(p.t) for n, p in zip(kept, pieces, strict=True)):
            break
        shorter = [p.part(0, n) for n, p in zip(kept, pieces, strict=True)]
        problem = solution.problem.rebuild(solution.problem.layout, shorter)
        with suppress(FrictrackError):  # the motion under a law that lacks much cannot be integrated everywhere
            if free is None:
                solution = fit_with_scatter(problem, solution.p, solution.starts, solution.tau or 0.03)
            else:
                solution = refine(problem, solution.p, solution.starts, tau=solution.tau, free=free)
    return solution


def _frames_before_stop(response: PieceResponse) -> int:
    """Frames of a piece before the stop of the simulated motion."""
    piece, motion = response.piece, response.motion
    if piece.turns:
        return len(piece.t)
    speed = (piece.path.s[0] * motion.v_edge)[piece.at]
    slowing = -np.gradient(speed, piece.t)  # a mass that starts is slow too, but accelerates
    near_stop = np.flatnonzero((slowing > 0) & (speed < STOP_MARGIN_FRAMES * slowing * np.gradient(piece.t)))
    after = near_stop[near_stop >= MIN_FRAMES]
    return int(after[0]) if len(after) else len(piece.t)


def split_start_effects(model: Model) -> tuple[list[Effect], list[Effect]]:
    """Split effects: those without a scan start together, with modifiers and what they modify; the others are later."""
    reshaped = [changed for e in model.effects if e.turns for changed in e.changed(model.effects)]
    start_effects = [e for e in model.effects if e.turns or e in reshaped or not any(p.free for p in e.nonlinear)]
    return start_effects, [e for e in model.effects if e not in start_effects]


# --- first values, by linear least squares along the smoothed motion


def _linear_guess(problem: LeastSquaresProblem) -> Array:
    """First coefficients (P,) of a model without scanned parameters, from the smoothed acceleration; levels are one."""
    p = np.array([float(s.effect == LEVEL) for s in problem.layout.slots])
    columns = np.concatenate([-_forces(problem, piece, p) / piece.mass for piece in problem.pieces])
    right = np.concatenate([piece.a_hat - piece.known for piece in problem.pieces])
    p[[s.linear for s in problem.layout.slots]] = np.linalg.lstsq(columns, right, rcond=1e-8)[0]
    return p


def best_on_grid(problem: LeastSquaresProblem) -> Array:
    """Find the best grid point of the non-linear parameters, refined along the smoothed motion.

    A force that depends on position, such as a spring, turns position errors into slow errors after two integrations.
    Each window of a piece therefore has its own start.

    Parameters
    ----------
    problem : LeastSquaresProblem
        The problem.

    Returns
    -------
    array of shape (P,)
        Start values.

    """
    layout = problem.layout
    scanned = [i for i, s in enumerate(layout.slots) if not s.linear and s.effect != LEVEL]
    points = list(product(*(_grid(problem, i) for i in scanned)))
    best, least = np.ones(len(layout.slots)), np.inf
    for point in points[:: -(-len(points) // MAX_SETTINGS_TRIED)]:
        p = np.where([s.effect == LEVEL for s in layout.slots], 1.0, 0.0)
        p[scanned] = point
        unknowns, residual = _solved(problem, p)
        if (misfit := float(residual @ residual)) < least:
            best, least = unknowns, misfit
    if not scanned:
        return best
    low, high = (bound[scanned] for bound in layout.bounds)
    scale = np.maximum(np.abs(best[scanned]), 1e-12)

    def solved(theta: Array) -> tuple[Array, Array]:
        unknowns = best.copy()
        unknowns[scanned] = np.clip(theta * scale, low, high)
        return _solved(problem, unknowns)

    def residual_at(theta: Array) -> Array:
        return solved(theta)[1]

    inside = np.clip(best[scanned], low + 1e-9 * scale, high - 1e-9 * scale) / scale
    bounds = low / scale, high / scale
    return solved(least_squares(residual_at, inside, bounds=bounds, max_nfev=MAX_REFINEMENTS).x)[0]


def shoot_lengthening(problem: LeastSquaresProblem) -> Array:
    """Find start values (P,) for swinging masses: fit short stretches first, then longer and longer ones.

    Over a whole record a slightly wrong model is soon out of phase, and no step leads back. In short stretches with
    their own starts it is nearly linear (multiple shooting).

    References
    ----------
    Bock, H. G. (1983). Recent advances in parameter identification techniques for O.D.E. Progress in Scientific
    Computing 2, 95-121.

    """
    length, whole = FIRST_SEGMENT_FRAMES, max(len(piece.t) for piece in problem.pieces)
    p = best_on_grid(problem.rebuild(problem.layout, cut_into_pieces(problem.pieces, length)))
    while length < whole:
        part = problem.rebuild(problem.layout, cut_into_pieces(problem.pieces, length))
        with suppress(FrictrackError):  # a longer stretch may converge where this one does not
            p = refine(part, p, part.first_starts(), max_steps=STEPS_PER_LENGTH).p
        length *= 2
    return p


def _grid(problem: LeastSquaresProblem, i: int) -> Array:
    """Values of one unknown to try."""
    slot = problem.layout.slots[i]
    scan = problem.layout.effect(slot.effect).parameter(slot.parameter).scan
    return np.array([np.mean(slot.bounds)]) if scan is None else scan(problem.layout.span)


def _solved(problem: LeastSquaresProblem, p: Array) -> tuple[Array, Array]:
    """Unknowns (P,) with the best coefficients, and the residual (n,) along the smoothed motion, starts taken out."""
    rows = [(piece, displacement_rows(piece, _forces(problem, piece, p))) for piece in problem.pieces]
    n = max(len(piece.t) for piece in problem.pieces) // WINDOWS_PER_PIECE
    both = np.concatenate([window for piece, own in rows for window in without_starts(piece, own, n)])
    linear, out = [i for i, s in enumerate(problem.layout.slots) if s.linear], p.copy()
    low, high = (bound[linear] for bound in problem.layout.bounds)
    out[linear] = np.clip(np.linalg.lstsq(both[:, :-1], both[:, -1], rcond=1e-10)[0], low, high)
    return out, both[:, -1] - both[:, :-1] @ out[linear]


def _forces(problem: LeastSquaresProblem, piece: Piece, p: Array) -> Array:
    """Forces (3 p, K) per unit coefficient along the smoothed motion of one piece; zero for those of other runs."""
    found, level = problem.layout.values(p, piece.run)  # its coefficients are yet to be found
    values = {e.name: {q.name: found[e.name][q.name] for q in e.nonlinear} for e in problem.model.effects}
    columns = problem.model.force_columns(piece.path_at_nodes(piece.x_hat, piece.v_hat, level), values)
    places = {(e.name, q.name): k for e in problem.model.effects for k, q in enumerate(e.linear)}
    return np.column_stack(
        [
            columns[s.effect][:, places[s.effect, s.parameter]]
            if s.effect in columns and s.run in (None, piece.run)
            else np.zeros_like(piece.known)
            for s in problem.layout.slots
            if s.linear
        ]
    )


# --- one effect more, or one less


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
    problem = solution.problem.rebuild(layout)
    grown = fit_with_scatter(problem, _linear_guess(problem), problem.first_starts())
    for e in [effect, *scanned] if ties_are_resolved(effect, without_scan) else [*scanned, effect]:
        grown = _add_effect(grown, e)
    return reorder_effects(grown, Model((*solution.problem.model.effects, effect)))


def _add_effect(solution: Solution, effect: Effect) -> Solution:
    """Add an effect where it explains most along the measured motion, and refine as far as a trial needs."""
    return simulate_trial(*_tried(solution, effect))


def _tried(solution: Solution, effect: Effect) -> tuple[LinearisedModel, CandidateTrial]:
    """A fitted model, and an effect on trial where it explains most along the measured motion."""
    linearised = linearise(solution)
    series = measured_series(linearised)
    scans = scan_effect(linearised, effect, series)
    if not scans:
        raise FrictrackError(effect.lacks([p.path for p in solution.problem.pieces]))
    trial = try_effect(linearised, effect, scans, series.coordinates[:, 0])
    return linearised, deepen_trials(linearised, [trial])[0]


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
    problem, tau = model.problem.rebuild(trial.layout), trial.tau or model.tau or 0.03
    starts = problem.first_starts()
    if problem.simulates:
        starts = [np.array([r.motion.x_edge[0], r.motion.v_edge[0]]) for r in model.responses]
        if model.problem.model.memory:  # its motion takes long to find from afar
            problem = problem.beginning_at(model.responses)
    first = result_or_none(refine, problem, trial.p, starts, tau=tau, max_steps=SETTLING_STEPS)
    if first is None or first.objective > model.objective:
        first = result_or_none(_without_effect, problem, trial, model) or first
        if first is None:
            raise FrictrackError(NOT_INTEGRATED)
        tau = first.tau or tau
    frames = problem.n_frames
    excess = (trial.misfit - frames) / max(1.0, trial.misfit / max(frames, 1))  # in units of chi-squared per frame
    min_fall = max(TRIAL_MIN_CHI2_FALL, TRIAL_MIN_EXCESS_SHARE * excess)
    return _with_few_clocks(refit_with_scatter(first, tau, max_steps=TRIAL_MAX_STEPS, min_fall=min_fall), trial.effect)


def _with_few_clocks(solution: Solution, effect: Effect) -> Solution:
    """Remove clock errors of runs that do not need one: the others share the nominal clock."""
    # the model absorbs a common clock error of all runs: the run nearest to the median clock is removed first
    penalty = bic_penalty(EVENT_PARAMETERS, solution.problem.n_frames)
    while effect.clock is not None:
        layout = solution.problem.layout
        rates = {s.run: float(p) for s, p in zip(layout.slots, solution.p, strict=True) if s.effect == effect.name}
        if len(rates) < 2:
            break
        middle = float(np.median([rates.get(r, 0.0) for r in range(len(layout.run_names))]))
        run = min(rates, key=lambda r: abs(rates[r] - middle))
        fewer_clocks = replace(layout, absent=layout.absent | {(effect.name, int(run or 0))})
        p = fewer_clocks.unknowns(layout.by_address(solution.p))
        p -= rates[run] * np.array([s.effect == effect.name for s in fewer_clocks.slots])
        problem, tau = solution.problem.rebuild(fewer_clocks), solution.tau
        found = fit_with_scatter(
            problem, p, solution.starts, tau, max_steps=TRIAL_MAX_STEPS, min_fall=TRIAL_MIN_CHI2_FALL
        )
        if found.objective - solution.objective > penalty:
            break
        solution = found
    return solution


def _without_effect(problem: LeastSquaresProblem, trial: CandidateTrial, model: Solution) -> Solution:
    """The model without the effect on trial, with its coefficients refined."""
    layout = trial.layout
    own = np.array([s.linear and s.effect == trial.effect.name for s in layout.slots], dtype=bool)
    p = layout.unknowns(model.problem.layout.by_address(model.p), np.where(own, 0.0, trial.p))
    problem = problem.beginning_at(model.responses)
    return refine(problem, p, model.starts, tau=model.tau or 0.03, free=layout.coefficients, max_steps=4)


def refine_to_end(solution: Solution) -> Solution:
    """Refine a model that `add_effect` has tried to convergence."""
    return refit_with_scatter(solution, solution.tau or 0.03)


def reorder_effects(solution: Solution, model: Model) -> Solution:
    """Return the same solution with the effects in the order of `model`."""
    old = solution.problem.layout
    ordered = tuple(replace(old.effect(e.name), replaces=e.replaces) for e in model.effects)
    if ordered == old.model.effects:
        return solution
    layout = replace(old, model=Model(ordered))
    # a motion up to its stop may not be found again from afar
    problem = solution.problem.rebuild(layout).beginning_at(solution.responses)
    p = layout.unknowns(old.by_address(solution.p))
    return refine(problem, p, solution.starts, tau=solution.tau, max_steps=2)


def remove_effect(solution: Solution, name: str) -> Solution:
    """Remove an effect from a fitted model, and refine the smaller one.

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
    problem = solution.problem.rebuild(layout)
    firsts = [layout.unknowns(old.by_address(solution.p))]
    if problem.simulates and (law := result_or_none(linearise, solution)) is not None:
        # the rest takes over what it can of the effect
        firsts.append(refine_on_measured_motion(law, layout, firsts[0]))
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
