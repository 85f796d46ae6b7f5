"""Solve x'' = a(x, v, t) by collocation and Newton's method, for laws with and without memory.

All panels are solved at once: linearised, each panel is a 3 x 3 system and panels are chained by a banded system
(`linear_response`). Under a law with memory a first guess is improved window by window, and Newton's steps use the
response of `memory_response`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.records import Array
from frictrack.simulate.dynamics.collocation import (
    CollocationSolution,
    KrylovResponse,
    LinearResponse,
    MotionResponse,
    Panels,
    Start,
)

MAX_NEWTON_STEPS = 30
MAX_DISPLACEMENT_M = 1e6  # beyond it the iteration has diverged
JACOBIAN_REUSE_M = 1e-6  # Newton step below which the linear response is no longer recomputed
MAX_RATE = 0.1  # of the fall of the error per step, below which the error of the last step is predicted
RELATIVE_STEP = 1e-7  # of a difference, over the range of x or v: the root of the rounding error, roughly
FORCE_CHANGE = 1e-4  # by a directional difference, over the largest acceleration: rounding errors are near 1e-13
MAX_MOTION_CHANGE = 1e-4  # the same, over the motion's own size

TOLERANCE_M = 1e-13  # Newton step at which a motion has converged; relative beyond 1 m
MEMORY_TOLERANCE_M = 2e-11  # relative beyond 1 m: a law with memory has a kink at every reversal
SWEEP_PANELS, MIN_SWEEP_PANELS = 64, 4  # panels per window of a sweep: first try, and fewest
SWEEP_TOLERANCE_M = 1e-12  # at which a window of a sweep has converged
MAX_SIMPLIFIED_STEPS = 25
MAX_CHORD_STEPS, MAX_CHORD_RATE = 12, 0.3  # steps with the response of a near motion; by which their size has to fall

Acceleration = Callable[[Array, Array, Array], Array]  # (x, v, t) -> x'', each (3 p,)
# (x, v, step in x, step in v) -> x'' and its derivatives by x and v, each (3 p,)
Slopes = Callable[[Array, Array, Array, Array], tuple[Array, Array, Array]]


class ContinuedLaw(Protocol):
    """A law with memory that need not be told again what it remembers."""

    def acceleration(self, x: Array, v: Array, t: Array) -> Array:
        """Acceleration (1 + n,), m/s^2, along a motion (1 + n,) that begins where the law continues an earlier one."""

    def after(self, x: Array, v: Array, t: Array) -> ContinuedLaw:
        """The law that continues this motion, from its last node on."""


@dataclass(frozen=True)
class _Law:
    """The problem to solve: acceleration law, time axis and start (m, m/s).

    Several motions without memory may be solved together, each with its own start. A law with memory is called with
    the start in front of the nodes.
    """

    acceleration: Acceleration
    panels: Panels
    start: tuple[Start, Start]
    memory: bool
    slopes: Slopes | None = None
    continued: ContinuedLaw | None = None

    def at(self, x: Array, v: Array, start: tuple[Start, Start] | None = None) -> Array:
        """Acceleration at the nodes (3 p,) for a motion there."""
        t = self.panels.t
        if not self.memory:
            return self.acceleration(x, v, t)
        x0, v0 = start or self.start
        with_start = np.append(x0, x), np.append(v0, v), np.append(self.panels.edges[0], t)
        return self.acceleration(*with_start)[1:]

    def local(self, x: Array, v: Array) -> tuple[Array, LinearResponse]:
        """Acceleration at the nodes, and the response by its derivatives in x and v there, from differences."""
        ex, ev = _difference_steps(self.panels, x, v)
        if self.slopes is not None:
            f, a_x, a_v = self.slopes(x, v, ex, ev)
            return f, LinearResponse(self.panels, a_x, a_v)
        f = self.at(x, v)
        # Alternating signs from panel to panel: a law of the distance slid does not change under one common shift.
        e = ex * (1 - 2 * (np.arange(len(x)) // 3 % 2)) if self.memory else ex
        return f, LinearResponse(self.panels, (self.at(x + e, v) - f) / e, (self.at(x, v + ev) - f) / ev)

    def response(self, local: LinearResponse, f: Array, x: Array, v: Array) -> MotionResponse:
        """Response about a motion x, v along which the law gives f."""
        if not self.memory:
            return local
        reach, speed = max(float(np.ptp(x)), 1e-6), max(float(np.max(np.abs(v))), 1e-6)
        largest = max(float(np.max(np.abs(f))), 1e-6)

        def tangent(a: Array, start: Array) -> Array:
            dx, dv, _, _ = self.panels.integrate(a, float(start[0]), float(start[1]))
            of_motion = max(float(np.max(np.abs(dx))) / reach, float(np.max(np.abs(dv))) / speed)
            if not of_motion > 0:
                return np.zeros_like(f)
            of_force = float(np.max(np.abs(local.acceleration(dx, dv)))) / largest
            e = 1.0 / max(of_force / FORCE_CHANGE, of_motion / MAX_MOTION_CHANGE)
            begin = float(self.start[0]) + e * float(start[0]), float(self.start[1]) + e * float(start[1])
            return (self.at(x + e * dx, v + e * dv, begin) - f) / e

        return KrylovResponse(local, tangent)


def _difference_steps(panels: Panels, x: Array, v: Array) -> tuple[Array, Array]:
    """Steps of differences in position and velocity at every node (3 p,), over the range of its motion."""
    reach, speed = panels.largest(x) + panels.largest(-x), panels.largest(np.abs(v))
    ex, ev = RELATIVE_STEP * np.maximum(reach, 1e-3), RELATIVE_STEP * np.maximum(speed, 1e-3)
    return panels.per_node(ex), panels.per_node(ev)


def solve_motion(  # noqa: PLR0913 - one door to the solver, all settings named
    acceleration: Acceleration,
    panels: Panels,
    start: tuple[Start, Start],
    guess: Array,
    *,
    slopes: Slopes | None = None,
    memory: bool = False,
    near: MotionResponse | None = None,
    continued: ContinuedLaw | None = None,
) -> tuple[CollocationSolution, MotionResponse]:
    """Solve x'' = acceleration(x, v, t) from a given start, or several such motions together.

    Parameters
    ----------
    acceleration
        Function of position (m), velocity (m/s) and time (s) at the nodes that returns x'' (m/s^2). A law with
        `memory` gets the start and the nodes, (1 + 3 q,), where q counts the panels solved so far.
    panels
        Time axis of p panels; without `memory` it may hold several motions end to end.
    start
        Position (m) and velocity (m/s) at the first edge of every motion.
    guess
        First guess of x'' at the nodes, m/s^2, shape (3 p,).
    slopes
        Function of x, v and the steps of differences in each that returns x'' and its derivatives by x and v, for a
        law without memory; by default `acceleration` is called three times.
    memory
        Whether the law depends on the whole motion so far.
    near
        Response of a near motion, for a law with memory: Newton's method takes its derivatives while it converges.
    continued
        The same law with memory, which can be continued: a long motion is then not read again in every window.

    Returns
    -------
    motion : CollocationSolution
    response : MotionResponse
        Derivative of the motion with respect to small forces and to the start.

    Raises
    ------
    FrictrackError
        If Newton's method does not converge.

    References
    ----------
    Hairer, Norsett & Wanner 1993, Solving Ordinary Differential Equations I, section II.7.

    Examples
    --------
    Free fall from rest:

    >>> panels = Panels(np.array([0.0, 0.5, 1.0]))
    >>> motion, _ = solve_motion(lambda x, v, t: -9.81 + 0 * x, panels, (0.0, 0.0), np.zeros(6))
    >>> motion.x_edge.round(6).tolist()
    [0.0, -1.22625, -4.905]

    """
    law = _Law(acceleration, panels, start, memory, slopes, continued)
    guess = np.array(guess, dtype=float)
    with np.errstate(all="ignore"):  # a diverging law is reported below
        tolerance = MEMORY_TOLERANCE_M if memory else TOLERANCE_M
        solved = None if near is None else _newton_with_response(law, guess, near, tolerance)
        if solved is None:
            guess = _sweep_windows(law, guess) if memory else guess
            solved = _newton(law, guess, tolerance)
    if solved is None:
        raise FrictrackError(
            "the motion under this law could not be integrated; check mass, drive and the sign of incline "
            "(positive where the course rises toward +x)"
        )
    return solved


def solve_simplified_newton(
    law: Callable[[Array, Array], Array], panels: Panels, start: tuple[float, float], a: Array, tolerance: float
) -> CollocationSolution | None:
    """Solve a motion by Newton's method with one Jacobian, which ignores the law's memory.

    Memory changes little within a few oscillations, so derivatives at the nodes, recomputed once, are sufficient.

    Parameters
    ----------
    law
        Function of position (m) and velocity (m/s) at the nodes, each (3 p,), that returns x'' (m/s^2).
    panels, start
        Time axis; position (m) and velocity (m/s) at its first edge.
    a
        First guess of x'' at the nodes, m/s^2, shape (3 p,).
    tolerance
        Largest step at the edges at which the motion has converged, m.

    Returns
    -------
    CollocationSolution or None
        None if the steps grow or do not converge within `MAX_SIMPLIFIED_STEPS`.

    """
    size, response = np.inf, None
    for k in range(MAX_SIMPLIFIED_STEPS):
        x, v, x_edge, v_edge = panels.integrate(a, *start)
        f = law(x, v)
        if response is None or k == 1:
            ex, ev = RELATIVE_STEP * max(float(np.ptp(x)), 1e-3), RELATIVE_STEP * max(float(np.max(np.abs(v))), 1e-3)
            dx = ex * (1 - 2 * (np.arange(len(x)) // 3 % 2))  # alternating, as in `_Law.local`
            response = LinearResponse(panels, (law(x + dx, v) - f) / dx, (law(x, v + ev) - f) / ev)
        step, edges = response.newton_step(f - a)
        last, size = size, float(np.max(np.abs(edges)))
        if not size < min(2 * last, MAX_DISPLACEMENT_M):
            return None
        a = a + step
        if size <= tolerance:
            x, v, x_edge, v_edge = panels.integrate(a, *start)
            return CollocationSolution(panels, x, v, a, x_edge, v_edge)
    return None


def linearise_acceleration(
    acceleration: Acceleration,
    panels: Panels,
    motion: tuple[Array, Array],
    start: tuple[float, float] = (0.0, 0.0),
    *,
    memory: bool = False,
) -> tuple[Array, LinearResponse]:
    """Linearise a law along any motion, which need not satisfy it.

    Parameters
    ----------
    acceleration
        As in `solve_motion`.
    panels
        Time axis of p panels.
    motion
        Position (m) and velocity (m/s) at the nodes, each (3 p,).
    start
        Position and velocity at the first edge; only a law with memory needs them.
    memory
        Whether the law depends on the whole motion so far; the response ignores that memory.

    Returns
    -------
    tuple
        Acceleration at the nodes, m/s^2, (3 p,), and the response by its derivatives there.

    """
    return _Law(acceleration, panels, start, memory).local(*motion)


def _newton(law: _Law, a: Array, tolerance: float) -> tuple[CollocationSolution, MotionResponse] | None:
    """Iterate Newton's method from node accelerations a (3 p,); return None if it does not converge."""
    size = np.inf
    for _ in range(MAX_NEWTON_STEPS):
        x, v, x_edge, v_edge = law.panels.integrate(a, *law.start)
        kept = size <= JACOBIAN_REUSE_M and not law.memory  # near the solution the derivatives no longer change
        if kept:
            f = law.at(x, v)
        else:
            f, local = law.local(x, v)
            response = law.response(local, f, x, v)
        step, edges = response.newton_step(f - a)
        a = a + step
        reach = np.maximum(1.0, law.panels.largest_at_edges(np.abs(x_edge)))
        last, sizes = size, law.panels.largest_at_edges(np.abs(edges))
        size = float(np.max(sizes))
        if not max(size, float(np.max(reach))) < MAX_DISPLACEMENT_M:
            return None
        # with derivatives kept the error falls by a constant factor per step (Hairer & Wanner 1996, section IV.8)
        rate = size / last if kept and last > 0 else 1.0
        left = rate / (1 - rate) if rate < MAX_RATE else 1.0
        if np.all(left * sizes <= tolerance * reach):
            x, v, x_edge, v_edge = law.panels.integrate(a, *law.start)
            return CollocationSolution(law.panels, x, v, a, x_edge, v_edge), response
    return None


def _newton_with_response(
    law: _Law, a: Array, near: MotionResponse, tolerance: float
) -> tuple[CollocationSolution, MotionResponse] | None:
    """Iterate with the response of a near motion (the chord method); return None if it converges slowly or not."""
    size = np.inf
    for _ in range(MAX_CHORD_STEPS):
        x, v, x_edge, _ = law.panels.integrate(a, *law.start)
        step, edges = near.newton_step(law.at(x, v) - a)
        a = a + step
        last, size = size, float(np.max(np.abs(edges))) / max(1.0, float(np.max(np.abs(x_edge))))
        if not size < min(MAX_CHORD_RATE * last, MAX_DISPLACEMENT_M):
            return None
        if size <= tolerance:
            x, v, x_edge, v_edge = law.panels.integrate(a, *law.start)
            f, local = law.local(x, v)
            return CollocationSolution(law.panels, x, v, a, x_edge, v_edge), law.response(local, f, x, v)
    return None


def _sweep_windows(law: _Law, a: Array) -> Array:
    """Improve node accelerations (3 p,) under a law with memory, window by window, as far as windows converge."""
    a, done, window, total = a.copy(), 0, SWEEP_PANELS, len(law.panels.h)
    start = float(law.start[0]), float(law.start[1])
    edges, t = law.panels.edges, np.append(law.panels.edges[0], law.panels.t)
    x, v, present = np.array(start[:1]), np.array(start[1:]), law.continued  # the motion from where the law continues
    while done < total:
        until = min(done + window, total)
        now = t[3 * done + 1 - len(x) : 3 * until + 1]
        rows = slice(3 * done, 3 * until)
        acceleration = law.acceleration if present is None else present.acceleration

        def at(
            x_new: Array,
            v_new: Array,
            acceleration: Acceleration = acceleration,
            before: tuple[Array, Array] = (x, v),
            now: Array = now,
        ) -> Array:
            return acceleration(np.append(before[0], x_new), np.append(before[1], v_new), now)[len(before[0]) :]

        motion = solve_simplified_newton(at, Panels(edges[done : until + 1]), start, a[rows], SWEEP_TOLERANCE_M)
        if motion is None:
            window //= 2
            if window < MIN_SWEEP_PANELS:
                break
            continue
        a[rows], start = motion.a, (float(motion.x_edge[-1]), float(motion.v_edge[-1]))
        x, v, done = np.append(x, motion.x), np.append(v, motion.v), until
        if present is not None:
            present = present.after(x, v, now)
            x, v = x[-1:], v[-1:]
    return a
