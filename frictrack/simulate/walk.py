"""A law bound to one run's conditions, the states collected on the way, and what the law remembers at the last one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from frictrack.effects import Path
from frictrack.effects.memory import headings
from frictrack.models import Model, Values
from frictrack.records import GRAVITY, Array
from frictrack.simulate.panels import Motion6, Panels


@dataclass(frozen=True)
class Conditions:
    """What holds in one simulated run: mass kg, load and mass over their references, pitch m, incline rad.

    Drive (N), vertical acceleration (m/s^2, up) and angle of the target (rad) are functions of t (n,), s since release.
    """

    mass: float
    load: float = 1.0
    mass_ratio: float = 1.0
    pixel_pitch: float | None = None
    incline: float = 0.0
    drive: Callable[[Array], Array] | None = None
    lift: Callable[[Array], Array] | None = None
    angle: Callable[[Array], Array] | None = None
    clamp_x: float | None = None  # m
    beam_length: float | None = None  # m

    def along(self, x: Array, v: Array, t: Array, s: float) -> Path:
        """The path of a motion under these conditions."""
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
        )


class Way:
    """The states collected on the way, in order of time: t, x, v, distance slid, direction and force, (6, k)."""

    def __init__(self) -> None:
        self._rows, self._count = np.empty((6, 256)), 0

    @property
    def rows(self) -> Array:
        """The states so far, (6, k)."""
        return self._rows[:, : self._count]

    def add(self, t: Array, x: Array, v: Array, s: float, force: Array | float = np.nan) -> None:
        """Append states (k,); one that is there already at the same time is replaced."""
        if self._count and t[0] <= self._rows[0, self._count - 1]:
            self._count -= 1
        first, self._count = self._count, self._count + len(t)
        if self._count > self._rows.shape[1]:
            self._rows = np.concatenate([self._rows, np.empty((6, self._count + len(t)))], axis=1)
        mine = self._rows[:, first : self._count]
        mine[0], mine[1], mine[2], mine[4], mine[5] = t, x, v, s, force
        before = self._rows[:, first - 1] if first else mine[:, 0]
        start = before[3] if first else 0.0
        mine[3] = start + np.cumsum(np.abs(np.diff(mine[1], prepend=before[1])))

    def until(self, t: float) -> Array:
        """The states up to a time, the first one in any case."""
        return self._rows[:, : max(1, int(np.searchsorted(self.rows[0], t, side="right")))]


@dataclass
class Walk:
    """The law bound to its conditions, the states collected on the way, and what the law remembers at the last one.

    A `smooth` law passes a reversal without a jump: it is followed through, in the direction that the motion has.
    """

    model: Model
    values: Values
    conditions: Conditions
    smooth: bool = False
    first: Mapping[str, Array] = field(default_factory=dict)  # what it remembers at the start, where that is known
    within: float | None = None  # m, to which a long motion is solved; None as exactly as numbers go
    way: Way = field(default_factory=Way)
    states: Mapping[str, Array] = field(default_factory=dict)
    heading: float = 0.0

    def begin(self, start: tuple[float, float]) -> None:
        """Forget what was walked before."""
        self.way, self.states, self.heading = Way(), self.first, float(np.sign(start[1]))

    def path(self, x: Array, v: Array, t: Array, s: float) -> Path:
        """The path of a motion in direction s, its past included."""
        path = self.conditions.along(x, v, t, s)
        if not len(self.way.rows[0]):
            return path
        way = self.way.until(float(t[0]))
        path = replace(path, travelled=float(way[3, -1]), begins=float(way[1, -1]))
        if not self.model.memory:
            return replace(path, before=way[:3])
        if self.smooth:
            path.s[:] = self.directions(v)
        elif self.model.turns and not self.heading and v[0] == 0:  # so far it has only rested
            path.s[:1] = 0.0
        return replace(path, states=self.states)

    def force(self, x: Array, v: Array, t: Array, s: float) -> Array:
        """Friction at places (n,), all of them slid through in direction s from the last state on."""
        return self.model.force(self.path(x, v, t, s), self.values)

    def advance(self, motion: Motion6, edges: int, s: float) -> None:
        """Collect the first so many edges of a motion that begins at the last state, and what is remembered there."""
        t, x, v = (merged(*pair)[: 4 * edges - 3] for pair in nodes_and_edges(motion))
        force = np.full(edges, np.nan)
        if self.model.memory:
            path = self.path(x, v, t, s)
            force = self.model.force(path, self.values)[::4]
            self.states = self.model.states(path, self.values)
        self.way.add(t[::4], x[::4], v[::4], s, force)
        self.heading = float(np.sign(v[-1])) or self.heading or s

    def rest(self, t: Array, x: Array, until: float) -> None:
        """Collect a rest at times (k,), and what is remembered at its end; before the first motion that is nothing."""
        if self.model.memory and self.heading:
            times, still = np.append(t, until), np.append(x, x[-1])
            path = self.path(still, np.zeros_like(still), times, self.heading)
            self.states = self.model.states(path, self.values)
        self.way.add(t, x, np.zeros_like(t), 0.0)

    def push(self, t: Array) -> Array:
        """Drive and gravity along the course, N."""
        c = self.conditions
        drive = np.zeros_like(t) if c.drive is None else c.drive(t)
        return drive - c.mass * GRAVITY * np.sin(c.incline)

    def acceleration(self, s: float) -> Callable[[Array, Array, Array], Array]:
        """The law in one direction of motion: x'' at places x, velocities v and times t."""

        def law(x: Array, v: Array, t: Array) -> Array:
            return (self.push(t) - self.force(x, v, t, s)) / self.conditions.mass

        return law

    def bound(self, panels: Panels, s: float) -> Callable[[Array, Array], Array]:
        """The law at the nodes of panels that begin at the last state; drive, lift and angle are read off once."""
        t = np.append(panels.edges[0], panels.t) if self.model.memory else panels.t
        held, push = self.path(t, np.zeros_like(t), t, s), self.push(panels.t)
        first = self.way.rows[1:3, -1]

        def law(x: Array, v: Array) -> Array:
            if self.model.memory:
                x, v = np.append(first[0], x), np.append(first[1], v)
            path = replace(held, x=x, v=v, s=self.directions(v) if self.smooth else held.s)
            return (push - self.model.force(path, self.values)[-len(push) :]) / self.conditions.mass

        return law

    def directions(self, v: Array) -> Array:
        """Direction of motion (n,) from the last state on, held at rest."""
        return headings(np.append(self.heading, v))[1:]

    def excess(self, x: float, t: Array, s: float) -> Array:
        """Push beyond the friction of starting in direction s from rest at x, N, positive when it starts."""
        zero = np.zeros_like(t)
        return s * (self.push(t) - self.force(zero + x, zero, t, s))


def nodes_and_edges(motion: Motion6) -> list[tuple[Array, Array]]:
    """Time, place and velocity of a motion, each at the nodes and at the edges."""
    panels = motion.panels
    return [(panels.t, panels.edges), (motion.x, motion.x_edge), (motion.v, motion.v_edge)]


def merged(nodes: Array, edges: Array) -> Array:
    """Values at the nodes (3 p,) and the edges (p + 1,) of panels in order, (4 p + 1,)."""
    return np.append(np.column_stack([edges[:-1], nodes.reshape(-1, 3)]).ravel(), edges[-1])
