"""Fit displacements from scratch: all effects at once along the measured motion, or else one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext, suppress
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.optimize import least_squares

from frictrack.base.errors import FrictrackError
from frictrack.effects import Effect, Parameter, Span
from frictrack.effects.models import Model
from frictrack.fit.cutting import MIN_FRAMES, cut_into_pieces
from frictrack.fit.least_squares import LeastSquaresProblem, PieceResponse, Solution, fit_with_scatter, refine
from frictrack.fit.linearised import has_per_run_coefficients
from frictrack.fit.parameters import LEVEL, ParameterLayout
from frictrack.fit.pieces import Piece, displacement_rows, spans_of, without_starts
from frictrack.fit.separable.common_amplitudes import variable_projection
from frictrack.fit.separable.model import SeparableModel, displacement_block
from frictrack.fit.separable.projected import ProjectedProblem
from frictrack.fit.separable.varpro import is_scannable
from frictrack.fit.stepwise import (
    EVENT_PARAMETERS,
    add_effect,
    bic_penalty,
    entry_order,
    guess_coefficients,
    is_unconstrained,
    refine_to_end,
    reorder_effects,
    reversed_ties,
)
from frictrack.records import Array, Mask

MAX_SETTINGS_TRIED = 600  # grid points tried
MIN_WINDOW_FRAMES = 32  # frames per window; its start uses two degrees of freedom
MAX_REFINEMENTS = 30  # function evaluations beyond the grid
FIRST_SEGMENT_FRAMES = 128  # frames of the first, shortest stretches
STEPS_PER_LENGTH = 6  # Gauss-Newton steps per length
STOP_MARGIN_FRAMES = 2.0  # frames left out before a stop
GOOD_CHI2_PER_FRAME = 1.15  # chi-squared per frame below which no second start is tried
MAX_REVERSAL_SEGMENTS = 16  # segments used for the first fit of a long record with reversals
COEFFICIENT_SHARES = (1.0, 0.5, 0.2, 0.0)  # factors on start coefficients, until the motion does not diverge


def fit_displacement(model: Model, pieces: list[Piece], names: tuple[str, ...], fps: float) -> Solution:
    """Fit a model to displacements from scratch.

    Variable projection along the measured motion gives the start, output-error Gauss-Newton the result. If that
    leaves more than noise, effects are added one by one. The better result is returned.

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
    spans = spans_of(pieces, len(names), fps)
    if any(p.turns for p in pieces):
        return _through_reversals(model, pieces, names, spans)
    found = []
    with suppress(FrictrackError):  # its motion cannot be integrated; adding effects one by one may work
        found.append(_by_variable_projection(model, pieces, names, spans))
    # a relaxed effect has too many parameters for a scan; one with memory takes ten times as long
    can_grow = not any(e.relaxed or e.memory for e in model.effects)
    if not found or (can_grow and found[0].chi2 > GOOD_CHI2_PER_FRAME * found[0].problem.n_frames):
        with suppress(FrictrackError) if found else nullcontext():
            found.append(_from_scratch(model, pieces, names, spans))
        for other in reversed_ties(model):
            with suppress(FrictrackError):  # the requested direction of the tie has been fitted already
                found.append(_with_ties_of(_from_scratch(other, pieces, names, spans), model))
    return refit_until_stop(min(found, key=lambda s: s.objective))


def _by_variable_projection(
    model: Model, pieces: list[Piece], names: tuple[str, ...], spans: tuple[Span, ...]
) -> Solution:
    """The fit that variable projection starts; effects that it cannot scan are added afterwards.

    FrictrackError when nothing is left to start from, or when the runs lack what an effect needs.
    """
    _, scanned = entry_order(model)
    # clock errors are found in simulation, for few runs
    later = [e for e in scanned if not is_scannable(e) or e.clock is not None]
    first = Model(tuple(e for e in model.effects if e not in later))
    problem = LeastSquaresProblem(first, ParameterLayout(first, names, spans), pieces)
    blocks = [displacement_block(p) for p in problem.pieces]
    separable = SeparableModel(problem.layout, blocks)
    search = variable_projection(separable)
    state = search()
    absent = search.unneeded_events(state, bic_penalty(EVENT_PARAMETERS, separable.size))
    if absent:
        start_values = dict(zip(search.separable.layout.names, state.nonlinear_values, strict=True))
        problem = problem.rebuild(replace(problem.layout, absent=absent), problem.pieces)
        separable = SeparableModel(problem.layout, blocks)
        projected = ProjectedProblem(separable, separable.data)
        state = projected.refine(projected.at(np.array([start_values[n] for n in problem.layout.names])))
    solution = _with_free_amplitudes(_refine_shrunk(problem, separable.law(state.nonlinear_values, state.coefficients)))
    return _add_later(solution, model, later) if later else solution


def _refine_shrunk(problem: LeastSquaresProblem, p: Array) -> Solution:
    """The fit refined from p (P,), or from a share of its coefficients where the motion cannot be integrated.

    Along the measured motion a model that lacks an effect may have coefficients with which its own motion diverges.
    """
    linear = np.array([s.linear for s in problem.layout.slots])
    for share in COEFFICIENT_SHARES:
        with suppress(FrictrackError):
            return fit_with_scatter(problem, np.where(linear, share * p, p), problem.first_starts())
    raise FrictrackError("the motion under this law could not be integrated; check mass, drive and incline")


def _with_free_amplitudes(solution: Solution) -> Solution:
    """One amplitude for all runs, or one per run where that lowers the BIC, wave after wave."""
    runs = len(solution.problem.layout.run_names)
    for effect in solution.problem.model.effects if runs > 1 else ():
        amplitudes = {
            p.name: {"per_run": True}
            for p in effect.parameters
            if p.role == "amplitude" and is_unconstrained(p) and not p.per_run
        }
        if not amplitudes or not has_per_run_coefficients(effect):
            continue
        old = solution.problem.layout
        changed = Model(tuple(effect.adjusted(**amplitudes) if e is effect else e for e in old.model.effects))
        layout = replace(old, model=changed)
        known_values = dict(zip(old.names, solution.p, strict=True))
        p = np.array([known_values.get(name, known_values.get(name.split("[")[0], 0.0)) for name in layout.names])
        free_amplitudes = fit_with_scatter(
            solution.problem.rebuild(layout, solution.problem.pieces), p, solution.starts, solution.tau
        )
        needed = bic_penalty(len(amplitudes) * (runs - 1), solution.problem.n_frames)
        if solution.objective - free_amplitudes.objective > needed:
            solution = free_amplitudes
    return solution


def _with_ties_of(solution: Solution, model: Model) -> Solution:
    """The fit under the ties of `model`, refined from values found under other ties."""
    old = solution.problem.layout
    fitted = {e.name: e for e in old.model.effects}
    ties = {(e.name, p.name): p for e in model.effects for p in e.parameters}
    law = Model(tuple(_effect_with_ties(fitted[e.name], ties) for e in model.effects))
    layout = replace(old, model=law)
    each = [old.values(solution.p, run) for run in range(len(old.run_names))]
    p = [each[s.run or 0][1] if s.effect == LEVEL else each[s.run or 0][0][s.effect][s.parameter] for s in layout.slots]
    problem = solution.problem.rebuild(layout, solution.problem.pieces)
    return fit_with_scatter(problem, np.array(p), solution.starts, solution.tau or 0.03)


def _effect_with_ties(effect: Effect, ties: dict[tuple[str, str], Parameter]) -> Effect:
    """A fitted effect with the ties that were asked for."""
    changes = {p.name: ties[effect.name, p.name] for p in effect.parameters if p.tie != ties[effect.name, p.name].tie}
    return effect.adjusted(**{name: {"tie": p.tie, "fixed": p.fixed} for name, p in changes.items()})


def _from_scratch(model: Model, pieces: list[Piece], names: tuple[str, ...], spans: tuple[Span, ...]) -> Solution:
    """One effect after the other, then all together to convergence."""
    plain, scanned = entry_order(model)
    if not plain:
        raise FrictrackError("expected an effect without a scan, such as coulomb, in the model to start from")
    layout = ParameterLayout(Model(tuple(plain)), names, spans)
    problem = LeastSquaresProblem(layout.model, layout, pieces)
    solution = fit_with_scatter(problem, guess_coefficients(problem), problem.first_starts())
    return _add_later(solution, model, scanned)


def _through_reversals(model: Model, pieces: list[Piece], names: tuple[str, ...], spans: tuple[Span, ...]) -> Solution:
    """The fit of runs with stops and reversals; with very many segments, on some of them first."""
    subset = pieces[:: -(-len(pieces) // MAX_REVERSAL_SEGMENTS)]
    if len(subset) == len(pieces) or {p.run for p in subset} != {p.run for p in pieces}:
        return _fit_through_reversals(model, pieces, names, spans)
    found = _fit_through_reversals(model, subset, names, spans)
    problem = found.problem.rebuild(found.problem.layout, pieces)
    return refine(problem, found.p, problem.first_starts(), tau=found.tau or 0.03, max_steps=1)


def _fit_through_reversals(
    model: Model, pieces: list[Piece], names: tuple[str, ...], spans: tuple[Span, ...]
) -> Solution:
    """The fit to all of some pieces with stops and reversals."""
    start_effects, later = split_start_effects(model)
    layout = ParameterLayout(Model(tuple(start_effects)), names, spans)
    problem = LeastSquaresProblem(layout.model, layout, pieces)
    guess = shoot_lengthening if any(p.slack for p in pieces) else best_on_grid
    solution = fit_with_scatter(problem, guess(problem), problem.first_starts())
    return _add_later(solution, model, later) if later else solution


def _add_later(solution: Solution, model: Model, later: list[Effect]) -> Solution:
    """Add the later effects of a model to the fit of the others, and refine to convergence."""
    for effect in later:  # also with one that it would replace: the model names both
        solution = add_effect(solution, replace(effect, replaces=frozenset()))
    return refine_to_end(reorder_effects(solution, model))


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
        shorter = [p.first(n) for n, p in zip(kept, pieces, strict=True)]
        problem = LeastSquaresProblem(solution.problem.model, solution.problem.layout, shorter)
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
    """Split effects into those that start together and those that are added later.

    Effects without a scan start together, with modifiers and what they modify.

    Parameters
    ----------
    model : Model
        The model.

    Returns
    -------
    first, later : list of Effect
        The two groups.

    """
    reshaped = frozenset[str]().union(*(e.modifies for e in model.effects if e.turns))
    start_effects = [e for e in model.effects if e.turns or e.kind in reshaped or not any(p.free for p in e.nonlinear)]
    return start_effects, [e for e in model.effects if e not in start_effects]


def best_on_grid(problem: LeastSquaresProblem) -> Array:
    """Find the best grid point of the non-linear parameters, refined along the smoothed motion.

    A force that depends on position, such as a spring, turns position errors into slow errors after two integrations.
    Stretches are therefore compared whole and in windows, at the length at which the model explains most.

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
    scanned = [i for i, s in enumerate(layout.slots) if not s.linear and s.effect != "level"]
    points = list(product(*(_grid(problem, i) for i in scanned)))
    lengths = _lengths(problem)
    best, smallest_share, length = np.ones(len(layout.slots)), np.inf, 0
    for point in points[:: -(-len(points) // MAX_SETTINGS_TRIED)]:
        p = np.where([s.effect == "level" for s in layout.slots], 1.0, 0.0)
        p[scanned] = point
        for n, columns, right in _windowed(problem, p, lengths):
            unknowns, residual = _solve_coefficients(problem, p, columns, right)
            unexplained_share = float(residual @ residual) / max(float(right @ right), 1e-300)
            if unexplained_share < smallest_share:
                best, smallest_share, length = unknowns, unexplained_share, n
    return _refined(problem, best, scanned, length) if scanned else best


def _lengths(problem: LeastSquaresProblem) -> list[int]:
    """Window lengths to try, in frames; 0 leaves stretches whole."""
    longest = max(len(p.t) for p in problem.pieces)
    return [0, *(n for n in (longest >> k for k in range(1, 32)) if n >= MIN_WINDOW_FRAMES)]


def _refined(problem: LeastSquaresProblem, p: Array, scanned: list[int], length: int) -> Array:
    """Unknowns (P,) refined from the grid, the coefficients solved for every trial."""
    low, high = (bound[scanned] for bound in problem.layout.bounds)
    scale = np.maximum(np.abs(p[scanned]), 1e-12)

    def solved(theta: Array) -> tuple[Array, Array]:
        unknowns = p.copy()
        unknowns[scanned] = np.clip(theta * scale, low, high)
        ((_, columns, right),) = _windowed(problem, unknowns, [length])
        return _solve_coefficients(problem, unknowns, columns, right)

    def residual(theta: Array) -> Array:
        return solved(theta)[1]

    inside = np.clip(p[scanned], low + 1e-9 * scale, high - 1e-9 * scale) / scale
    found = least_squares(residual, inside, bounds=(low / scale, high / scale), x_scale=1.0, max_nfev=MAX_REFINEMENTS)
    return solved(found.x)[0]


def shoot_lengthening(problem: LeastSquaresProblem) -> Array:
    """Find start values for swinging masses: fit short stretches first, then longer and longer ones.

    Over a whole record a slightly wrong model is soon out of phase, and no step leads back. In short stretches with
    their own starts it is nearly linear (multiple shooting).

    Parameters
    ----------
    problem : LeastSquaresProblem
        The problem.

    Returns
    -------
    array of shape (P,)
        Start values.

    References
    ----------
    Bock, H. G. (1983). Recent advances in parameter identification techniques for O.D.E. Progress in Scientific
    Computing 2, 95-121.

    """
    p = best_on_grid(_cut_problem(problem, FIRST_SEGMENT_FRAMES))
    length, whole = FIRST_SEGMENT_FRAMES, max(len(piece.t) for piece in problem.pieces)
    while length < whole:
        part = _cut_problem(problem, length)
        with suppress(FrictrackError):  # a longer stretch may converge where this one does not
            p = refine(part, p, part.first_starts(), max_steps=STEPS_PER_LENGTH).p
        length *= 2
    return p


def _cut_problem(problem: LeastSquaresProblem, length: int) -> LeastSquaresProblem:
    """The same problem over stretches of about `length` frames."""
    pieces = [part for piece in problem.pieces for part in cut_into_pieces([piece], length)]
    return problem.rebuild(problem.layout, pieces)


def _grid(problem: LeastSquaresProblem, i: int) -> Array:
    """Values of one unknown to try."""
    slot = problem.layout.slots[i]
    effect = next(e for e in problem.model.effects if e.name == slot.effect)
    scan = effect.parameter(slot.parameter).scan
    return np.array([np.mean(slot.bounds)]) if scan is None else scan(problem.layout.span)


def _solve_coefficients(problem: LeastSquaresProblem, p: Array, columns: Array, right: Array) -> tuple[Array, Array]:
    """Unknowns (P,) with the best coefficients, and the residual (n,)."""
    linear = [i for i, s in enumerate(problem.layout.slots) if s.linear]
    low, high = (bound[linear] for bound in problem.layout.bounds)
    out = p.copy()
    out[linear] = np.clip(np.linalg.lstsq(columns, right, rcond=1e-10)[0], low, high)
    return out, np.asarray(right - columns @ out[linear])


def _windowed(problem: LeastSquaresProblem, p: Array, lengths: list[int]) -> Iterator[tuple[int, Array, Array]]:
    """Yield, for every window length, columns (n, K) per unit coefficient and data (n,), starts projected out."""
    rows = [(piece, displacement_rows(piece, _forces(problem, piece, p))) for piece in problem.pieces]
    for n in lengths:
        cut = np.concatenate([window for piece, own in rows for window in without_starts(piece, own, n)])
        yield n, cut[:, :-1], cut[:, -1]


def _forces(problem: LeastSquaresProblem, piece: Piece, p: Array) -> Array:
    """Forces (3 p, K) per unit coefficient along the smoothed motion of one piece; zero for those of other runs."""
    values, level = problem.layout.values(p, piece.run)
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
