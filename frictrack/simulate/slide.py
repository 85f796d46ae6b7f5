"""Trajectories of the slider under any sum of effects: m x'' = D - F, with sticking, release and reversal.

Between stops the direction of motion s is held fixed, so the law is smooth and the shared collocation integrator
keeps its order. At v = 0 the mass sticks while the drive lies between the friction of starting backward and that
of starting forward, both of which the model itself gives.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from frictrack.effects import Path
from frictrack.errors import FrictrackError
from frictrack.models import Model, Values
from frictrack.records import Array
from frictrack.simulate.dynamics import NODES, Linear, Motion6, Panels, settled, solve
from frictrack.simulate.walk import Conditions, Walk, merged, nodes_and_edges

__all__ = ["Conditions", "Slide", "Start", "followed", "is_smooth", "shift", "simulate"]

WINDOW = 64  # panels solved at once
SHORT_WINDOW = 16  # where a reversal soon ends them
AGREE = 1e-10  # m, within which two cuts of time must agree on the displacement
HALVINGS = 6  # of the panels, at most
FOLLOWED = 3  # likewise, for a long motion
SETTLED = 1e3  # times better than two cuts of time must agree, a long motion is solved in each
LONG_WINDOW = 64  # panels of a smooth one solved at once
JUMP = 1e-9  # share of a force by which it may change with the direction of motion at rest and still be smooth


@dataclass(frozen=True)
class Slide:
    """True motion at the frames: t s, x m, v m/s, a m/s^2, F N, and the picture's shift o m; each (n,)."""

    t: Array
    x: Array
    v: Array
    a: Array
    F: Array
    shift: Array


@dataclass(frozen=True)
class Start:
    """Where a motion begins: x m, v m/s, and by effect what it remembers, where that is known (1, k)."""

    x: float
    v: float
    states: Mapping[str, Array] = field(default_factory=dict)


def simulate(model: Model, values: Values, conditions: Conditions, t: Array, start: tuple[float, float]) -> Slide:
    """Move the mass from start = (x m, v m/s) at t[0] through the frame times t (n,), s since release, as recorded.

    Panels are halved until the displacement stays within 0.1 nm, so that a blow much shorter than a frame is
    followed too. Raises FrictrackError when 1 nm cannot be reached.
    """
    walk, recorded, t = Walk(model, values, conditions), t, t * model.clock(values)
    per_frame = max(2, *(e.fine for e in model.effects))
    slide, change = _collected(walk, t, start, per_frame), np.inf
    for _ in range(HALVINGS):
        per_frame *= 2
        coarse, slide = slide, _collected(walk, t, start, per_frame)
        change = float(np.max(np.abs(slide.x - coarse.x)))
        if change <= AGREE:
            return replace(slide, t=recorded)
    if change > 10 * AGREE:
        raise FrictrackError(
            f"expected a motion that can be followed to 1 nm but got one that still moves by {change * 1e9:.2g} nm "
            f"when every frame is cut into {per_frame} parts; give more frames per second, or wider pulses"
        )
    return replace(slide, t=recorded)


def followed(
    model: Model,
    values: Values,
    conditions: Conditions,
    t: Array,
    start: Start,
    within: float,
) -> Array:
    """Displacement (n,), m, of a long motion from a start at t[0], as a camera would show it at the times t (n,).

    Panels are halved until the displacement changes by at most `within` (m), `FOLLOWED` times at most. A law without
    a jump at rest is followed through its reversals.
    Raises FrictrackError when the motion under this law cannot be integrated.
    """
    walk = Walk(model, values, conditions, is_smooth(model, values, conditions), start.states, within / SETTLED)
    t = t * model.clock(values)
    per_frame = max(e.fine for e in model.effects)
    seen = _shown(walk, t, start, per_frame)
    for _ in range(FOLLOWED):
        per_frame *= 2
        coarse, seen = seen, _shown(walk, t, start, per_frame)
        if float(np.max(np.abs(seen - coarse))) <= within:
            break
    return seen


def is_smooth(model: Model, values: Values, conditions: Conditions) -> bool:
    """Whether a law's force at rest is the same whichever way the mass is about to move."""
    rest = np.zeros(2)
    for place in (-0.371, 0.0, 0.083, 0.229, 0.517):  # m, and s: one of them might lie on a zero of a texture
        ways = []
        for s in (1.0, -1.0):
            path = conditions.along(rest + place, rest, rest + abs(place), s)
            path.s[0] = 0.0
            ways.append(float(model.force(path, values)[-1]))
        if abs(ways[0] - ways[1]) > JUMP * max(abs(ways[0]), abs(ways[1])):
            return False
    return True


def _walked(walk: Walk, t: Array, start: tuple[float, float], per_frame: int) -> Array:
    """States (6, k) at the frames and in between, through every stop and release."""
    walk.begin(start)
    edges = np.interp(np.arange((len(t) - 1) * per_frame + 1) / per_frame, np.arange(len(t)), t)
    now, x, v = float(edges[0]), float(start[0]), float(start[1])
    while now < edges[-1] - 1e-12:
        next_one = int(np.searchsorted(edges, now + 1e-12, side="right"))
        ahead = np.concatenate([[now], edges[next_one : next_one + (LONG_WINDOW if walk.smooth else WINDOW)]])
        walk.way.add(np.array([now]), np.array([x]), np.array([v]), 0.0)
        if walk.smooth:
            now, x, v = _through(walk, ahead, (x, v))
            continue
        s = np.sign(v) if v else _starts(walk, x, now)
        now, x, v = _slide(walk, ahead, (x, v), float(s)) if s else _rest(walk, ahead, x)
    return walk.way.rows


def _starts(walk: Walk, x: float, now: float) -> float:
    """Direction in which the mass sets off from rest, 0 when it sticks."""
    for s in (1.0, -1.0):
        if walk.excess(x, np.array([now]), s)[0] > 1e-9:
            return s
    return 0.0


def _rest(walk: Walk, ahead: Array, x: float) -> tuple[float, float, float]:
    """Stick until the push overcomes friction in either direction, or through the times ahead."""
    gaps = {s: walk.excess(x, ahead, s) - 1e-9 for s in (1.0, -1.0)}
    free = (gaps[1.0] > 0) | (gaps[-1.0] > 0)
    free[0] = False
    last = int(np.argmax(free)) if free.any() else len(ahead)
    until, still = float(ahead[last - 1]), np.full(last, x)
    if last < len(ahead):
        s = 1.0 if gaps[1.0][last] > 0 else -1.0
        until = _release(walk, ahead[: last + 1], x, s)
    walk.rest(ahead[:last], still, until)
    return until, x, 0.0


def _release(walk: Walk, ahead: Array, x: float, s: float) -> float:
    """Time within the last of some intervals at which the mass sets off in direction s."""

    def gap(t: float) -> float:
        times = np.append(ahead[:-1], t) if walk.model.memory else np.array([t])
        return float(walk.excess(x, times, s)[-1]) - 1e-9

    if gap(float(ahead[-2])) >= 0:
        return float(ahead[-2]) + 1e-9
    return float(brentq(gap, ahead[-2], ahead[-1])) + 1e-9


def _slide(walk: Walk, ahead: Array, start: tuple[float, float], s: float) -> tuple[float, float, float]:
    """Slide in direction s through at most `WINDOW` panels, or to the stop."""
    panels = Panels(ahead[: (SHORT_WINDOW if walk.model.turns else WINDOW) + 1])
    motion = _solved(walk, panels, start, s)
    panels = motion.panels
    stopped = np.flatnonzero(s * motion.v_edge[1:] <= 0)
    last = int(stopped[0]) if len(stopped) else len(panels.h)  # edge before the stop
    walk.advance(motion, last + 1, s)
    if not len(stopped):
        return float(panels.edges[-1]), float(motion.x_edge[-1]), float(motion.v_edge[-1])
    piece = panels.edges[last : last + 2]
    return _stop(walk, s, piece, (motion.x_edge[last], motion.v_edge[last]), motion.a[3 * last : 3 * last + 3])


def _through(walk: Walk, ahead: Array, start: tuple[float, float]) -> tuple[float, float, float]:
    """Follow a smooth law through the times ahead, reversals included."""
    motion = _solved(walk, Panels(ahead), start, 1.0)
    walk.advance(motion, len(motion.x_edge), 1.0)
    return float(motion.panels.edges[-1]), float(motion.x_edge[-1]), float(motion.v_edge[-1])


def _solved(walk: Walk, panels: Panels, start: tuple[float, float], s: float) -> Motion6:
    """The motion through some panels from a start; the first of them where a long motion does not settle in all."""
    foreseen = _foreseen(walk, panels, start, s)
    if walk.within is None:
        return solve(walk.acceleration(s), panels, start, foreseen, memory=walk.model.memory)[0]
    count = len(panels.h)
    while count:
        some = Panels(panels.edges[: count + 1])
        motion = settled(walk.bound(some, s), some, start, foreseen[: 3 * count], walk.within)
        if motion is not None:
            return motion
        count //= 2
    one = Panels(panels.edges[:2])
    return solve(walk.acceleration(s), one, start, foreseen[:3], memory=walk.model.memory)[0]


def _foreseen(walk: Walk, panels: Panels, start: tuple[float, float], s: float) -> Array:
    """Accelerations (3 p,) of the law linearised about the start, under the push that is to come."""
    law, (x, v), t = walk.acceleration(s), start, np.full(2, panels.edges[0])
    onward = float(np.sign(v)) or s  # back along the way, a memory would be undone
    step = 1e-7 * np.array([onward, max(abs(v), 1.0)])
    first = float(law(np.full(2, x), np.full(2, v), t)[-1])
    by_x = (float(law(x + np.array([0.0, step[0]]), np.full(2, v), t)[-1]) - first) / step[0]
    by_v = (float(law(np.full(2, x), v + np.array([0.0, step[1]]), t)[-1]) - first) / step[1]
    one = np.ones_like(panels.t)
    rest = first - by_x * x - by_v * v + (walk.push(panels.t) - walk.push(t)[0]) / walk.conditions.mass
    a, _ = Linear(panels, by_x * one, by_v * one).respond(rest[:, None], np.array([[x], [v]]))
    return a[:, 0]


def _stop(walk: Walk, s: float, edges: Array, state: tuple[float, float], a: Array) -> tuple[float, float, float]:
    """Time and place of the stop inside a panel (2,) that begins in a state and has node accelerations a (3,)."""
    h, begin, law = float(edges[1] - edges[0]), float(edges[0]), walk.acceleration(s)
    curve = np.polynomial.Polynomial(np.polyfit(NODES * h, a, 2)[::-1]).integ(k=float(state[1]))
    tau = float(brentq(curve, 0.0, h)) if curve(0.0) * curve(h) < 0 else h
    if tau < 1e-12:
        return begin + 1e-9, float(state[0]), 0.0
    for _ in range(4):  # the polynomial only guesses the moment: the law itself settles it
        piece = Panels(np.array([begin, begin + tau]))
        where = float(state[0]), float(state[1])
        motion, _ = solve(law, piece, where, np.full(3, float(a[0])), memory=walk.model.memory)
        x, v, t = (merged(*pair) for pair in (nodes_and_edges(motion)[k] for k in (1, 2, 0)))
        braking = float(law(x, v, t)[-1])
        late = float(motion.v_edge[-1]) / braking if braking else 0.0
        if abs(late) < 1e-13:
            break
        tau = float(np.clip(tau - late, 0.5 * tau, h))
    walk.advance(motion, 2, s)
    return float(piece.edges[-1]), float(motion.x_edge[-1]), 0.0


def _collected(walk: Walk, t: Array, start: tuple[float, float], per_frame: int) -> Slide:
    """The motion at the frames, with the forces."""
    known, x, v, _, s, felt = _walked(walk, t, start, per_frame)
    force = walk.push(known)
    for rows in np.split(np.arange(len(known)), np.flatnonzero(np.diff(s)) + 1):
        if s[rows[0]]:
            memory = walk.model.memory
            force[rows] = felt[rows] if memory else walk.force(x[rows], v[rows], known[rows], float(s[rows[0]]))
    at = _rows_at(known, t)
    x, v, force = x[at], v[at], force[at]
    a = (walk.push(t) - force) / walk.conditions.mass
    return Slide(t, x, v, a, force, _shown_at(walk, x, v, t) - x)


def _shown(walk: Walk, t: Array, start: Start, per_frame: int) -> Array:
    """What a camera would show of a motion at the frames, (n,)."""
    known, x, v, *_ = _walked(walk, t, (start.x, start.v), per_frame)
    at = _rows_at(known, t)
    return _shown_at(walk, x[at], v[at], t)


def _rows_at(known: Array, t: Array) -> NDArray[np.int_]:
    return np.clip(np.searchsorted(known, t - 1e-10), 0, len(known) - 1)


def _shown_at(walk: Walk, x: Array, v: Array, t: Array) -> Array:
    if all(e.acts_on == "force" for e in walk.model.effects):
        return x
    return x + shift(walk.model, walk.values, walk.path(x, v, t, 1.0))


def shift(model: Model, values: Values, path: Path) -> Array:
    """What the picture is shifted by along a path, m, shape (n,)."""
    out = np.zeros_like(path.x)
    timed = {e.name for e in model.effects if e.clock is not None}  # their times are those of the motion itself
    for name, block in model.measurement_columns(path, values).items():
        out += 0.0 if name in timed else block @ model.coefficients(name, values)
    return out
