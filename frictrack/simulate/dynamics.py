"""The one integrator that the simulator and the fit share: m x'' = D(t) - F(x, v, t).

Gauss-Legendre collocation with three nodes per panel (order 6 at the panel edges; Hairer, Norsett & Wanner,
Solving Ordinary Differential Equations I, II.7). All panels are solved at once by Newton's method: linearised,
every panel is a 3 x 3 system and panels are chained by a triangular banded system. The same linear operator
returns sensitivities: how x responds to any small force along the solved motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dtbtrs

from frictrack.errors import FrictrackError
from frictrack.records import Array

_R = np.sqrt(15.0)
NODES = np.array([0.5 - _R / 10, 0.5, 0.5 + _R / 10])
_A = np.array(
    [
        [5 / 36, 2 / 9 - _R / 15, 5 / 36 - _R / 30],
        [5 / 36 + _R / 24, 2 / 9, 5 / 36 - _R / 24],
        [5 / 36 + _R / 30, 2 / 9 + _R / 15, 5 / 36],
    ]
)
_B = np.array([5 / 18, 4 / 9, 5 / 18])
_AA = _A @ _A
_BA = _B @ _A

MOST_STEPS = 30
RUNAWAY = 1e6  # m, beyond which there is no motion to speak of
SETTLING = 1e-6  # m, a Newton step below which the linear response is kept

Acceleration = Callable[[Array, Array, Array], Array]  # (x, v, t) -> x'', each (3 p,)


@dataclass(frozen=True)
class Panels:
    """A cut of time into p panels with three nodes each; edges (p + 1,), nodes t (3 p,)."""

    edges: Array

    @property
    def h(self) -> Array:
        """Panel lengths, s, shape (p,)."""
        return np.diff(self.edges)

    @property
    def t(self) -> Array:
        """Node times, s, shape (3 p,)."""
        return (self.edges[:-1, None] + self.h[:, None] * NODES).ravel()

    def integrate(self, a: Array, x0: float, v0: float) -> tuple[Array, Array, Array, Array]:
        """Position and velocity at the nodes (3 p,) and at the edges (p + 1,) for node accelerations a (3 p,)."""
        h, acc = self.h, a.reshape(-1, 3)
        v_edge = v0 + np.concatenate([[0.0], np.cumsum(h * (acc @ _B))])
        x_edge = x0 + np.concatenate([[0.0], np.cumsum(h * v_edge[:-1] + h**2 * (acc @ _BA))])
        v = v_edge[:-1, None] + h[:, None] * (acc @ _A.T)
        x = x_edge[:-1, None] + h[:, None] * NODES * v_edge[:-1, None] + (h**2)[:, None] * (acc @ _AA.T)
        return x.ravel(), v.ravel(), x_edge, v_edge


@dataclass(frozen=True)
class Motion6:
    """A solved motion: at the nodes (3 p,) and at the panel edges (p + 1,)."""

    panels: Panels
    x: Array
    v: Array
    a: Array
    x_edge: Array
    v_edge: Array


class Linear:
    """The linear response of the motion: x'' = a_x x + a_v v + g along a solved path.

    a_x, a_v: slopes of the acceleration at the nodes, shape (3 p,).
    """

    def __init__(self, panels: Panels, a_x: Array, a_v: Array) -> None:
        h = panels.h[:, None, None]
        ax, av = a_x.reshape(-1, 3, 1), a_v.reshape(-1, 3, 1)
        stiffness = np.eye(3) - ax * h**2 * _AA - av * h * _A
        start = np.concatenate([ax, ax * h * NODES[:, None] + av], axis=2)
        self._inverse = np.linalg.inv(stiffness)
        self._start = self._inverse @ start  # node response to the panel's first x and v
        self._end = np.stack([panels.h[:, None] ** 2 * _BA, panels.h[:, None] * _B], axis=1)  # (p, 2, 3)
        step = self._end @ self._start
        step[:, 0, 0] += 1
        step[:, 0, 1] += panels.h
        step[:, 1, 1] += 1
        self._band = _chain(step)

    def respond(self, g: Array, start: Array) -> tuple[Array, Array]:
        """Node accelerations (3 p, k) and edge states (p + 1, 2, k) for inputs g (3 p, k), start (2, k)."""
        k = g.shape[1]
        u = self._inverse @ g.reshape(-1, 3, k)
        chain = np.concatenate([start[None], self._end @ u]).reshape(-1, k)
        edges, info = dtbtrs(self._band, chain, uplo="L", diag="U")
        if info:
            raise FrictrackError("the motion could not be integrated: the linear system is singular")
        edges = edges.reshape(-1, 2, k)
        return (u + self._start @ edges[:-1]).reshape(-1, k), edges


def _chain(step: Array) -> Array:
    """Lower banded storage of the block bidiagonal system z[i + 1] - M[i] z[i] = w[i]."""
    p = len(step)
    band = np.zeros((4, 2 * p + 2))
    band[0] = 1.0
    band[2, 0 : 2 * p : 2] = -step[:, 0, 0]
    band[1, 1 : 2 * p : 2] = -step[:, 0, 1]
    band[3, 0 : 2 * p : 2] = -step[:, 1, 0]
    band[2, 1 : 2 * p : 2] = -step[:, 1, 1]
    return band


def slopes(acceleration: Acceleration, x: Array, v: Array, t: Array) -> tuple[Array, Array, Array]:
    """Acceleration and its slopes in x and v at the nodes, by differences."""
    ex = 1e-7 * max(float(np.ptp(x)), 1e-3)
    ev = 1e-7 * max(float(np.max(np.abs(v))), 1e-3)
    f = acceleration(x, v, t)
    return f, (acceleration(x + ex, v, t) - f) / ex, (acceleration(x, v + ev, t) - f) / ev


def solve(
    acceleration: Acceleration, panels: Panels, start: tuple[float, float], guess: Array, *, tolerance: float = 1e-13
) -> tuple[Motion6, Linear]:
    """Solve x'' = acceleration(x, v, t) from start = (x0, v0); guess is x'' at the nodes, shape (3 p,).

    Returns the motion and its linear response. Raises FrictrackError when Newton's method does not settle.
    """
    with np.errstate(all="ignore"):  # a wild law runs off to infinity, which is answered below
        solved = _newton(acceleration, panels, start, np.array(guess, dtype=float), tolerance)
    if solved is None:
        raise FrictrackError(
            "the motion under this law could not be integrated; check mass, drive and the sign of incline "
            "(positive where the course rises toward +x)"
        )
    return solved


def _newton(
    acceleration: Acceleration, panels: Panels, start: tuple[float, float], a: Array, tolerance: float
) -> tuple[Motion6, Linear] | None:
    """Newton's iterations from node accelerations a (3 p,); None when they do not settle."""
    moved = np.inf
    for _ in range(MOST_STEPS):
        x, v, x_edge, v_edge = panels.integrate(a, *start)
        if moved > SETTLING:  # near the solution the slopes no longer change
            f, f_x, f_v = slopes(acceleration, x, v, panels.t)
            response = Linear(panels, f_x, f_v)
        else:
            f = acceleration(x, v, panels.t)
        step, edges = response.respond((f - a)[:, None], np.zeros((2, 1)))
        a = a + step[:, 0]
        moved = float(np.max(np.abs(edges[:, 0])))
        if not max(moved, float(np.max(np.abs(x_edge)))) < RUNAWAY:
            return None
        if moved <= tolerance * max(1.0, float(np.max(np.abs(x_edge)))):
            x, v, x_edge, v_edge = panels.integrate(a, *start)
            return Motion6(panels, x, v, a, x_edge, v_edge), response
    return None
