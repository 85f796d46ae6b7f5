"""Trajectories of the slider under any sum of effects: m x'' = D - F, with sticking, release and reversal.

Between stops the direction of motion s is held fixed, so the law is smooth and the shared collocation integrator
keeps its order. At v = 0 the mass sticks while the drive lies between the friction of starting backward and that
of starting forward, both of which the model itself gives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np
from scipy.optimize import brentq

from frictrack.effects import Path
from frictrack.effects.memory import headings
from frictrack.errors import FrictrackError
from frictrack.models import Model, Values
from frictrack.records import GRAVITY, Array
from frictrack.simulate.dynamics import NODES, Panels, solve

WINDOW = 64  # panels solved at once
LONGEST = 4000  # states before a window along which a law with memory is followed
SHORT_WINDOW = 16  # where a reversal soon ends them
AGREE = 1e-10  # m, within which two cuts of time must agree on the displacement
HALVINGS = 6  # of the panels, at most


States = dict[float, tuple[float, float, float]]  # t -> x, v, s


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


@dataclass(frozen=True)
class Slide:
    """True motion at the frames: t s, x m, v m/s, a m/s^2, F N, and the picture's shift o m; each (n,)."""

    t: Array
    x: Array
    v: Array
    a: Array
    F: Array
    shift: Array


@dataclass
class _Walk:
    """The law bound to its conditions, and the states collected on the way."""

    model: Model
    values: Values
    conditions: Conditions
    states: States = field(default_factory=dict)
    _way: Array = field(default_factory=lambda: np.empty((4, 0)))  # t, x, v, distance slid at the states so far

    def begin(self) -> None:
        """Forget what was walked before."""
        self.states.clear()
        self._way = np.empty((4, 0))

    def path(self, x: Array, v: Array, t: Array, s: float) -> Path:
        way = self.way(float(t[0]))
        path = self.conditions.along(x, v, t, s)
        return replace(path, before=way[:3], travelled=float(way[3, -1]), begins=float(way[1, -1]))

    def force(self, x: Array, v: Array, t: Array, s: float) -> Array:
        """Friction at the last of the given places (n,), all of them slid through in direction s."""
        if not self.model.memory:
            return self.model.force(self.path(x, v, t, s), self.values)
        way = self.way(float(t[0]))
        lately = way[:3, way[0] < t[0]][:, -LONGEST:]
        whole_t, whole_x, whole_v = (np.append(q, new) for q, new in zip(lately, (t, x, v), strict=True))
        path = self.path(whole_x, whole_v, whole_t, s)
        path.s[: -len(t)] = headings(lately[2])
        if self.model.turns and not np.any(lately[2]) and v[0] == 0:
            path.s[: 1 - len(t) or None] = 0.0  # so far it has only rested
        return self.model.force(path, self.values)[-len(t) :]

    def way(self, until: float) -> Array:
        """t, x, v and distance slid (4, k) from release up to a time."""
        new = [(t, x, v, 0.0) for t, (x, v, _) in islice(self.states.items(), self._way.shape[1], None)]
        if new:
            way = np.concatenate([self._way, np.array(new).T], axis=1)
            way[3] = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(way[1])))])
            self._way = way
        return self._way[:, : max(1, int(np.searchsorted(self._way[0], until, side="right")))]

    def push(self, t: Array) -> Array:
        """Drive and gravity along the course, N."""
        c = self.conditions
        drive = np.zeros_like(t) if c.drive is None else c.drive(t)
        return drive - c.mass * GRAVITY * np.sin(c.incline)

    def acceleration(self, s: float) -> Callable[[Array, Array, Array], Array]:
        def law(x: Array, v: Array, t: Array) -> Array:
            return (self.push(t) - self.force(x, v, t, s)) / self.conditions.mass

        return law

    def excess(self, x: float, t: Array, s: float) -> Array:
        """Push beyond the friction of starting in direction s from rest at x, N, positive when it starts."""
        zero = np.zeros_like(t)
        return s * (self.push(t) - self.force(zero + x, zero, t, s))


def simulate(model: Model, values: Values, conditions: Conditions, t: Array, start: tuple[float, float]) -> Slide:
    """Move the mass from start = (x m, v m/s) at t[0] through the frame times t (n,), s since release.

    Panels are halved until the displacement stays within 0.1 nm, so that a blow much shorter than a frame is
    followed too. Raises FrictrackError when 1 nm cannot be reached.
    """
    walk = _Walk(model, values, conditions)
    per_frame = max(2, *(e.fine for e in model.effects))
    slide, change = _collect(walk, t, _walked(walk, t, start, per_frame)), np.inf
    for _ in range(HALVINGS):
        per_frame *= 2
        coarse, slide = slide, _collect(walk, t, _walked(walk, t, start, per_frame))
        change = float(np.max(np.abs(slide.x - coarse.x)))
        if change <= AGREE:
            return slide
    if change > 10 * AGREE:
        raise FrictrackError(
            f"expected a motion that can be followed to 1 nm but got one that still moves by {change * 1e9:.2g} nm "
            f"when every frame is cut into {per_frame} parts; give more frames per second, or wider pulses"
        )
    return slide


def _walked(walk: _Walk, t: Array, start: tuple[float, float], per_frame: int) -> States:
    """States at the frames and in between, through every stop and release."""
    walk.begin()
    edges = np.interp(np.arange((len(t) - 1) * per_frame + 1) / per_frame, np.arange(len(t)), t)
    now, x, v = float(edges[0]), float(start[0]), float(start[1])
    while now < edges[-1] - 1e-12:
        ahead = np.concatenate([[now], edges[edges > now + 1e-12]])
        walk.states[now] = (x, v, 0.0)
        s = np.sign(v) if v else _starts(walk, x, now)
        now, x, v = _slide(walk, ahead, (x, v), float(s)) if s else _rest(walk, ahead, x)
    return dict(walk.states)


def _starts(walk: _Walk, x: float, now: float) -> float:
    """Direction in which the mass sets off from rest, 0 when it sticks."""
    for s in (1.0, -1.0):
        if walk.excess(x, np.array([now]), s)[0] > 1e-9:
            return s
    return 0.0


def _rest(walk: _Walk, ahead: Array, x: float) -> tuple[float, float, float]:
    """Stick until the push overcomes friction in either direction, or to the end."""
    for i, t in enumerate(ahead):
        free = [s for s in (1.0, -1.0) if walk.excess(x, np.array([t]), s)[0] > 1e-9]
        if free and i > 0:
            gap = lambda tau, s=free[0]: float(walk.excess(x, np.array([tau]), s)[0]) - 1e-9  # noqa: E731
            return float(brentq(gap, ahead[i - 1], t)) + 1e-9, x, 0.0
        walk.states[float(t)] = (x, 0.0, 0.0)
    return float(ahead[-1]), x, 0.0


def _slide(walk: _Walk, ahead: Array, start: tuple[float, float], s: float) -> tuple[float, float, float]:
    """Slide in direction s through at most `WINDOW` panels, or to the stop."""
    panels = Panels(ahead[: (SHORT_WINDOW if walk.model.turns else WINDOW) + 1])
    law = walk.acceleration(s)
    first = float(law(np.array([start[0]]), np.array([start[1]]), panels.edges[:1])[0])
    motion, _ = solve(law, panels, start, np.full(len(panels.t), first), memory=walk.model.memory)
    stopped = np.flatnonzero(s * motion.v_edge[1:] <= 0)
    last = int(stopped[0]) + 1 if len(stopped) else len(panels.edges)  # edges before the stop
    for k in range(last):
        walk.states[float(panels.edges[k])] = (float(motion.x_edge[k]), float(motion.v_edge[k]), s)
    if not len(stopped):
        return float(panels.edges[-1]), float(motion.x_edge[-1]), float(motion.v_edge[-1])
    return _stop(walk, s, panels, (motion.x_edge[last - 1], motion.v_edge[last - 1]), motion.a[3 * last - 3 : 3 * last])


def _stop(walk: _Walk, s: float, panels: Panels, state: tuple[float, float], a: Array) -> tuple[float, float, float]:
    """Time and place of the stop inside the panel that begins in a state and has node accelerations a (3,)."""
    k = int(np.searchsorted(panels.edges, max(walk.states), side="left"))
    h, begin, law = panels.h[k], panels.edges[k], walk.acceleration(s)
    curve = np.polynomial.Polynomial(np.polyfit(NODES * h, a, 2)[::-1]).integ(k=float(state[1]))
    tau = float(brentq(curve, 0.0, h)) if curve(0.0) * curve(h) < 0 else h
    if tau < 1e-12:
        return float(begin) + 1e-9, float(state[0]), 0.0
    for _ in range(4):  # the polynomial only guesses the moment: the law itself settles it
        piece = Panels(np.array([begin, begin + tau]))
        where = float(state[0]), float(state[1])
        motion, _ = solve(law, piece, where, np.full(3, float(a[0])), memory=walk.model.memory)
        braking = float(law(motion.x_edge[-1:], motion.v_edge[-1:], piece.edges[-1:])[0])
        late = float(motion.v_edge[-1]) / braking if braking else 0.0
        if abs(late) < 1e-13:
            break
        tau = float(np.clip(tau - late, 0.5 * tau, h))
    return float(begin) + tau, float(motion.x_edge[-1]), 0.0


def _collect(walk: _Walk, t: Array, states: States) -> Slide:
    known = np.array(sorted(states))
    x, v, s = np.array([states[k] for k in known]).T
    force = walk.push(known)
    cuts = np.flatnonzero(np.diff(s)) + 1
    for rows in np.split(np.arange(len(known)), cuts):  # the way so far counts, so every state of a slide is passed
        if s[rows[0]]:
            force[rows] = walk.force(x[rows], v[rows], known[rows], float(s[rows[0]]))
    at = np.clip(np.searchsorted(known, t - 1e-10), 0, len(known) - 1)
    x, v, force = x[at], v[at], force[at]
    a = (walk.push(t) - force) / walk.conditions.mass
    return Slide(t, x, v, a, force, shift(walk.model, walk.values, walk.path(x, v, t, 1.0)))


def shift(model: Model, values: Values, path: Path) -> Array:
    """What the picture is shifted by along a path, m, shape (n,)."""
    out = np.zeros_like(path.x)
    for name, block in model.measurement_columns(path, values).items():
        out += block @ model.coefficients(name, values)
    return out
