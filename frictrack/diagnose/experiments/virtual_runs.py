"""Make virtual runs: what the camera would measure, without noise, in a run that has not been filmed yet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.effects import Path, Span
from frictrack.fit.cutting import MIN_FRAMES
from frictrack.fit.least_squares import LeastSquaresProblem, PieceResponse, Solution
from frictrack.fit.parameters import LEVEL, MIN_RUNS_FOR_SCATTER, ParameterLayout
from frictrack.fit.pieces import Piece, spans_of
from frictrack.records import GRAVITY, Array
from frictrack.settings.costs import DEFAULT_COSTS, Costs, RunSettings
from frictrack.simulate.dynamics import CollocationSolution, LinearResponse, Panels

PLANNED_RUN_NAME = "next run"
MIN_VISIBLE_SPEED = 0.01  # m/s; a slower mass counts as stopped
STOP_TIME_MARGIN = 1.5  # times the stopping time at the typical deceleration
MAX_FRAMES = 3000  # of a planned run
MIN_RUN_FRAMES = 3 * MIN_FRAMES  # of a run that is worth filming
DEFAULT_SCATTER = 0.03  # relative, of the friction level, if there are too few runs to estimate it
MIN_SPEED_LEFT = 0.1  # of the start speed, at the end of a film that ended before the motion did
MIN_COURSE_LEFT = 0.2  # of the course, in front of the mass at the end of such a film
GOLDEN_ANGLE_RAD = 2.39996  # rad; phases of successive runs spread evenly

Unknowns = tuple[ParameterLayout, Array]  # their layout and values (P,)


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
    key, words
        What it is called, and the instruction without its reason.

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
    key: str = field(default="", compare=False)
    words: str = field(default="", compare=False)

    def changed(self, key: str, words: str, **changes: Any) -> RunDesign:
        """Return it with another key and instruction, and other changes."""
        return replace(self, key=key, words=words, **changes)

    @property
    def direction(self) -> float:
        """Sign of the velocity."""
        return float(np.sign(self.start[1]))


@dataclass(frozen=True)
class RunConditions:
    """What all planned runs have in common.

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
        Known properties of a run without its motion.
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

    @classmethod
    def of_fit(cls, solution: Solution) -> RunConditions:
        """Conditions of the filmed runs of a fit; the longest of them is repeated."""
        pieces = solution.problem.pieces
        longest = max(pieces, key=lambda p: p.t[-1] - p.t[0])
        friction = [r.piece.path.s * (r.piece.known - r.motion.a) for r in solution.responses]
        return cls(
            fps=solution.problem.layout.spans[0].fps,
            noise=float(np.median(np.concatenate([piece.noise for piece in pieces]))),
            mass=longest.mass,
            deceleration=max(float(np.median(np.concatenate(friction))), 0.1),
            path=longest.path,
            incline=_incline(longest),
            reference_piece=longest,
        )

    def settings(self, design: RunDesign) -> RunSettings:
        """Settings of a planned run."""
        mass, incline = self.mass * design.mass, self.incline + design.tilt
        return RunSettings(design.start[1], mass, incline, self.fps * design.rate, design.pitch)

    def blank_piece(self, design: RunDesign, run: int, fine: int) -> Piece:
        """Piece of a planned run whose motion is not yet simulated, with `fine` integration panels per frame."""
        fps, s = self.fps * design.rate, design.direction
        n = int(np.clip(fps * self._seconds(design), MIN_RUN_FRAMES, min(design.frames, MAX_FRAMES) - 1)) + 1
        panels, t = Panels(np.arange((n - 1) * fine + 1) / (fps * fine)), np.arange(n) / fps
        path, known = self._path_at_nodes(design, panels.t)
        reference = self.reference_piece
        return Piece(
            run=run,
            frames=np.arange(n),
            t=t,
            y=np.full(n, design.start[0]),
            sigma=np.full(n, self.noise * design.pitch),
            panels=panels,
            at=np.arange(n) * fine,
            per_frame=fine,
            x_hat=design.start[0] + design.start[1] * panels.t,
            v_hat=np.full_like(panels.t, design.start[1]),
            a_hat=known - s * self.deceleration,
            known=known,
            path=path,
            mass=self.mass * design.mass,
            way=np.array([[0.0], [design.start[0]], [design.start[1]]]),
            angle=None if reference is None else _repeated(reference.t, reference.angle, reference, t),
        )

    def _seconds(self, design: RunDesign) -> float:
        """Time within which the mass stops or leaves the course, s."""
        if self.reference_piece is not None and self.path.drive is not None:
            return float(self.reference_piece.t[-1] - self.reference_piece.t[0])
        speed = abs(design.start[1])
        reach = design.course[1] - design.start[0] if design.direction > 0 else design.start[0] - design.course[0]
        return STOP_TIME_MARGIN * min(speed / self.deceleration, reach / max(0.5 * speed, MIN_VISIBLE_SPEED))

    def _path_at_nodes(self, design: RunDesign, t: Array) -> tuple[Path, Array]:
        """Path at the nodes of a planned run, and its acceleration by drive and incline."""
        old, reference, zeros = self.path, self.reference_piece, np.zeros_like(t)
        incline, mass = self.incline + design.tilt, self.mass * design.mass
        load_ratio = float(np.cos(incline) / np.cos(self.incline))
        known, series = zeros - GRAVITY * np.sin(incline), dict[str, Any]()
        drive_at: Callable[[Array], Array] | None = None
        if reference is not None:
            series = {n: _repeated(reference.path.t, getattr(old, n), reference, t) for n in ("lift", "angle")}
            if old.drive_at is not None:
                drive_at = partial(_scaled, old.drive_at, design.drive, reference.t[0])
                series["drive"] = drive = drive_at(t)
                known = known + drive / mass
        path = replace(
            old,
            t=t,
            x=zeros,
            v=zeros,
            s=zeros + design.direction,
            load=old.load * design.mass * load_ratio,
            mass_ratio=old.mass_ratio * design.mass,
            mass=None if old.mass is None else mass,
            pixel_pitch=None if old.pixel_pitch is None else old.pixel_pitch * design.pitch,
            drive_at=drive_at,
            gravity=old.gravity * load_ratio,
            travelled=0.0,
            begins=design.start[0],
            before=np.array([[0.0], [design.start[0]], [design.start[1]]]),
            **series,
        )
        return path, known


def _incline(piece: Piece) -> float:
    """Incline of a filmed run, rad."""
    drive = 0.0 if piece.path.drive is None else piece.path.drive / piece.mass
    return float(-np.arcsin(np.clip(np.median(piece.known - drive) / GRAVITY, -1.0, 1.0)))


def _scaled(drive_at: Callable[[Array], Array], factor: float, begin: float, t: Array) -> Array:
    """The same drive times a factor, from the start of the piece."""
    return factor * np.asarray(drive_at(t + begin))


def _repeated(times: Array, series: Array | None, reference: Piece, t: Array) -> Array | None:
    """A measured series repeated periodically in the planned run; None if none was measured."""
    period = float(reference.t[-1] - reference.t[0])
    return None if series is None else np.interp(reference.t[0] + (t % period), times, series)


def last_settings(solution: Solution) -> RunSettings:
    """Settings of the last run of a fit: what is on the table now."""
    layout = solution.problem.layout
    run = len(layout.run_names) - 1
    piece, start = next((p, s) for p, s in zip(solution.problem.pieces, solution.starts, strict=True) if p.run == run)
    return RunSettings(float(start[1]), piece.mass, _incline(piece), layout.spans[0].fps)


def max_frames_of_film(solution: Solution, costs: Costs = DEFAULT_COSTS) -> float:
    """Largest number of frames in a film of this set-up: as declared, or else as far as its runs show.

    The longest run shows it if its film ended while the mass still moved, and well within the course of the runs.
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


def expected_scatter(solution: Solution, runs: int) -> float:
    """Expected scatter of the friction level with a given number of runs."""
    known = len(solution.problem.layout.levels) >= MIN_RUNS_FOR_SCATTER or runs < MIN_RUNS_FOR_SCATTER
    return solution.tau_of_other_runs if known else DEFAULT_SCATTER


def extend_layout(solution: Solution, span: Span, phase: float, *, free: bool = False) -> Unknowns:
    """Extend the parameters of a fit by one run, whose own parameters are the mean over the other runs.

    With `free`, an effect that is absent from most runs may occur in the new one.
    """
    old = solution.problem.layout
    runs = len(old.run_names)
    rare = {e.name for e in old.model.effects if sum(a == e.name for a, _ in old.absent) > runs / 2}
    layout = replace(
        old,
        run_names=(*old.run_names, PLANNED_RUN_NAME),
        spans=(*old.spans, span),
        absent=old.absent if free else old.absent | {(name, runs) for name in rare},
    )
    known = dict(zip(old.names, solution.p.tolist(), strict=True))
    of_runs: dict[tuple[str, str], list[float]] = {}
    for slot, value in zip(old.slots, solution.p.tolist(), strict=True):
        of_runs.setdefault((slot.effect, slot.parameter), []).append(value)
    roles = roles_of(layout)

    def first_value(effect: str, parameter: str) -> float:
        if effect == LEVEL:
            return 1.0
        return phase if roles[effect, parameter] == "phase" else float(np.mean(of_runs.get((effect, parameter), 0.0)))

    pairs = zip(layout.names, layout.slots, strict=True)
    return layout, np.array([known[n] if n in known else first_value(s.effect, s.parameter) for n, s in pairs])


def roles_of(layout: ParameterLayout) -> dict[tuple[str, str], str]:
    """Role of every parameter, by effect and name."""
    return {(e.name, q.name): q.role for e in layout.model.effects for q in e.parameters}


class LinearisedRun(LeastSquaresProblem):
    """A model in one run, linearised along a motion that it would have to reproduce, by one Newton step from there.

    That motion is what the camera would measure, so a model that follows it is linearised where it ends. A model with
    memory has to be simulated.
    """

    def __init__(self, layout: ParameterLayout, piece: Piece, start: Sequence[float] | Array) -> None:
        super().__init__(layout.model, layout, [piece])
        self.first_start = np.array(start)
        self._linear: LinearResponse | None = None  # of the first evaluation; near the motion it hardly changes

    def respond(self, p: Array) -> PieceResponse:
        """Residual and sensitivities of the run at unknowns p (P,)."""
        return self.evaluate(p, [self.first_start])[0]

    def evaluate(self, p: Array, starts: Sequence[Array]) -> list[PieceResponse]:
        """Residual and sensitivities of the run at unknowns p (P,) and its start; raises FrictrackError beyond numbers.

        A law that speeds the mass up grows without limit along a long run.
        """
        if self.model.memory:
            return super().evaluate(p, starts)
        piece = self._with_rival_clock(self.pieces[0], p)
        begin = self.first_start * np.array([1.0, self.pieces[0].clock / piece.clock])
        edges = piece.panels.integrate(piece.a_hat, *begin)[2:]
        motion = CollocationSolution(piece.panels, piece.x_hat, piece.v_hat, piece.a_hat, *edges)
        law = self.law_of(piece, p)
        if self._linear is None:
            own, self._linear = law.linearised(motion)
        else:
            own = law.accelerations(motion)
        moved = self._linear.respond((own - motion.a)[:, None], (starts[0] - begin)[:, None])[1]
        x = motion.x_edge[piece.at] + moved[piece.at, 0, 0]
        if not np.all(np.isfinite(x)):
            raise FrictrackError("the planned motion cannot be integrated under this law")
        response = self.linearised_response(piece, p, (motion, self._linear), x)
        return [replace(response, r_full=response.r)]  # linear in the start: the best one is known

    def _with_rival_clock(self, piece: Piece, p: Array) -> Piece:
        """The run with the clock rate that the model gives to it."""
        if all(e.clock is None for e in self.model.effects):
            return piece
        return piece.with_clock(self.model.clock(self.layout.values(p, piece.run)[0]))


@dataclass(eq=False)
class VirtualRun:
    """A planned run as a model predicts it: the last run of a layout.

    Parameters
    ----------
    design
        The design of the run.
    piece
        What the camera would measure, without noise.
    layout, p
        The unknowns of the model with those of the run, and their values (P,).

    """

    design: RunDesign
    piece: Piece
    layout: ParameterLayout
    p: Array

    @cached_property
    def response(self) -> PieceResponse:
        """The run with its sensitivities to the unknowns."""
        return LinearisedRun(self.layout, self.piece, self.design.start).respond(self.p)

    def columns_of_law(self, without: str = "") -> Array:
        """Sensitivities (n, P') to the unknowns that the runs share, without those of one effect."""
        return self.response.jac[:, [name not in (LEVEL, without) for name in self._effects]]

    @property
    def level_column(self) -> Array:
        """Sensitivity (n, 1) to the friction level."""
        return self.response.jac[:, [name == LEVEL for name in self._effects]]

    @property
    def _effects(self) -> list[str]:
        """The effect that each column (n, P) of its sensitivities belongs to."""
        return [self.layout.slots[i].effect for i in self.response.active]


def make_run(
    conditions: RunConditions, design: RunDesign, unknowns: Callable[[Span], Unknowns], near: Span, fine: int = 1
) -> VirtualRun:
    """Simulate a planned run of a model. Its unknowns depend on the span of the run, the last one in their layout.

    `near` is a span near that of the run, which is not known yet. Raises FrictrackError if the run has fewer than
    `MIN_RUN_FRAMES` frames, or cannot be integrated.
    """
    layout, p = unknowns(near)
    piece = conditions.blank_piece(design, len(layout.run_names) - 1, fine)
    found = LeastSquaresProblem(layout.model, layout, [piece]).evaluate(p, [np.array(design.start)])[0]
    n = _visible_frames(found, design)
    if n < MIN_RUN_FRAMES:
        raise FrictrackError(f"expected a run of at least {MIN_RUN_FRAMES} frames but the mass would be gone after {n}")
    motion = found.motion
    piece = replace(piece, x_hat=motion.x, v_hat=motion.v, a_hat=motion.a, y=found.model_y).part(0, n)
    return VirtualRun(design, piece, *unknowns(spans_of([replace(piece, run=0)], 1, conditions.fps * design.rate)[0]))


def _visible_frames(found: PieceResponse, design: RunDesign) -> int:
    """Number of frames until the mass stops or leaves the course."""
    x, v = (edge[found.piece.at] for edge in (found.motion.x_edge, found.motion.v_edge))
    (low, high), slow = design.course, design.direction * v < MIN_VISIBLE_SPEED
    over = np.flatnonzero(slow | (x < low - 1e-9) | (x > high + 1e-9))
    return int(over[0]) if len(over) else len(x)


def simulate_run(truth: Solution, design: RunDesign, fine: int = 1) -> VirtualRun:
    """Simulate a planned run as a fit predicts it, with at least `fine` panels per frame that other models need."""
    fine = max([fine, *(e.fine for e in truth.problem.model.effects)])
    near = truth.problem.layout.span
    return make_run(
        RunConditions.of_fit(truth), design, lambda span: extend_layout(truth, span, design.phase), near, fine
    )
