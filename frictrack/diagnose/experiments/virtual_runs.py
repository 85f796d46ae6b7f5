"""Simulate a run that has not been filmed yet, as an explanation predicts it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from frictrack.costs import DEFAULT_COSTS, Costs
from frictrack.effects import Path, Span
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import LeastSquaresProblem, Solution
from frictrack.fit.parameters import LEVEL, MIN_RUNS_FOR_SCATTER, ParameterLayout, Slot
from frictrack.fit.pieces import MIN_FRAMES, Piece
from frictrack.records import GRAVITY, Array
from frictrack.simulate.dynamics import Panels

PLANNED_RUN_NAME = "next run"
MIN_VISIBLE_SPEED = 0.01  # m/s; a slower mass counts as stopped
STOP_TIME_MARGIN = 1.5  # times the stopping time at the typical deceleration
MAX_FRAMES = 3000  # of a planned run
MIN_RUN_FRAMES = 3 * MIN_FRAMES  # of a run that is worth filming
DEFAULT_SCATTER = 0.03  # relative, of the friction level, if there are too few runs to estimate it
MIN_SPEED_LEFT = 0.1  # of the start speed, at the end of a film that ended before the motion did
MIN_COURSE_LEFT = 0.2  # of the course, in front of the mass at the end of such a film
GOLDEN_ANGLE_RAD = 2.39996  # rad; phases of successive runs spread evenly


@dataclass(frozen=True)
class RunDesign:
    """Design of one planned run. It ends where the mass leaves the course or stops.

    Parameters
    ----------
    start
        Start position m and velocity m/s.
    course
        Stretch of the course in view, m.
    mass, rate, pitch, drive
        Factors on mass, frame rate, pixel pitch and measured drive.
    tilt
        Angle added to the incline, rad.
    phase
        Phase of periodic effects with a phase per run, rad.
    frames
        Largest number of frames in the film.

    """

    start: tuple[float, float]
    course: tuple[float, float]
    mass: float = 1.0
    tilt: float = 0.0
    rate: float = 1.0
    pitch: float = 1.0
    drive: float = 1.0
    phase: float = GOLDEN_ANGLE_RAD
    frames: float = np.inf


def longest_piece(pieces: Sequence[Piece]) -> Piece:
    """The longest piece; planned runs are modelled on it."""
    return max(pieces, key=lambda p: p.t[-1] - p.t[0])


def max_frames_of_film(solution: Solution, costs: Costs = DEFAULT_COSTS) -> float:
    """Largest number of frames in a film of this set-up: as declared, or else as far as its runs show.

    The longest run shows it if its film ended while the mass still moved, and well within the course of the runs.

    Parameters
    ----------
    solution
        A fit of the filmed runs.
    costs
        What is declared of the set-up.

    Returns
    -------
    float
        Infinite where neither tells.

    """
    if costs.frames is not None:
        return costs.frames
    pieces, course = solution.problem.pieces, solution.problem.layout.span
    counts = Counter[int]()
    for piece in pieces:
        counts[piece.run] += len(piece.t)
    run, frames = counts.most_common(1)[0]
    own = [piece for piece in pieces if piece.run == run]
    x, v, first = float(own[-1].x_hat[-1]), float(own[-1].v_hat[-1]), float(own[0].v_hat[0])
    left = course.x_max - x if v > 0 else x - course.x_min
    moves = abs(v) > MIN_SPEED_LEFT * abs(first) and left > MIN_COURSE_LEFT * (course.x_max - course.x_min)
    return float(frames) if moves else np.inf


def extend_layout(solution: Solution, span: Span, phase: float, *, free: bool = False) -> tuple[ParameterLayout, Array]:
    """Extend the parameters of a fit by one run.

    Parameters
    ----------
    solution
        The fit.
    span
        Duration, course and speeds of the new run.
    phase
        Phase of the new run, rad.
    free
        Whether an effect that is absent from most runs may occur in the new one.

    Returns
    -------
    layout : ParameterLayout
    p : ndarray, shape (P',)
        Per-run parameters are the mean over the other runs.

    """
    old = solution.problem.layout
    runs = len(old.run_names)
    rare_effects = {e.name for e in old.model.effects if sum(a == e.name for a, _ in old.absent) > runs / 2}
    absent = set() if free else {(name, runs) for name in rare_effects}
    layout = replace(
        old, run_names=(*old.run_names, PLANNED_RUN_NAME), spans=(*old.spans, span), absent=old.absent | absent
    )
    known_values = dict(zip(old.names, solution.p, strict=True))
    roles = {(e.name, p.name): p.role for e in old.model.effects for p in e.parameters}
    p = []
    for name, slot in zip(layout.names, layout.slots, strict=True):
        others = [v for s, v in zip(old.slots, solution.p, strict=True) if _is_same_parameter(s, slot)]
        if name in known_values:
            p.append(known_values[name])
        elif slot.effect == LEVEL:
            p.append(1.0)
        elif roles[slot.effect, slot.parameter] == "phase":
            p.append(phase)
        else:
            p.append(float(np.mean(others)) if others else 0.0)
    return layout, np.array(p)


def _is_same_parameter(a: Slot, b: Slot) -> bool:
    return (a.effect, a.parameter) == (b.effect, b.parameter)


def simulate_run(truth: Solution, design: RunDesign, fine: int = 1) -> Piece:
    """Simulate what the camera would measure in a planned run, without noise.

    Parameters
    ----------
    truth
        The explanation that is true.
    design
        The planned run.
    fine
        Integration panels per frame that other explanations need.

    Returns
    -------
    Piece

    Raises
    ------
    FrictrackError
        If the run has fewer than `MIN_RUN_FRAMES` frames.

    """
    layout, p = extend_layout(truth, truth.problem.layout.span, design.phase)
    fine = max([fine, *(e.fine for e in truth.problem.model.effects)])
    piece = blank_piece(conditions_from_fit(truth), design, len(layout.run_names) - 1, fine)
    return integrate_motion(LeastSquaresProblem(layout.model, layout, [piece]), p, design)


def integrate_motion(problem: LeastSquaresProblem, p: Array, design: RunDesign) -> Piece:
    """Integrate the motion of the only piece of a problem, up to where the mass stops or leaves the course.

    Parameters
    ----------
    problem
        Problem with one piece.
    p
        Parameters, (P,).
    design
        The planned run.

    Returns
    -------
    Piece

    Raises
    ------
    FrictrackError
        If the run has fewer than `MIN_RUN_FRAMES` frames.

    """
    piece = problem.pieces[0]
    found = problem.evaluate(p, [np.array(design.start)])[0]
    x, v = found.motion.x_edge[piece.at], found.motion.v_edge[piece.at]
    n = _visible_frames(x, np.sign(design.start[1]) * v, design.course)
    if n < MIN_RUN_FRAMES:
        raise FrictrackError(f"expected a run of at least {MIN_RUN_FRAMES} frames but the mass would be gone after {n}")
    simulated = replace(piece, x_hat=found.motion.x, v_hat=found.motion.v, a_hat=found.motion.a, y=found.model_y)
    return simulated.first(n)


def _visible_frames(x: Array, speed: Array, course: tuple[float, float]) -> int:
    """Number of frames until the mass stops or leaves the course."""
    over = np.flatnonzero((speed < MIN_VISIBLE_SPEED) | (x < course[0] - 1e-9) | (x > course[1] + 1e-9))
    return int(over[0]) if len(over) else len(x)


@dataclass(frozen=True)
class RunConditions:
    """Conditions common to all planned runs.

    Parameters
    ----------
    fps
        Frames per second.
    noise
        Standard deviation of the position per frame, m.
    mass
        Mass, kg.
    deceleration
        Typical deceleration by friction, m/s^2.
    path
        Known properties of a run beside its motion.
    incline
        Incline, rad.
    reference_piece
        Run whose measured drive, vertical motion and angle are repeated.

    """

    fps: float
    noise: float
    mass: float
    deceleration: float
    path: Path
    incline: float = 0.0
    reference_piece: Piece | None = None


def conditions_from_fit(solution: Solution) -> RunConditions:
    """Conditions of the filmed runs of a fit."""
    reference_piece = longest_piece(solution.problem.pieces)
    return RunConditions(
        fps=solution.problem.layout.spans[0].fps,
        noise=float(np.median(np.concatenate([piece.noise for piece in solution.problem.pieces]))),
        mass=reference_piece.mass,
        deceleration=_deceleration(solution),
        path=reference_piece.path,
        incline=incline_of(reference_piece),
        reference_piece=reference_piece,
    )


def blank_piece(conditions: RunConditions, design: RunDesign, run: int, fine: int = 1) -> Piece:
    """Make the piece of a planned run whose motion is not yet simulated.

    Parameters
    ----------
    conditions
        Conditions common to all planned runs.
    design
        The planned run.
    run
        Index of the run in its problem.
    fine
        Integration panels per frame.

    Returns
    -------
    Piece

    """
    fps, s = conditions.fps * design.rate, float(np.sign(design.start[1]))
    n = int(np.clip(fps * _seconds(conditions, design, s), MIN_RUN_FRAMES, min(design.frames, MAX_FRAMES) - 1)) + 1
    panels = Panels(np.arange((n - 1) * fine + 1) / (fps * fine))
    path, known, mass = _conditions_at_nodes(conditions, design, panels.t, s)
    t = np.arange(n) / fps
    return Piece(
        run=run,
        frames=np.arange(n),
        t=t,
        y=np.full(n, design.start[0]),
        sigma=np.full(n, conditions.noise * design.pitch),
        panels=panels,
        at=np.arange(n) * fine,
        per_frame=fine,
        x_hat=design.start[0] + design.start[1] * panels.t,
        v_hat=np.full_like(panels.t, design.start[1]),
        a_hat=known - s * conditions.deceleration,
        known=known,
        path=path,
        mass=mass,
        way=np.array([[0.0], [design.start[0]], [design.start[1]]]),
        angle=_repeat_series(
            conditions.reference_piece,
            None if conditions.reference_piece is None else conditions.reference_piece.angle,
            t,
            at_frames=True,
        ),
    )


def _seconds(conditions: RunConditions, design: RunDesign, s: float) -> float:
    """Time within which the mass stops or leaves the course, s."""
    if conditions.reference_piece is not None and conditions.reference_piece.path.drive is not None:
        return float(conditions.reference_piece.t[-1] - conditions.reference_piece.t[0])
    reach = (design.course[1] - design.start[0]) if s > 0 else (design.start[0] - design.course[0])
    return STOP_TIME_MARGIN * min(
        abs(design.start[1]) / conditions.deceleration, reach / max(0.5 * abs(design.start[1]), MIN_VISIBLE_SPEED)
    )


def _deceleration(solution: Solution) -> float:
    """Typical deceleration by friction, m/s^2."""
    a = np.concatenate([r.piece.path.s * (r.piece.known - r.motion.a) for r in solution.responses])
    return max(float(np.median(a)), 0.1)


def _conditions_at_nodes(
    conditions: RunConditions, design: RunDesign, nodes: Array, s: float
) -> tuple[Path, Array, float]:
    """Return path, acceleration by drive and incline at the nodes, and mass of a planned run."""
    old, reference_piece = conditions.path, conditions.reference_piece
    incline = conditions.incline + design.tilt
    load_ratio = float(np.cos(incline) / np.cos(conditions.incline))
    mass = conditions.mass * design.mass
    known = np.full_like(nodes, -GRAVITY * np.sin(incline))
    start_time = 0.0 if reference_piece is None else float(reference_piece.t[0])
    drive_at = None if old.drive_at is None else partial(_scaled, old.drive_at, design.drive, start_time)
    drive = None if drive_at is None else drive_at(nodes)
    if drive is not None:
        known = known + drive / mass
    zeros = np.zeros_like(nodes)
    path = replace(
        old,
        t=nodes,
        x=zeros,
        v=zeros,
        s=zeros + s,
        load=old.load * design.mass * load_ratio,
        mass_ratio=old.mass_ratio * design.mass,
        mass=None if old.mass is None else mass,
        pixel_pitch=None if old.pixel_pitch is None else old.pixel_pitch * design.pitch,
        drive=drive,
        drive_at=drive_at,
        lift=_repeat_series(reference_piece, old.lift, nodes),
        gravity=old.gravity * load_ratio,
        angle=_repeat_series(reference_piece, old.angle, nodes),
        travelled=0.0,
        begins=design.start[0],
        before=np.array([[0.0], [design.start[0]], [design.start[1]]]),
    )
    return path, known, mass


def incline_of(reference_piece: Piece) -> float:
    """Incline of a filmed run, rad."""
    drive = 0.0 if reference_piece.path.drive is None else reference_piece.path.drive / reference_piece.mass
    return float(-np.arcsin(np.clip(np.median(reference_piece.known - drive) / GRAVITY, -1.0, 1.0)))


def _scaled(drive_at: Callable[[Array], Array], factor: float, start_time: float, t: Array) -> Array:
    """The same drive times a factor, from the start of the piece."""
    return factor * np.asarray(drive_at(t + start_time))


def _repeat_series(
    reference_piece: Piece | None, series: Array | None, t: Array, *, at_frames: bool = False
) -> Array | None:
    """A measured series repeated periodically in the planned run; None if none was measured."""
    if reference_piece is None or series is None:
        return None
    period = float(reference_piece.t[-1] - reference_piece.t[0])
    return np.interp(
        reference_piece.t[0] + (t % period), reference_piece.t if at_frames else reference_piece.path.t, series
    )


def expected_scatter(solution: Solution, runs: int) -> float:
    """Expected scatter of the friction level with a given number of runs."""
    known = len(solution.problem.layout.levels) >= MIN_RUNS_FOR_SCATTER or runs < MIN_RUNS_FOR_SCATTER
    return solution.tau_of_other_runs if known else DEFAULT_SCATTER
