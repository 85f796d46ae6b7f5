"""A run that has not been filmed yet: what an explanation says it would look like."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.effects import Path, Span
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import LeastSquaresProblem, Solution
from frictrack.fit.parameters import LEVEL, MIN_RUNS_FOR_SCATTER, ParameterLayout, Slot
from frictrack.fit.segments import MIN_FRAMES, Piece
from frictrack.records import GRAVITY, Array
from frictrack.simulate.dynamics import Panels

PLANNED_RUN_NAME = "next run"
MIN_VISIBLE_SPEED = 0.01  # m/s, below which a camera no longer sees the mass move
STOP_TIME_MARGIN = 1.5  # times the time that the usual deceleration needs to stop the mass: long enough to see it stop
MAX_FRAMES = 3000  # frames of a planned run
MIN_RUN_FRAMES = 3 * MIN_FRAMES  # frames of a run that is worth filming
USUAL_SCATTER = 0.03  # of the friction level, before enough runs tell their own
GOLDEN_ANGLE_RAD = 2.39996  # rad, so that phases of planned runs spread evenly


@dataclass(frozen=True)
class RunDesign:
    """How one planned run is made: start place (m) and speed (m/s), and what differs from the runs that were filmed.

    `mass`, `rate` and `pitch` are factors on the mass, the frames per second and the metres per pixel; `tilt` (rad) is
    added to the incline; `drive` is a factor on the drive where one was measured. The run ends where the mass leaves
    the stretch `course` (m) or stops.
    """

    start: tuple[float, float]
    course: tuple[float, float]
    mass: float = 1.0
    tilt: float = 0.0
    rate: float = 1.0
    pitch: float = 1.0
    drive: float = 1.0
    phase: float = GOLDEN_ANGLE_RAD


def template_piece(pieces: Sequence[Piece]) -> Piece:
    """The piece that a planned run is modelled on: the longest."""
    return max(pieces, key=lambda p: p.t[-1] - p.t[0])


def extend_layout(solution: Solution, span: Span, phase: float, *, free: bool = False) -> tuple[ParameterLayout, Array]:
    """The unknowns of an explanation with one run more, (P',): what is the run's own is as in the other runs.

    A cause that most runs do not show stays away in the new run too, unless it is `free` to come.
    """
    old = solution.problem.layout
    runs = len(old.run_names)
    rare = {e.name for e in old.model.effects if sum(a == e.name for a, _ in old.absent) > runs / 2}
    away = set() if free else {(name, runs) for name in rare}
    layout = replace(
        old, run_names=(*old.run_names, PLANNED_RUN_NAME), spans=(*old.spans, span), absent=old.absent | away
    )
    there = dict(zip(old.names, solution.p, strict=True))
    roles = {(e.name, p.name): p.role for e in old.model.effects for p in e.parameters}
    p = []
    for name, slot in zip(layout.names, layout.slots, strict=True):
        others = [v for s, v in zip(old.slots, solution.p, strict=True) if _is_same_parameter(s, slot)]
        if name in there:
            p.append(there[name])
        elif slot.effect == LEVEL:
            p.append(1.0)
        elif roles[slot.effect, slot.parameter] == "phase":
            p.append(phase)
        else:
            p.append(float(np.mean(others)) if others else 0.0)
    return layout, np.array(p)


def _is_same_parameter(a: Slot, b: Slot) -> bool:
    return (a.effect, a.parameter) == (b.effect, b.parameter)


def simulate_run(truth: Solution, film: RunDesign, fine: int = 1) -> Piece:
    """What the camera would see of a planned run if this explanation were true: without noise, and its sigma.

    `fine` is the number of panels per frame that other explanations need. Raises FrictrackError where the mass does
    not get far enough to be judged.
    """
    layout, p = extend_layout(truth, truth.problem.layout.span, film.phase)
    fine = max([fine, *(e.fine for e in truth.problem.model.effects)])
    piece = blank_piece(conditions_of(truth), film, len(layout.run_names) - 1, fine)
    return integrate_motion(LeastSquaresProblem(layout.model, layout, [piece]), p, film)


def integrate_motion(problem: LeastSquaresProblem, p: Array, film: RunDesign) -> Piece:
    """The one piece of a problem with the motion that a law gives it, up to where the mass stops or is gone."""
    piece = problem.pieces[0]
    found = problem.evaluate(p, [np.array(film.start)])[0]
    x, v = found.motion.x_edge[piece.at], found.motion.v_edge[piece.at]
    n = _kept(x, np.sign(film.start[1]) * v, film.course)
    if n < MIN_RUN_FRAMES:
        raise FrictrackError(f"expected a run of at least {MIN_RUN_FRAMES} frames but the mass would be gone after {n}")
    seen = replace(piece, x_hat=found.motion.x, v_hat=found.motion.v, a_hat=found.motion.a, y=found.model_y)
    return seen.first(n)


def _kept(x: Array, speed: Array, course: tuple[float, float]) -> int:
    """Frames until the mass stops or leaves the course."""
    over = np.flatnonzero((speed < MIN_VISIBLE_SPEED) | (x < course[0] - 1e-9) | (x > course[1] + 1e-9))
    return int(over[0]) if len(over) else len(x)


@dataclass(frozen=True)
class RunConditions:
    """What holds for every planned run: frames per second, noise (m), mass (kg), incline (rad), usual deceleration.

    `path` holds what is known of a run beside its motion; `like` is a run after whose drive, vertical motion and angle
    the planned ones are modelled, where such were measured.
    """

    fps: float
    noise: float
    mass: float
    slowing: float
    path: Path
    incline: float = 0.0
    like: Piece | None = None


def conditions_of(solution: Solution) -> RunConditions:
    """The bench as the runs at hand show it."""
    like = template_piece(solution.problem.pieces)
    return RunConditions(
        fps=solution.problem.layout.spans[0].fps,
        noise=float(np.median(np.concatenate([piece.noise for piece in solution.problem.pieces]))),
        mass=like.mass,
        slowing=_deceleration(solution),
        path=like.path,
        incline=_incline(like),
        like=like,
    )


def blank_piece(bench: RunConditions, film: RunDesign, run: int, fine: int = 1) -> Piece:
    """A piece for a planned run, the `run`-th of its problem, whose motion is still to be simulated."""
    fps, s = bench.fps * film.rate, float(np.sign(film.start[1]))
    n = int(np.clip(fps * _seconds(bench, film, s), MIN_RUN_FRAMES, MAX_FRAMES)) + 1
    panels = Panels(np.arange((n - 1) * fine + 1) / (fps * fine))
    path, known, mass = _circumstances(bench, film, panels.t, s)
    t = np.arange(n) / fps
    return Piece(
        run=run,
        frames=np.arange(n),
        t=t,
        y=np.full(n, film.start[0]),
        sigma=np.full(n, bench.noise * film.pitch),
        panels=panels,
        at=np.arange(n) * fine,
        per_frame=fine,
        x_hat=film.start[0] + film.start[1] * panels.t,
        v_hat=np.full_like(panels.t, film.start[1]),
        a_hat=known - s * bench.slowing,
        known=known,
        path=path,
        mass=mass,
        way=np.array([[0.0], [film.start[0]], [film.start[1]]]),
        angle=_again(bench.like, None if bench.like is None else bench.like.angle, t, at_frames=True),
    )


def _seconds(bench: RunConditions, film: RunDesign, s: float) -> float:
    """Time within which the mass has stopped or left the course."""
    if bench.like is not None and bench.like.path.drive is not None:
        return float(bench.like.t[-1] - bench.like.t[0])
    reach = (film.course[1] - film.start[0]) if s > 0 else (film.start[0] - film.course[0])
    return STOP_TIME_MARGIN * min(
        abs(film.start[1]) / bench.slowing, reach / max(0.5 * abs(film.start[1]), MIN_VISIBLE_SPEED)
    )


def _deceleration(solution: Solution) -> float:
    """Usual deceleration by friction, m/s^2."""
    a = np.concatenate([r.piece.path.s * (r.piece.known - r.motion.a) for r in solution.responses])
    return max(float(np.median(a)), 0.1)


def _circumstances(bench: RunConditions, film: RunDesign, nodes: Array, s: float) -> tuple[Path, Array, float]:
    """What is known of the planned run along its nodes, the acceleration by drive and incline there, and the mass."""
    old, like = bench.path, bench.like
    incline = bench.incline + film.tilt
    lean = float(np.cos(incline) / np.cos(bench.incline))
    mass = bench.mass * film.mass
    known = np.full_like(nodes, -GRAVITY * np.sin(incline))
    begin = 0.0 if like is None else float(like.t[0])
    drive_at = None if old.drive_at is None else _scaled(old.drive_at, film.drive, begin)
    drive = None if drive_at is None else drive_at(nodes)
    if drive is not None:
        known = known + drive / mass
    still = np.zeros_like(nodes)
    path = replace(
        old,
        t=nodes,
        x=still,
        v=still,
        s=still + s,
        load=old.load * film.mass * lean,
        mass_ratio=old.mass_ratio * film.mass,
        mass=None if old.mass is None else mass,
        pixel_pitch=None if old.pixel_pitch is None else old.pixel_pitch * film.pitch,
        drive=drive,
        drive_at=drive_at,
        lift=_again(like, old.lift, nodes),
        gravity=old.gravity * lean,
        angle=_again(like, old.angle, nodes),
        travelled=0.0,
        begins=film.start[0],
        before=np.array([[0.0], [film.start[0]], [film.start[1]]]),
    )
    return path, known, mass


def _incline(like: Piece) -> float:
    """Incline of a run that was filmed, rad."""
    drive = 0.0 if like.path.drive is None else like.path.drive / like.mass
    return float(-np.arcsin(np.clip(np.median(like.known - drive) / GRAVITY, -1.0, 1.0)))


def _scaled(drive_at: Callable[[Array], Array], factor: float, begin: float) -> Callable[[Array], Array]:
    """The same drive in another strength, from the start of the piece."""

    def at(t: Array) -> Array:
        return factor * np.asarray(drive_at(t + begin))

    return at


def _again(like: Piece | None, series: Array | None, t: Array, *, at_frames: bool = False) -> Array | None:
    """What was measured beside a run, taken to come again in the planned one; None where nothing was."""
    if like is None or series is None:
        return None
    period = float(like.t[-1] - like.t[0])
    return np.interp(like.t[0] + (t % period), like.t if at_frames else like.path.t, series)


def expected_scatter(solution: Solution, runs: int) -> float:
    """Scatter of the friction level to be expected when there are so many runs."""
    known = len(solution.problem.layout.levels) >= MIN_RUNS_FOR_SCATTER or runs < MIN_RUNS_FOR_SCATTER
    return max(solution.tau, 1e-3) if known else USUAL_SCATTER
