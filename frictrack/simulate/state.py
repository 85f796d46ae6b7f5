"""The state of a running simulation: conditions, the law, the motion so far and the memory of the effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.effects import Path, direction_of_motion
from frictrack.effects.models import Model, Values
from frictrack.records import GRAVITY, Array, EarlierRuns
from frictrack.simulate.dynamics import CollocationSolution, Panels


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
            angle=None if self.angle is None else self.angle(t),
            clamp_x=self.clamp_x,
            beam_length=self.beam_length,
            earlier=None if self.earlier is None else (self.earlier,),
        )


def push_force(mass: float, speed: float, duration: float) -> Callable[[Array], Array]:
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
            self.states = self.model.states(path, self.values)
        self.history.add(t[::4], x[::4], v[::4], s, force)
        self.heading = float(np.sign(v[-1])) or self.heading or s

    def stick(self, t: Array, x: Array, until: float) -> None:
        """Append a rest at times t (k,); update the memory at its end, unless the mass has not moved yet."""
        if self.model.memory and self.heading:
            times, still = np.append(t, until), np.append(x, x[-1])
            path = self.path(still, np.zeros_like(still), times, self.heading)
            self.states = self.model.states(path, self.values)
        self.history.add(t, x, np.zeros_like(t), 0.0)

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
            path = replace(fixed_path, x=x, v=v, s=self.directions(v) if self.smooth else fixed_path.s)
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
