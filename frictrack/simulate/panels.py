"""Panels of three Gauss-Legendre nodes, a motion solved on them, and the linear response of a motion."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

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
        self._inverse = _inverse(stiffness)
        self._start = self._inverse @ start  # node response to the panel's first x and v
        self._end = np.stack([panels.h[:, None] ** 2 * _BA, panels.h[:, None] * _B], axis=1)  # (p, 2, 3)
        self.panels = panels
        self.across = self._end @ self._start  # from edge to edge, (p, 2, 2)
        self.across[:, 0, 0] += 1
        self.across[:, 0, 1] += panels.h
        self.across[:, 1, 1] += 1
        self._band = _chain(self.across)

    @cached_property
    def pushed(self) -> Array:
        """State at the end of every panel per unit of acceleration at its nodes, (p, 2, 3)."""
        return np.asarray(self._end @ self._inverse)

    def step(self, rest: Array) -> tuple[Array, Array]:
        """Node accelerations (3 p,) and edge positions (p + 1,) that make up for what is left of the equation."""
        a, edges = self.respond(rest[:, None], np.zeros((2, 1)))
        return a[:, 0], edges[:, 0, 0]

    def respond(self, g: Array, start: Array) -> tuple[Array, Array]:
        """Node accelerations (3 p, k) and edge states (p + 1, 2, k) for inputs g (3 p, k), start (2, k)."""
        k = g.shape[1]
        u = self._inverse @ g.reshape(-1, 3, k)
        edges = self.chained(start, self._end @ u)
        return (u + self._start @ edges[:-1]).reshape(-1, k), edges

    def moved(self, g: Array) -> Array:
        """Edge states alone, (p + 1, 2, k), from rest for inputs g (3 p, k)."""
        k = g.shape[1]
        return self.chained(np.zeros((2, k)), self.pushed @ g.reshape(-1, 3, k))

    def chained(self, start: Array, kicks: Array) -> Array:
        """Edge states (p + 1, 2, k) from a start (2, k) and what every panel adds at its end, (p, 2, k)."""
        k = start.shape[1]
        chain = np.concatenate([start[None], kicks]).reshape(-1, k)
        edges, info = dtbtrs(self._band, chain, uplo="L", diag="U")
        if info:
            raise FrictrackError("the motion could not be integrated: the linear system is singular")
        return np.asarray(edges.reshape(-1, 2, k))


def _inverse(a: Array) -> Array:
    """Inverse of 3 x 3 matrices (p, 3, 3) by their cofactors: short panels put them near the unit matrix.

    Raises FrictrackError where one is singular.
    """
    m = np.ascontiguousarray(a.transpose(1, 2, 0))
    out = np.empty_like(m)
    for i in range(3):
        for j in range(3):
            k, n, q, r = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            out[j, i] = m[k, q] * m[n, r] - m[k, r] * m[n, q]
    size = m[0, 0] * out[0, 0] + m[0, 1] * out[1, 0] + m[0, 2] * out[2, 0]
    if not size.all():
        raise FrictrackError("the motion could not be integrated: the linear system is singular")
    return np.ascontiguousarray((out / size).transpose(2, 0, 1))


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
