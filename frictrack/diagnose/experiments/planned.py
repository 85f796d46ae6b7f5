"""A run that has not been filmed yet: what an explanation says it would look like."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.effects import Path, Span
from frictrack.errors import FrictrackError
from frictrack.fit.simulated.pieces import MIN_FRAMES, Piece
from frictrack.fit.simulated.problem import Problem
from frictrack.fit.simulated.solve import Solution
from frictrack.fit.unknowns.layout import LEVEL, MIN_RUNS, Layout, Slot
from frictrack.records import GRAVITY, Array
from frictrack.simulate.dynamics import Panels

NAME = "next run"
STOPPED = 0.01  # m/s, below which a camera no longer sees the mass move
MARGIN = 1.5  # times the time that the usual deceleration needs to stop the mass: long enough to see it stop
LONGEST = 3000  # frames of a planned run
LEAST = 3 * MIN_FRAMES  # frames of a run that is worth filming
USUAL_SCATTER = 0.03  # of the friction level, before enough runs tell their own
GOLDEN = 2.39996  # rad, so that phases of planned runs spread evenly


@dataclass(frozen=True)
class Film:
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
    phase: float = GOLDEN


def template(pieces: Sequence[Piece]) -> Piece:
    """The piece that a planned run is modelled on: the longest."""
    return max(pieces, key=lambda p: p.t[-1] - p.t[0])


def extended(solution: Solution, span: Span, phase: float, *, free: bool = False) -> tuple[Layout, Array]:
    """The unknowns of an explanation with one run more, (P',): what is the run's own is as in the other runs.

    A cause that most runs do not show stays away in the new run too, unless it is `free` to come.
    """
    old = solution.problem.layout
    runs = len(old.run_names)
    rare = {e.name for e in old.model.effects if sum(a == e.name for a, _ in old.absent) > runs / 2}
    away = set() if free else {(name, runs) for name in rare}
    layout = replace(old, run_names=(*old.run_names, NAME), spans=(*old.spans, span), absent=old.absent | away)
    there = dict(zip(old.names, solution.p, strict=True))
    roles = {(e.name, p.name): p.role for e in old.model.effects for p in e.parameters}
    p = []
    for name, slot in zip(layout.names, layout.slots, strict=True):
        others = [v for s, v in zip(old.slots, solution.p, strict=True) if _alike(s, slot)]
        if name in there:
            p.append(there[name])
        elif slot.effect == LEVEL:
            p.append(1.0)
        elif roles[slot.effect, slot.parameter] == "phase":
            p.append(phase)
        else:
            p.append(float(np.mean(others)) if others else 0.0)
    return layout, np.array(p)


def _alike(a: Slot, b: Slot) -> bool:
    return (a.effect, a.parameter) == (b.effect, b.parameter)


def filmed(truth: Solution, film: Film, fine: int = 1) -> Piece:
    """What the camera would see of a planned run if this explanation were true: without noise, and its sigma.

    `fine` is the number of panels per frame that other explanations need. Raises FrictrackError where the mass does
    not get far enough to be judged.
    """
    layout, p = extended(truth, truth.problem.layout.span, film.phase)
    blank = _blank(truth, film, max([fine, *(e.fine for e in truth.problem.model.effects)]))
    problem = Problem(layout.model, layout, [blank])
    found = problem.evaluate(p, [np.array(film.start)])[0]
    x, v = found.motion.x_edge[blank.at], found.motion.v_edge[blank.at]
    n = _kept(x, np.sign(film.start[1]) * v, film.course)
    if n < LEAST:
        raise FrictrackError(f"expected a run of at least {LEAST} frames but the mass would be gone after {n}")
    seen = replace(blank, x_hat=found.motion.x, v_hat=found.motion.v, a_hat=found.motion.a, y=found.model_y)
    return seen.first(n)


def _kept(x: Array, speed: Array, course: tuple[float, float]) -> int:
    """Frames until the mass stops or leaves the course."""
    over = np.flatnonzero((speed < STOPPED) | (x < course[0] - 1e-9) | (x > course[1] + 1e-9))
    return int(over[0]) if len(over) else len(x)


def _blank(truth: Solution, film: Film, fine: int) -> Piece:
    """A piece for the planned run whose motion is still to be simulated."""
    like = template(truth.problem.pieces)
    fps = truth.problem.layout.spans[0].fps * film.rate
    s = float(np.sign(film.start[1]))
    slowing = _deceleration(truth)
    reach = (film.course[1] - film.start[0]) if s > 0 else (film.start[0] - film.course[0])
    stops = abs(film.start[1]) / slowing
    leaves = reach / max(0.5 * abs(film.start[1]), STOPPED)
    n = int(np.clip(fps * MARGIN * min(stops, leaves), LEAST, LONGEST)) + 1
    if like.path.drive is not None:
        n = int(np.clip(fps * (like.t[-1] - like.t[0]), LEAST, LONGEST)) + 1
    panels = Panels(np.arange((n - 1) * fine + 1) / (fps * fine))
    path, known, mass = _circumstances(truth, film, panels.t, s)
    noise = float(np.median(np.concatenate([piece.sigma for piece in truth.problem.pieces])))
    t = np.arange(n) / fps
    return Piece(
        run=len(truth.problem.layout.run_names),
        frames=np.arange(n),
        t=t,
        y=np.full(n, film.start[0]),
        sigma=np.full(n, noise * film.pitch),
        panels=panels,
        at=np.arange(n) * fine,
        per_frame=fine,
        x_hat=film.start[0] + film.start[1] * panels.t,
        v_hat=np.full_like(panels.t, film.start[1]),
        a_hat=known - s * slowing,
        known=known,
        path=path,
        mass=mass,
        way=np.array([[0.0], [film.start[0]], [film.start[1]]]),
        angle=None if like.angle is None else _again(like, like.angle, like.t, t),
    )


def _deceleration(solution: Solution) -> float:
    """Usual deceleration by friction, m/s^2."""
    a = np.concatenate([r.piece.path.s * (r.piece.known - r.motion.a) for r in solution.responses])
    return max(float(np.median(a)), 0.1)


def _circumstances(truth: Solution, film: Film, nodes: Array, s: float) -> tuple[Path, Array, float]:
    """What is known of the planned run along its nodes, the acceleration by drive and incline there, and the mass."""
    like = template(truth.problem.pieces)
    old = like.path
    incline = _incline(like) + film.tilt
    lean = float(np.cos(incline) / np.cos(_incline(like)))
    mass = like.mass * film.mass
    known = np.full_like(nodes, -GRAVITY * np.sin(incline))
    drive_at = None if old.drive_at is None else _scaled(old.drive_at, film.drive, like.t[0])
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
        lift=None if old.lift is None else _again(like, old.lift, old.t, nodes),
        gravity=old.gravity * lean,
        angle=None if old.angle is None else _again(like, old.angle, old.t, nodes),
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


def _again(like: Piece, series: Array, times: Array, t: Array) -> Array:
    """What was measured beside a run, taken to come again in the planned one."""
    period = float(like.t[-1] - like.t[0])
    return np.interp(like.t[0] + (t % period), times, series)


def spread(solution: Solution, runs: int) -> float:
    """Scatter of the friction level to be expected when there are so many runs."""
    known = len(solution.problem.layout.levels) >= MIN_RUNS or runs < MIN_RUNS
    return max(solution.tau, 1e-3) if known else USUAL_SCATTER
