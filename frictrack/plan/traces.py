"""Compute the traces that the law, the friction level and every effect leave in a simulated run.

Traces are whitened, and the initial conditions are projected out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.diagnose.experiments import (
    GOLDEN_ANGLE_RAD,
    PLANNED_RUN_NAME,
    blank_piece,
    integrate_motion,
)
from frictrack.effects import PLANNED_SHARE, Effect, Span
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import LeastSquaresProblem, PieceResponse
from frictrack.fit.linearised import has_per_run_coefficients
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.pieces import Piece, spans_of
from frictrack.plan.causes import MEASUREMENT_NOISE_RATIO, Cause
from frictrack.plan.experiment_setup import Experiment, ExperimentSetup
from frictrack.records import Array

QUADRATURES = (0.0, np.pi / 2)


@dataclass(frozen=True)
class PlannedRun:
    """One simulated run: its response and the sensitivities of the law (n, P) and of the friction level (n,)."""

    experiment: Experiment
    response: PieceResponse
    problem: LeastSquaresProblem
    p: Array
    law_columns: Array
    level_column: Array

    @property
    def piece(self) -> Piece:
        """The run as it would be measured, without noise."""
        return self.response.piece


def simulate_runs(setup: ExperimentSetup, entries: list[Experiment]) -> list[PlannedRun]:
    """Simulate the candidate runs that are long enough.

    Parameters
    ----------
    setup
        The experimental setup.
    entries
        The candidate runs.

    Returns
    -------
    list of PlannedRun

    Raises
    ------
    FrictrackError
        If every candidate run is too short.

    """
    made = []
    for experiment in entries:
        try:
            made.append(_simulate_run(setup, experiment))
        except FrictrackError:  # the mass would not get far enough
            continue
    if not made:
        raise FrictrackError(
            f"expected a course long enough for a run but on {setup.course:.2g} m at {setup.fps:g} frames/s every "
            "candidate run is too short; give a finer scale or a higher fps in [camera]"
        )
    return made


def _simulate_run(setup: ExperimentSetup, experiment: Experiment) -> PlannedRun:
    per_frame = 3  # panels per frame, as a blow needs them
    piece = blank_piece(setup.conditions, experiment.design, 0, per_frame)
    first_span = Span(1.0, setup.start, setup.start + setup.course, 0.01, 10.0, setup.fps)
    layout, p = _unknowns(setup, first_span)
    piece = integrate_motion(LeastSquaresProblem(layout.model, layout, [piece]), p, experiment.design)
    layout, p = _unknowns(setup, spans_of([piece], 1, setup.fps)[0])
    problem = LeastSquaresProblem(layout.model, layout, [piece])
    response = problem.evaluate(p, [np.array(experiment.design.start)])[0]
    levels = layout.levels
    mine = [k for k, i in enumerate(response.active) if i not in levels]
    own = [k for k, i in enumerate(response.active) if i == levels[0]]
    return PlannedRun(experiment, response, problem, p, response.jac[:, mine], response.jac[:, own[0]])


def _unknowns(setup: ExperimentSetup, span: Span) -> tuple[ParameterLayout, Array]:
    """Parameters of the law with a friction level per run; a second, empty run makes the layout include one."""
    layout = ParameterLayout(setup.law, (PLANNED_RUN_NAME, "another"), (span, span))
    p = [setup.values[s.effect][s.parameter] if s.effect in setup.values else 1.0 for s in layout.slots]
    return layout, np.array(p)


def effect_columns(run: PlannedRun, cause: Cause, grid: tuple[dict[str, float], ...]) -> Array:
    """Whitened columns of an effect in one run, initial conditions projected out.

    Parameters
    ----------
    run
        The simulated run.
    cause
        The effect.
    grid
        Its G settings.

    Returns
    -------
    ndarray, shape (n, G, k)
        Sine and cosine columns for an effect with a phase.

    """
    effect, response = cause.effect, run.response
    phases = [q.name for q in effect.nonlinear if q.role == "phase"]
    phases_of_columns = [dict.fromkeys(phases, q) for q in QUADRATURES] if phases else [{}]
    length = float(response.piece.t[-1])
    each = [_in_seconds(cause, form, length) | phase for form in grid for phase in phases_of_columns]
    moved_by = (
        _measurement_columns(run, effect, each)
        if effect.acts_on == "measurement"
        else _displacement_columns(run, effect, each)
    )
    white = moved_by / response.piece.sigma[:, None]
    white -= response.q @ (response.q.T @ white)
    return np.asarray(white.reshape(len(white), len(grid), -1))


def _in_seconds(cause: Cause, form: dict[str, float], length: float) -> dict[str, float]:
    """Convert the time of an event from a share of the run's duration to s."""
    if not cause.is_event:
        return form
    return form | {p.name: form[p.name] * length for p in cause.effect.nonlinear if p.per_run and p.scan is not None}


def _measurement_columns(run: PlannedRun, effect: Effect, grid: list[dict[str, float]]) -> Array:
    """Shift of the picture, m, (n, G k)."""
    motion, piece = run.response.motion, run.piece
    path = piece.at_frames(motion.x_edge[piece.at], motion.v_edge[piece.at], 1.0)
    return np.concatenate([effect.columns(path, form) for form in grid], axis=1)


def effect_forces(run: PlannedRun, effect: Effect, grid: list[dict[str, float]]) -> Array:
    """Force of an effect at the nodes, N, (3 p, G k); for a modifier the change that it makes."""
    motion, piece = run.response.motion, run.piece
    path = piece.path_at_nodes(motion.x, motion.v, 1.0)
    if not effect.modifies:
        return np.concatenate([effect.columns(path, form) for form in grid], axis=1)
    values, _ = run.problem.layout.values(run.p, 0)
    model = run.problem.model
    present = model.force_columns(path, values)
    inner = sum(
        present[e.name] @ model.coefficients(e.name, values) for e in model.effects if e.kind in effect.modifies
    )
    dry = np.asarray(inner)[:, None]
    return np.concatenate([effect.columns(path, form, dry) - dry for form in grid], axis=1)


def _displacement_columns(run: PlannedRun, effect: Effect, grid: list[dict[str, float]]) -> Array:
    """Displacement that a force causes, m, (n, G k)."""
    g = -effect_forces(run, effect, grid) / run.piece.mass
    _, edges = run.response.linear.respond(g, np.zeros((2, g.shape[1])))
    return np.asarray(edges[run.piece.at, 0])


def planned_size(runs: list[PlannedRun], cause: Cause) -> float:
    """Coefficient at which an effect has its planned size over the candidate runs."""
    effect, setting = cause.effect, cause.setting
    if effect.planned_size is not None:
        return effect.planned_size(float(np.median([r.piece.mass * abs(r.experiment.design.start[1]) for r in runs])))
    if effect.acts_on == "measurement":
        shifts = [_measurement_columns(r, effect, [setting])[:, 0] / r.piece.sigma for r in runs]
        return MEASUREMENT_NOISE_RATIO / max(_rms(shifts), 1e-300)
    if not effect.sized:
        return 1.0
    made = [effect_forces(r, effect, [setting])[:, 0] for r in runs]
    default_setup = [r.piece.mass * (r.piece.known - r.response.motion.a) for r in runs]
    return PLANNED_SHARE * float(np.mean(np.abs(np.concatenate(default_setup)))) / max(_rms(made), 1e-300)


def _rms(parts: list[Array]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def effect_trace(run: PlannedRun, cause: Cause, size: float, number: int) -> Array:
    """Trace of a true effect of a given size in one run, (n,); phases spread evenly over the runs."""
    block = effect_columns(run, cause, (_setting_in_run(cause, number),))[:, 0]
    if any(q.role == "phase" for q in cause.effect.nonlinear):
        phase = GOLDEN_ANGLE_RAD * number if has_per_run_coefficients(cause.effect) else 0.5
        return size * np.asarray(block[:, 0] * np.cos(phase) + block[:, 1] * np.sin(phase))
    return size * np.asarray(block[:, 0])


def _setting_in_run(cause: Cause, number: int) -> dict[str, float]:
    """Setting of an effect in one run; events come at a different share of the duration in each."""
    if not cause.is_event:
        return cause.setting
    share = 0.3 + 0.4 * ((0.618 * (number + 1)) % 1.0)
    return cause.setting | {p.name: share for p in cause.effect.nonlinear if p.per_run and p.scan is not None}
