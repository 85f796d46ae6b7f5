"""Simulate the motion of the slider under a sum of effects: m x'' = D - F, with sticking, release and reversal.

Between stops the direction of motion s is fixed, so the law is smooth and the collocation integrator keeps its order.
At v = 0 the mass sticks while the drive lies between the friction of starting backward and that of starting forward,
both of which the model gives. A law whose force does not jump at a reversal is integrated through it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from frictrack.base.arguments import checked
from frictrack.base.errors import FrictrackError, result_or_none
from frictrack.effects import Path, direction_of_motion
from frictrack.effects.models import Model, Values
from frictrack.records import GRAVITY, Array, EarlierRuns
from frictrack.simulate.dynamics import (
    MEMORY_TOLERANCE_M,
    NODES,
    NOT_INTEGRATED,
    CollocationSolution,
    LinearResponse,
    Panels,
    solve_motion,
    solve_simplified_newton,
)


@dataclass(frozen=True)
class Conditions:
    """Conditions of one simulated run.

    Functions of time take t (n,), s since release, and return (n,).

    Attributes
    ----------
    mass
        Mass of the slider, kg.
    load, mass_ratio
        Normal load and mass, each over its reference.
    pixel_pitch
        Object size of one pixel, m; None where no camera is simulated.
    incline
        Angle by which the course rises toward +x, rad.
    curvature, lowest
        Curvature of a course that bends upward, 1/m, and where it is level, m; NaN where the circle lies flat.
    drive
        Drive force, N; None for none.
    lift
        Vertical acceleration, m/s^2, positive upward; None for none.
    angle
        Angle of the target, rad, counter-clockwise; None for none.
    clamp_x, beam_length
        Place of the clamp and length of the beam under the course, m.
    earlier
        For every run before, the rest since its end (s) and the distance slid in it (m); None where it is not known.

    """

    mass: float
    load: float = 1.0
    mass_ratio: float = 1.0
    pixel_pitch: float | None = None
    incline: float = 0.0
    curvature: float = 0.0
    lowest: float = np.nan
    drive: Callable[[Array], Array] | None = None
    lift: Callable[[Array], Array] | None = None
    angle: Callable[[Array], Array] | None = None
    clamp_x: float | None = None
    beam_length: float | None = None
    earlier: EarlierRuns | None = None

    def path(self, x: Array, v: Array, t: Array, s: float) -> Path:
        """Path of a motion x (m), v (m/s), t (s), each (n,), in direction s (1 or -1) under these conditions."""
        return Path(
            t=t,
            x=x,
            v=v,
            s=np.full(np.shape(t), s),
            load=self.load,
            mass_ratio=self.mass_ratio,
            mass=self.mass,
            pixel_pitch=self.pixel_pitch,
            drive=None if self.drive is None else self.drive(t),
            drive_at=self.drive,
            lift=None if self.lift is None else self.lift(t),
            gravity=GRAVITY * float(np.cos(self.incline)),
            curvature=self.curvature,
            lowest=self.lowest,
            angle=None if self.angle is None else self.angle(t),
            clamp_x=self.clamp_x,
            beam_length=self.beam_length,
            earlier=None if self.earlier is None else (self.earlier,),
        ).pressed()


@checked
def push_force(
    mass: Annotated[float, "kg"], speed: Annotated[float, "m/s"], duration: Annotated[float, "s"]
) -> Callable[[Array], Array]:
    """Drive force of a smooth push that brings a mass from rest to a speed where there is no friction.

    Parameters
    ----------
    mass
        Mass, kg.
    speed
        Speed after the push, m/s; negative toward -x.
    duration
        Time from 0 during which the force acts, s.

    Returns
    -------
    callable
        Function of t (n,), s, that returns the force (n,), N: a squared sine over the duration, else 0.

    Examples
    --------
    >>> force = push_force(0.5, 4.0, 0.01)
    >>> force(np.array([0.0, 0.005, 0.02])).round(9).tolist()
    [0.0, 400.0, 0.0]

    """

    def force(t: Array) -> Array:
        phase = np.clip(np.asarray(t) / duration, 0.0, 1.0)
        return np.asarray(2 * mass * speed / duration * np.sin(np.pi * phase) ** 2)

    return force


class StateHistory:
    """Samples of the motion so far, in order of time.

    Rows are time (s), position (m), velocity (m/s), distance slid (m), direction of motion and friction force (N).
    """

    def __init__(self) -> None:
        self._rows, self._count = np.empty((6, 256)), 0

    @property
    def rows(self) -> Array:
        """All samples so far, (6, k)."""
        return self._rows[:, : self._count]

    def add(self, t: Array, x: Array, v: Array, s: float, force: Array | float = np.nan) -> None:
        """Append samples (k,); the first one replaces a last sample that is not earlier."""
        if self._count and t[0] <= self._rows[0, self._count - 1]:
            self._count -= 1
        first, self._count = self._count, self._count + len(t)
        if self._count > self._rows.shape[1]:
            self._rows = np.concatenate([self._rows, np.empty((6, self._count + len(t)))], axis=1)
        added = self._rows[:, first : self._count]
        added[0], added[1], added[2], added[4], added[5] = t, x, v, s, force
        before = self._rows[:, first - 1] if first else added[:, 0]
        start = before[3] if first else 0.0
        added[3] = start + np.cumsum(np.abs(np.diff(added[1], prepend=before[1])))

    def until(self, t: float) -> Array:
        """Samples up to time t, at least the first one, (6, k)."""
        return self._rows[:, : max(1, int(np.searchsorted(self.rows[0], t, side="right")))]


@dataclass
class SimulationState:
    """A model with its values under given conditions, the motion so far, and what effects with memory remember.

    Attributes
    ----------
    model, values, conditions
        The law and what it acts on.
    smooth
        Whether the force does not jump at a reversal, so that panels may contain reversals.
    first
        States of the effects at the start, by effect, where they are known.
    tolerance
        Accuracy of a long motion, m; None solves to rounding error.
    history
        Motion so far.
    states
        States of the effects at the last sample, by effect.
    heading
        Direction of the last motion; 0 before the first.

    """

    model: Model
    values: Values
    conditions: Conditions
    smooth: bool = False
    first: Mapping[str, Array] = field(default_factory=dict)
    tolerance: float | None = None
    history: StateHistory = field(default_factory=StateHistory)
    states: Mapping[str, Array] = field(default_factory=dict)
    heading: float = 0.0

    def reset(self, start: tuple[float, float]) -> None:
        """Forget the motion so far and begin at start = (x m, v m/s)."""
        self.history, self.states, self.heading = StateHistory(), self.first, float(np.sign(start[1]))

    def path(self, x: Array, v: Array, t: Array, s: float) -> Path:
        """Path of a motion (n,) in direction s from the last sample on, its past included."""
        path = self.conditions.path(x, v, t, s)
        if not len(self.history.rows[0]):
            return path
        history = self.history.until(float(t[0]))
        path = replace(path, travelled=float(history[3, -1]), begins=float(history[1, -1]), before=history[:3])
        if not self.model.memory:
            return path
        if self.smooth:
            path.s[:] = self.directions(v)
        elif self.model.turns and not self.heading and v[0] == 0:  # it has only been at rest so far
            path.s[:1] = 0.0
        return replace(path, states=self.states)

    def force(self, x: Array, v: Array, t: Array, s: float) -> Array:
        """Friction force (n,), N, along a motion in direction s from the last sample on."""
        return self.model.force(self.path(x, v, t, s), self.values)

    def advance(self, motion: CollocationSolution, edges: int, s: float) -> None:
        """Append the first `edges` panel edges of a motion that begins at the last sample; update the memory."""
        t, x, v = (interleave(*pair)[: 4 * edges - 3] for pair in nodes_and_edges(motion))
        force = np.full(edges, np.nan)
        if self.model.memory:
            path = self.path(x, v, t, s)
            force = self.model.force(path, self.values)[::4]
            self._remember(path)
        self.history.add(t[::4], x[::4], v[::4], s, force)
        self.heading = float(np.sign(v[-1])) or self.heading or s

    def stick(self, t: Array, x: Array, until: float) -> None:
        """Append a rest at times t (k,); update the memory at its end, unless the mass has not moved yet."""
        if self.model.memory and self.heading:
            times, still = np.append(t, until), np.append(x, x[-1])
            path = self.path(still, np.zeros_like(still), times, self.heading)
            self._remember(path)
        self.history.add(t, x, np.zeros_like(t), 0.0)

    def _remember(self, path: Path) -> None:
        """Keep what the effects remember at the end of a path."""
        self.states = {name: own[-1:] for name, own in self.model.states(path, self.values).items()}

    def driving_force(self, t: Array) -> Array:
        """Drive and the component of gravity along the course at times t (n,), N."""
        c = self.conditions
        drive = np.zeros_like(t) if c.drive is None else c.drive(t)
        return drive - c.mass * GRAVITY * np.sin(c.incline)

    def acceleration(self, s: float) -> Callable[[Array, Array, Array], Array]:
        """Law for direction s: a function of x, v, t, each (n,), that returns x'' (n,), m/s^2."""

        def law(x: Array, v: Array, t: Array) -> Array:
            return (self.driving_force(t) - self.force(x, v, t, s)) / self.conditions.mass

        return law

    def acceleration_at_nodes(self, panels: Panels, s: float) -> Callable[[Array, Array], Array]:
        """Law for direction s at the nodes of panels; drive, lift and angle are evaluated once."""
        t = np.append(panels.edges[0], panels.t) if self.model.memory else panels.t
        fixed_path, driving_force = self.path(t, np.zeros_like(t), t, s), self.driving_force(panels.t)
        first = self.history.rows[1:3, -1]

        def law(x: Array, v: Array) -> Array:
            if self.model.memory:
                x, v = np.append(first[0], x), np.append(first[1], v)
            s = self.directions(v) if self.smooth else fixed_path.s
            path = replace(fixed_path, x=x, v=v, s=s, load=self.conditions.load).pressed()
            return (driving_force - self.model.force(path, self.values)[-len(driving_force) :]) / self.conditions.mass

        return law

    def directions(self, v: Array) -> Array:
        """Direction of motion (n,) from the last sample on; it is kept at rest."""
        return direction_of_motion(np.append(self.heading, v))[1:]

    def excess_force(self, x: float, t: Array, s: float) -> Array:
        """Driving force minus friction, N, of a mass at rest at x that is about to move in direction s."""
        zero = np.zeros_like(t)
        excess = s * (self.driving_force(t) - self.force(zero + x, zero, t, s))
        if not np.all(np.isfinite(excess)):
            raise FrictrackError(
                "expected a force on the resting mass but the law or the drive has no finite value there; "
                "check its parameters and the drive"
            )
        return np.asarray(excess)


def nodes_and_edges(motion: CollocationSolution) -> list[tuple[Array, Array]]:
    """Time, position and velocity of a motion, each at the nodes (3 p,) and at the edges (p + 1,)."""
    panels = motion.panels
    return [(panels.t, panels.edges), (motion.x, motion.x_edge), (motion.v, motion.v_edge)]


def interleave(nodes: Array, edges: Array) -> Array:
    """Join values at the nodes (3 p,) and at the edges (p + 1,) in order of time, (4 p + 1,)."""
    return np.append(np.column_stack([edges[:-1], nodes.reshape(-1, 3)]).ravel(), edges[-1])


WINDOW_PANELS = 64  # panels solved at once after a stop, and under a law with memory
MAX_WINDOW_PANELS = 512  # the same while the mass slides on: every window doubles, because each costs about the same
REVERSAL_WINDOW_PANELS = 16  # the same under a model in which reversals are frequent
SMOOTH_WINDOW_PANELS = 64  # the same under a law without a jump at rest
AGREEMENT_M = 1e-10  # largest change of the displacement when panels are halved
MAX_HALVINGS, MAX_HALVINGS_LONG = 6, 3  # of the panels, for short and for long motions
SOLVER_MARGIN = 1e3  # a long motion is solved this much more accurately than halved panels must agree
MAX_FORCE_JUMP = 1e-9  # share of the force by which it may change with the direction at rest and still be smooth
MIN_EXCESS_N = 1e-9  # driving force beyond friction at which a mass at rest starts


@dataclass(frozen=True)
class Trajectory:
    """True motion of the slider at the frames.

    Attributes
    ----------
    t, x, v, a
        Recorded time (s), position (m), velocity (m/s) and acceleration (m/s^2), each (n,).
    F
        Friction force, N, shape (n,).
    shift
        Displacement of the recorded position from the true one by measurement effects, m, shape (n,).

    """

    t: Array
    x: Array
    v: Array
    a: Array
    F: Array
    shift: Array

    @property
    def duration(self) -> float:
        """Time from the first frame to the last, s."""
        return float(self.t[-1] - self.t[0])

    @property
    def distance(self) -> float:
        """Distance slid, m."""
        return float(np.sum(np.abs(np.diff(self.x))))


@dataclass(frozen=True)
class Start:
    """Start of a motion: position x (m), velocity v (m/s), and the known states of effects with memory, (1, k) each."""

    x: float
    v: float
    states: Mapping[str, Array] = field(default_factory=dict)


def simulate(model: Model, values: Values, conditions: Conditions, t: Array, start: tuple[float, float]) -> Trajectory:
    """Simulate a run of known truth.

    Panels are halved until the displacement changes by at most 0.1 nm, so that a blow much shorter than a frame is
    resolved too.

    Parameters
    ----------
    model, values
        The law: its effects, and for each effect the values of its parameters by name (SI).
    conditions
        Mass, load, drive and what else acts in the run.
    t
        Recorded times of the frames, s since release, shape (n,).
    start
        Position (m) and velocity (m/s) at t[0].

    Returns
    -------
    Trajectory
        Motion and force at the frames.

    Raises
    ------
    FrictrackError
        If the displacement cannot be computed to 1 nm.

    Examples
    --------
    A mass of 0.35 kg at 2 m/s under 3.5 N of Coulomb friction is braked by 10 m/s^2 and stops after 0.2 m:

    >>> from frictrack import models
    >>> t = np.arange(300) / 1000
    >>> run = simulate(models.of(["coulomb"]), {"coulomb": {"F_c": 3.5}}, Conditions(mass=0.35), t, (0.0, 2.0))
    >>> round(float(run.x[-1]), 6), float(run.v[-1])
    (0.2, 0.0)

    """
    state, recorded, t = SimulationState(model, values, conditions), t, t * model.clock(values)
    per_frame = max(2, *(e.fine for e in model.effects))
    finer, change = _sample_trajectory(state, t, start, per_frame), np.inf
    for _ in range(MAX_HALVINGS):
        per_frame *= 2
        coarse, finer = finer, _sample_trajectory(state, t, start, per_frame)
        change = float(np.max(np.abs(finer.x - coarse.x)))
        if change <= AGREEMENT_M:
            return replace(finer, t=recorded)
    if change > 10 * AGREEMENT_M:
        raise FrictrackError(
            f"expected a motion that can be followed to 1 nm but got one that still moves by {change * 1e9:.2g} nm "
            f"when every frame is cut into {per_frame} parts; give more frames per second, or wider pulses"
        )
    return replace(finer, t=recorded)


def simulate_displacement(
    model: Model, values: Values, conditions: Conditions, t: Array, start: Start, tolerance: float
) -> Array:
    """Simulate the recorded displacement of a long motion to a given accuracy.

    A law without a jump at rest is integrated through its reversals.

    Parameters
    ----------
    model, values, conditions, t
        As in `simulate`.
    start
        Position, velocity and known states at t[0].
    tolerance
        Change of the displacement at which panels are no longer halved, m; they are halved three times at most.

    Returns
    -------
    Array
        Displacement as a camera would record it, m, shape (n,).

    Raises
    ------
    FrictrackError
        If the motion under this law cannot be integrated.

    """
    smooth = is_smooth_at_rest(model, values, conditions)
    state = SimulationState(model, values, conditions, smooth, start.states, tolerance / SOLVER_MARGIN)
    t = t * model.clock(values)
    per_frame = max(e.fine for e in model.effects)
    displacement = _sample_displacement(state, t, start, per_frame)
    for _ in range(MAX_HALVINGS_LONG):
        per_frame *= 2
        coarse, displacement = displacement, _sample_displacement(state, t, start, per_frame)
        if float(np.max(np.abs(displacement - coarse))) <= tolerance:
            break
    return displacement


def is_smooth_at_rest(model: Model, values: Values, conditions: Conditions) -> bool:
    """Whether the force at rest does not depend on the direction in which the mass is about to move."""
    rest = np.zeros(2)
    for place in (-0.371, 0.0, 0.083, 0.229, 0.517):  # m, and s; several, because one may lie on a zero of a texture
        forces = []
        for s in (1.0, -1.0):
            path = conditions.path(rest + place, rest, rest + abs(place), s)
            path.s[0] = 0.0
            forces.append(float(model.force(path, values)[-1]))
        if abs(forces[0] - forces[1]) > MAX_FORCE_JUMP * max(abs(forces[0]), abs(forces[1])):
            return False
    return True


def _integrate(state: SimulationState, t: Array, start: tuple[float, float], per_frame: int) -> Array:
    """Integrate through every stop and release; return the rows of the history (6, k), frames among them."""
    state.reset(start)
    edges = np.interp(np.arange((len(t) - 1) * per_frame + 1) / per_frame, np.arange(len(t)), t)
    now, x, v, count = float(edges[0]), float(start[0]), float(start[1]), _first_window(state)
    while now < edges[-1] - 1e-12:
        next_one = int(np.searchsorted(edges, now + 1e-12, side="right"))
        ahead = np.concatenate([[now], edges[next_one : next_one + count]])
        state.history.add(np.array([now]), np.array([x]), np.array([v]), 0.0)
        s = 1.0 if state.smooth else np.sign(v) if v else _start_direction(state, x, now)
        now, x, v = _slide_until_stop(state, ahead, (x, v), float(s)) if s else _stick(state, ahead, x)
        can_grow = v and not (state.smooth or state.model.memory or state.model.turns)
        count = min(2 * count, MAX_WINDOW_PANELS) if can_grow else _first_window(state)
    return state.history.rows


def _first_window(state: SimulationState) -> int:
    """Number of panels that are solved at once after a stop."""
    if state.smooth:
        return SMOOTH_WINDOW_PANELS
    return REVERSAL_WINDOW_PANELS if state.model.turns else WINDOW_PANELS


def _start_direction(state: SimulationState, x: float, now: float) -> float:
    """Direction in which the mass starts from rest; 0 if it sticks."""
    for s in (1.0, -1.0):
        if state.excess_force(x, np.array([now]), s)[0] > MIN_EXCESS_N:
            return s
    return 0.0


def _stick(state: SimulationState, ahead: Array, x: float) -> tuple[float, float, float]:
    """Stick until the drive overcomes friction in one direction, at most through the times ahead (k,)."""
    excess = {s: state.excess_force(x, ahead, s) - MIN_EXCESS_N for s in (1.0, -1.0)}
    free = (excess[1.0] > 0) | (excess[-1.0] > 0)
    free[0] = False
    last = int(np.argmax(free)) if free.any() else len(ahead)
    until, still = float(ahead[last - 1]), np.full(last, x)
    if last < len(ahead):
        s = 1.0 if excess[1.0][last] > 0 else -1.0
        until = _release(state, ahead[: last + 1], x, s)
    state.stick(ahead[:last], still, until)
    return until, x, 0.0


def _release(state: SimulationState, ahead: Array, x: float, s: float) -> float:
    """Time within the last interval of `ahead` at which the mass starts in direction s, s."""

    def gap(t: float) -> float:
        times = np.append(ahead[:-1], t) if state.model.memory else np.array([t])
        return float(state.excess_force(x, times, s)[-1]) - MIN_EXCESS_N

    if gap(float(ahead[-2])) >= 0:
        return float(ahead[-2]) + 1e-9
    return float(brentq(gap, ahead[-2], ahead[-1])) + 1e-9


def _slide_until_stop(
    state: SimulationState, ahead: Array, start: tuple[float, float], s: float
) -> tuple[float, float, float]:
    """Slide in direction s through one window of panels, or to the stop; return time, position and velocity there.

    A smooth law is followed through its reversals.
    """
    motion = _solve_window(state, Panels(ahead), start, s, state.tolerance)
    edges, x, v = motion.panels.edges, motion.x_edge, motion.v_edge
    stops = [] if state.smooth else np.flatnonzero(s * v[1:] <= 0).tolist()
    last = stops[0] if stops else len(edges) - 1  # edge before the stop
    state.advance(motion, last + 1, s)
    if not stops:
        return float(edges[-1]), float(x[-1]), float(v[-1])
    return _locate_stop(state, s, edges[last : last + 2], (x[last], v[last]), motion.a[3 * last : 3 * last + 3])


def _solve_window(
    state: SimulationState, panels: Panels, start: tuple[float, float], s: float, tolerance: float | None
) -> CollocationSolution:
    """Solve the motion on the panels, or on as many of the first as converge: far beyond a stop none may."""
    guess, count = _predict_accelerations(state, panels, start, s), len(panels.h)
    while count:
        some, first = Panels(panels.edges[: count + 1]), guess[: 3 * count]
        if tolerance is None and not state.model.memory:
            solved = result_or_none(solve_motion, state.acceleration(s), some, start, first)
            motion = None if solved is None else solved[0]
        else:
            law = state.acceleration_at_nodes(some, s)
            motion = solve_simplified_newton(law, some, start, first, tolerance or MEMORY_TOLERANCE_M)
        if motion is not None:
            return motion
        count //= 2
    raise FrictrackError(NOT_INTEGRATED)


def _predict_accelerations(state: SimulationState, panels: Panels, start: tuple[float, float], s: float) -> Array:
    """First guess of the node accelerations (3 p,): the law linearised about the start, under the coming drive."""
    law, (x, v), t = state.acceleration(s), start, np.full(2, panels.edges[0])
    forward = float(np.sign(v)) or s  # a step backward would undo a memory
    step = 1e-7 * np.array([forward, max(abs(v), 1.0)])
    first = float(law(np.full(2, x), np.full(2, v), t)[-1])
    by_x = (float(law(x + np.array([0.0, step[0]]), np.full(2, v), t)[-1]) - first) / step[0]
    by_v = (float(law(np.full(2, x), v + np.array([0.0, step[1]]), t)[-1]) - first) / step[1]
    one = np.ones_like(panels.t)
    driven = (state.driving_force(panels.t) - state.driving_force(t)[0]) / state.conditions.mass
    rest = first - by_x * x - by_v * v + driven
    a, _ = LinearResponse(panels, by_x * one, by_v * one).respond(rest[:, None], np.array([[x], [v]]))
    return a[:, 0]


def _locate_stop(
    state: SimulationState, s: float, edges: Array, first: tuple[float, float], a: Array
) -> tuple[float, float, float]:
    """Locate the stop in a panel with edges (2,), first x and v, and node accelerations a (3,); time, x, v."""
    h, begin, law = float(edges[1] - edges[0]), float(edges[0]), state.acceleration(s)
    curve = np.polynomial.Polynomial(np.polyfit(NODES * h, a, 2)[::-1]).integ(k=float(first[1]))
    tau = float(brentq(curve, 0.0, h)) if curve(0.0) * curve(h) < 0 else h
    if tau < 1e-12:
        return begin + 1e-9, float(first[0]), 0.0
    for _ in range(4):  # the polynomial gives a first guess; the law itself gives the time
        piece = Panels(np.array([begin, begin + tau]))
        start = float(first[0]), float(first[1])
        motion = _solve_window(state, piece, start, s, None)
        x, v, t = (interleave(*pair) for pair in (nodes_and_edges(motion)[k] for k in (1, 2, 0)))
        braking = float(law(x, v, t)[-1])
        late = float(motion.v_edge[-1]) / braking if braking else 0.0
        if abs(late) < 1e-13:
            break
        tau = float(np.clip(tau - late, 0.5 * tau, h))
    state.advance(motion, 2, s)
    return float(piece.edges[-1]), float(motion.x_edge[-1]), 0.0


def _sample_trajectory(state: SimulationState, t: Array, start: tuple[float, float], per_frame: int) -> Trajectory:
    """Motion and force at the frames t (n,)."""
    times, x, v, _, s, remembered = _integrate(state, t, start, per_frame)
    force = state.driving_force(times)
    for rows in np.split(np.arange(len(times)), np.flatnonzero(np.diff(s)) + 1):
        if s[rows[0]]:
            memory = state.model.memory
            force[rows] = remembered[rows] if memory else state.force(x[rows], v[rows], times[rows], float(s[rows[0]]))
    at = _rows_at(times, t)
    x, v, force = x[at], v[at], force[at]
    a = (state.driving_force(t) - force) / state.conditions.mass
    return Trajectory(t, x, v, a, force, _recorded_position(state, x, v, t) - x)


def _sample_displacement(state: SimulationState, t: Array, start: Start, per_frame: int) -> Array:
    """Recorded position at the frames t, m, (n,)."""
    times, x, v, *_ = _integrate(state, t, (start.x, start.v), per_frame)
    at = _rows_at(times, t)
    return _recorded_position(state, x[at], v[at], t)


def _rows_at(times: Array, t: Array) -> NDArray[np.int_]:
    """Rows of the history at the frames t."""
    return np.clip(np.searchsorted(times, t - 1e-10), 0, len(times) - 1)


def _recorded_position(state: SimulationState, x: Array, v: Array, t: Array) -> Array:
    """Position with the shift by measurement effects, m, (n,)."""
    if all(e.acts_on == "force" for e in state.model.effects):
        return x
    return x + image_shift(state.model, state.values, state.path(x, v, t, 1.0))


def image_shift(model: Model, values: Values, path: Path) -> Array:
    """Shift of the recorded position by the measurement effects of a model.

    Parameters
    ----------
    model, values
        The model and, for each effect, the values of its parameters by name (SI).
    path
        Motion of n samples.

    Returns
    -------
    Array
        Shift, m, shape (n,).

    """
    out = np.zeros_like(path.x)
    clocks = {e.name for e in model.effects if e.clock is not None}  # they change the time axis instead
    for name, block in model.measurement_columns(path, values).items():
        out += 0.0 if name in clocks else block @ model.coefficients(name, values)
    return out
