"""Solve x'' = a(x, v, t) by collocation and Newton's method.

All panels are solved at once: linearised, each panel is a 3 x 3 system and panels are chained by a banded system
(`LinearResponse`), which carries on what a law with memory remembers, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.records import Array
from frictrack.simulate.dynamics.collocation import RELATIVE_STEP, CollocationSolution, LinearResponse, Panels, Start

MAX_NEWTON_STEPS = 30
MAX_DISPLACEMENT_M = 1e6  # beyond it the iteration has diverged
JACOBIAN_REUSE_M = 1e-6  # Newton step below which the linear response is no longer recomputed
MAX_RATE = 0.1  # of the fall of the error per step, below which the error of the last step is predicted
TOLERANCE_M = 1e-13  # Newton step at which a motion has converged; relative beyond 1 m
MEMORY_TOLERANCE_M = 2e-11  # relative beyond 1 m: a law with memory has a kink at every reversal
MAX_SIMPLIFIED_STEPS = 25

NOT_INTEGRATED = (
    "the motion under this law could not be integrated; check mass, drive and the sign of incline "
    "(positive where the course rises toward +x)"
)

Acceleration = Callable[[Array, Array, Array], Array]  # (x, v, t) -> x'', each (3 p,)


class Law(Protocol):
    """What accelerates a motion, whose derivatives may depend on all of it."""

    @property
    def tolerance(self) -> float:
        """Newton step at which a motion has converged, m; relative beyond 1 m."""

    def accelerations(self, motion: CollocationSolution) -> Array:
        """Acceleration at the nodes (3 p,), m/s^2, along a motion, which need not satisfy the law."""

    def linearised(self, motion: CollocationSolution) -> tuple[Array, LinearResponse]:
        """The same, and the response to small forces along that motion."""


@dataclass(frozen=True)
class LocalLaw:
    """A function of position (m), velocity (m/s) and time (s) at the nodes, (3 p,) each, without memory."""

    acceleration: Acceleration
    tolerance: float = TOLERANCE_M

    def accelerations(self, motion: CollocationSolution) -> Array:
        """Acceleration at the nodes of a motion."""
        return self.acceleration(motion.x, motion.v, motion.panels.t)

    def linearised(self, motion: CollocationSolution) -> tuple[Array, LinearResponse]:
        """The same, and the response by its derivatives in x and v, from differences."""
        x, v, t = motion.x, motion.v, motion.panels.t
        f, (ex, ev) = self.acceleration(x, v, t), difference_steps(motion)
        by_x, by_v = (self.acceleration(x + ex, v, t) - f) / ex, (self.acceleration(x, v + ev, t) - f) / ev
        return f, LinearResponse(motion.panels, by_x, by_v)


def difference_steps(motion: CollocationSolution) -> tuple[Array, Array]:
    """Steps of differences in position and velocity at every node (3 p,), over the range of its motion."""
    panels, x, v = motion.panels, motion.x, motion.v
    reach, speed = panels.largest(x) + panels.largest(-x), panels.largest(np.abs(v))
    ex, ev = RELATIVE_STEP * np.maximum(reach, 1e-3), RELATIVE_STEP * np.maximum(speed, 1e-3)
    return panels.per_node(ex), panels.per_node(ev)


def solve_motion(
    law: Law | Acceleration, panels: Panels, start: tuple[Start, Start], guess: Array
) -> tuple[CollocationSolution, LinearResponse]:
    """Solve x'' = acceleration(x, v, t) from a given start, or several such motions together.

    Parameters
    ----------
    law
        What accelerates; a function of position (m), velocity (m/s) and time (s) at the nodes that returns x'' (m/s^2)
        if it has no memory.
    panels
        Time axis of p panels; it may hold several motions end to end.
    start
        Position (m) and velocity (m/s) at the first edge of every motion.
    guess
        First guess of x'' at the nodes, m/s^2, shape (3 p,).

    Returns
    -------
    motion : CollocationSolution
    response : LinearResponse
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
    with np.errstate(all="ignore"):  # a diverging law is reported below
        solved = _newton(LocalLaw(law) if callable(law) else law, panels, start, np.array(guess, dtype=float))
    if solved is None:
        raise FrictrackError(NOT_INTEGRATED)
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
        x, v = panels.integrate(a, *start)[:2]
        f = law(x, v)
        if response is None or k == 1:
            ex, ev = RELATIVE_STEP * max(float(np.ptp(x)), 1e-3), RELATIVE_STEP * max(float(np.max(np.abs(v))), 1e-3)
            dx = ex * (1 - 2 * (np.arange(len(x)) // 3 % 2))  # alternating: the way slid does not feel a shift
            response = LinearResponse(panels, (law(x + dx, v) - f) / dx, (law(x, v + ev) - f) / ev)
        step, edges = response.newton_step(f - a)
        last, size = size, float(np.max(np.abs(edges)))
        if not size < min(2 * last, MAX_DISPLACEMENT_M):
            return None
        a = a + step
        if size <= tolerance:
            return integrated(panels, a, start)
    return None


def _newton(
    law: Law, panels: Panels, start: tuple[Start, Start], a: Array
) -> tuple[CollocationSolution, LinearResponse] | None:
    """Iterate Newton's method from node accelerations a (3 p,); return None if it does not converge."""
    size = np.inf
    for _ in range(MAX_NEWTON_STEPS):
        motion = integrated(panels, a, start)
        kept = size <= JACOBIAN_REUSE_M  # near the solution the derivatives no longer change
        if kept:
            f = law.accelerations(motion)
        else:
            f, response = law.linearised(motion)
        step, edges = response.newton_step(f - a)
        a = a + step
        reach = np.maximum(1.0, panels.largest_at_edges(np.abs(motion.x_edge)))
        last, sizes = size, panels.largest_at_edges(np.abs(edges))
        size = float(np.max(sizes))
        if not max(size, float(np.max(reach))) < MAX_DISPLACEMENT_M:
            return None
        # with derivatives kept the error falls by a constant factor per step (Hairer & Wanner 1996, section IV.8)
        rate = size / last if kept and last > 0 else 1.0
        left = rate / (1 - rate) if rate < MAX_RATE else 1.0
        if np.all(left * sizes <= law.tolerance * reach):
            return integrated(panels, a, start), response
    return None


def integrated(panels: Panels, a: Array, start: tuple[Start, Start]) -> CollocationSolution:
    """The motion with accelerations a (3 p,) at the nodes."""
    x, v, x_edge, v_edge = panels.integrate(a, *start)
    return CollocationSolution(panels, x, v, a, x_edge, v_edge)
