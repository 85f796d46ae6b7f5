"""Integrate the equation of motion m x'' = D(t) - F(x, v, t) by collocation, and linearise the solution; reversals.

The simulator and the fit share this integrator. Three steps use it:

- `Panels` cuts time into panels with three Gauss-Legendre nodes each;
- `solve_motion` returns the motion as a `CollocationSolution` and its `LinearResponse`, the derivative of the motion
  with respect to small forces and to the start;
- `EdgeResponse` applies such a response to many forces at once.

Dry friction jumps where a mass turns. At the nodes of that panel its direction is the quadratic that has the integral
and the first moments of the jump (its projection on Legendre polynomials), so that velocity and position at the end of
the panel are those of the jump itself, wherever in the panel it lies, and change smoothly as it moves.

The moment of the jump is where the motion before it passes through rest: a polynomial through the nodes of the panels
before, since the jump itself bends the motion around it.
"""

# ruff: noqa: F401 - the imports are the interface

from __future__ import annotations

import numpy as np

from frictrack.records import Array, Mask
from frictrack.simulate.dynamics.collocation import (
    MEMORY_TOLERANCE_M,
    NODES,
    NOT_INTEGRATED,
    TOLERANCE_M,
    CollocationSolution,
    EdgeResponse,
    LinearResponse,
    Panels,
    Start,
    difference_steps,
    response_with_memory,
    solve_motion,
    solve_simplified_newton,
)

SIDE_PANELS = 2  # panels through whose nodes the motion is extrapolated to a turn
NEWTON_STEPS = 4
MAX_MOVED = 1.0  # panel lengths by which the extrapolated turn may lie off the interpolated one
_U = 2 * NODES - 1


def directions(panels: Panels, v: Array) -> Array:
    """Direction of motion (3 p,) at the nodes of one motion for velocities (3 p,) there."""
    sign = np.sign(v)
    moves = np.flatnonzero(sign)
    if not len(moves):
        return sign
    turn = np.flatnonzero(sign[moves[1:]] != sign[moves[:-1]])
    first = sign[moves[0]]
    if not len(turn):
        return np.full_like(v, first)
    before, after = moves[turn], moves[turn + 1]
    t, edges = panels.t, panels.edges
    at = _extrapolated(panels, v, t[before] + (t[after] - t[before]) * v[before] / (v[before] - v[after]))
    panel = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, len(panels.h) - 1)
    turned = sign[after]
    out = first * (-1.0) ** np.searchsorted(at, panels.edges[panels.begin], side="right")
    nodes = np.repeat(out[:, None], 3, axis=1)
    y = 2 * (at - edges[panel]) / panels.h[panel] - 1
    np.add.at(nodes, panel, turned[:, None] * (1 + _projected(np.clip(y, -1.0, 1.0))))
    return nodes.ravel()


def mean_directions(v: Array) -> Array:
    """Direction of motion (n,), for velocities at equal steps, as its mean over half a step on either side of each."""
    between = (v[1:] + v[:-1]) / 2
    before, after = np.append(v[:1], between), np.append(between, v[-1:])
    return np.asarray((_mean_sign(before, v) + _mean_sign(v, after)) / 2)


def _mean_sign(a: Array, b: Array) -> Array:
    """Mean of the sign of a velocity that changes linearly from a to b."""
    gained = b - a
    return np.where(gained == 0, np.sign(a), (np.abs(b) - np.abs(a)) / np.where(gained == 0, 1.0, gained))


def _projected(y: Array) -> Array:
    """Projection (N, 3), at the nodes, of a jump from -1 to 1 at places y (N,) of a panel, from -1 to 1."""
    p2, p3 = (3 * y**2 - 1) / 2, (5 * y**3 - 3 * y) / 2
    return -y[:, None] - _U * (p2 - 1)[:, None] - (3 * _U**2 - 1) / 2 * (p3 - y)[:, None]


def _extrapolated(panels: Panels, v: Array, at: Array) -> Array:
    """Moments (N,) near the given ones at which the motion before passes through rest; where it begins, that after.

    The panels at the nearest edge are left out: the turn lies in one of them, and bends the motion there.
    """
    if len(panels.h) < SIDE_PANELS:
        return at
    edge = np.searchsorted((panels.edges[1:] + panels.edges[:-1]) / 2, at)
    before = edge > SIDE_PANELS
    begin = np.clip(np.where(before, edge - SIDE_PANELS - 1, edge + 1), 0, len(panels.h) - SIDE_PANELS)
    order, h = np.arange(3 * SIDE_PANELS), panels.h[begin]
    rows = 3 * begin[:, None] + order
    u = (panels.t[rows] - at[:, None]) / h[:, None]
    curve = np.linalg.solve(u[:, :, None] ** order, v[rows][:, :, None])[:, :, 0]
    moved = np.zeros_like(at)
    for _ in range(NEWTON_STEPS):
        powers = moved[:, None] ** order
        slope = np.sum(curve[:, 1:] * order[1:] * powers[:, :-1], axis=1)
        moved = moved - np.sum(curve * powers, axis=1) / np.where(slope == 0, np.inf, slope)
    known = _is_one_way(v[rows]) & (np.abs(moved) < MAX_MOVED)
    return np.sort(np.where(known, at + moved * h, at))


def _is_one_way(v: Array) -> Mask:
    """Whether velocities (N, k) have one sign each."""
    return np.asarray(np.all(v > 0, axis=1) | np.all(v < 0, axis=1))
