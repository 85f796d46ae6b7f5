"""Apply the linear response of a motion to many forces at once, with forces and displacements at the panel edges.

Along a solved motion the state z = (x, v) answers an acceleration g by z[i + 1] = M[i] z[i] + w[i], w linear in g. With
the fundamental matrix P[i + 1] = M[i] P[i] this is z = P times the running sum of P^-1 w: two running sums per row
(variation of constants; Hairer, Norsett & Wanner 1993, Solving Ordinary Differential Equations I, section I.11). Within
a panel g is the cubic through its values at the nearest four edges.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array
from frictrack.simulate.dynamics.collocation import NODES, Panels
from frictrack.simulate.dynamics.linear_response import LinearResponse

MAX_CONDITION = 1e8  # of the fundamental matrix; beyond it running sums lose digits and panels are chained instead
N_INTERPOLATION_EDGES = 4  # of a cubic


class EdgeResponse:
    """Map accelerations at the panel edges to displacements there, at an unchanged start.

    Call it with accelerations (k, p + 1), m/s^2; it returns displacements (k, p + 1), m.

    Parameters
    ----------
    linear
        Response of the motion on p panels.

    Attributes
    ----------
    fundamental
        State (x, v) at each edge per unit of the state at the first edge, shape (p + 1, 2, 2).
    stiff
        Whether panels are chained one by one, because the fundamental matrix is ill-conditioned.
    weights
        Of the running sums, shape (5, p + 1), unless stiff: two rows multiply the accelerations before each sum, two
        the sums, the last one the acceleration at the edge.

    """

    def __init__(self, linear: LinearResponse) -> None:
        self._linear = linear
        first, weights = _stencils(linear.panels)
        self._first_edge = first
        self._kick = linear.end_gain @ weights  # (p, 2, 4)
        self.fundamental = _fundamental(linear.transition)  # (p + 1, 2, 2)
        with np.errstate(all="ignore"):  # singular where a state that is forgotten falls below the smallest number
            condition = np.abs(self.fundamental).max(axis=(1, 2)) ** 2 / np.abs(np.linalg.det(self.fundamental))
        self.stiff = not float(condition.max()) < MAX_CONDITION
        if not self.stiff:
            sums, own = self._running_sums(np.linalg.inv(self.fundamental)[1:] @ self._kick)
            self.weights = np.concatenate([sums, self.fundamental[:, 0].T, own[None]])

    @property
    def starts(self) -> Array:
        """Displacement at the edges per unit of start position (m) and of start velocity (m/s), shape (2, p + 1)."""
        return np.ascontiguousarray(self.fundamental[:, 0].T)

    def __call__(self, g: Array) -> Array:
        """Displacements (k, p + 1) for accelerations (k, p + 1)."""
        return self._by_chaining(g) if self.stiff else self._by_running_sums(g)

    def _by_chaining(self, g: Array) -> Array:
        """The same displacements by the banded system of `LinearResponse.chain_panels`."""
        nearest = g.T[self._first_edge[:, None] + np.arange(N_INTERPOLATION_EDGES)]  # (p, 4, k)
        edges = self._linear.chain_panels(np.zeros((2, len(g))), self._kick @ nearest)
        return np.ascontiguousarray(edges[:, 0].T)

    def _by_running_sums(self, g: Array) -> Array:
        out = g * self.weights[0]
        np.cumsum(out, axis=-1, out=out)
        out *= self.weights[2]
        other = g * self.weights[1]
        np.cumsum(other, axis=-1, out=other)
        other *= self.weights[3]
        out += other
        out += np.multiply(g, self.weights[4], out=other)
        return out

    def _running_sums(self, kick: Array) -> tuple[Array, Array]:
        """Weights (2, p + 1) of both running sums, and the correction (p + 1,) to them at each edge.

        A running sum up to an edge counts the cubics of the next panels only in part. For a smooth g the difference
        is a multiple of g at that edge.
        """
        p = len(kick)
        sums, early = np.zeros((2, p + 1)), np.zeros((p + 1, 2))
        panel = np.arange(p)
        for k in range(N_INTERPOLATION_EDGES):
            at = self._first_edge + k
            for total, own in zip(sums, kick[:, :, k].T, strict=True):
                np.add.at(total, at, own)
            for last in (
                at + gap for gap in range(-N_INTERPOLATION_EDGES + 1, N_INTERPOLATION_EDGES)
            ):  # edges up to which is summed
                inside = (last >= 0) & (last <= p)
                before, counted = inside & (panel < last) & (at > last), inside & (panel >= last) & (at <= last)
                np.add.at(early, last[before], kick[before, :, k])
                np.add.at(early, last[counted], -kick[counted, :, k])
        return sums, np.einsum("mc,mc->m", early, self.fundamental[:, 0])


def _stencils(panels: Panels) -> tuple[NDArray[np.int_], Array]:
    """First of the four edges that interpolate each panel (p,), and the Lagrange weights at its nodes (p, 3, 4)."""
    p = len(panels.h)
    first = np.clip(np.arange(p) - 1, 0, max(p + 1 - N_INTERPOLATION_EDGES, 0))
    edges = panels.edges[first[:, None] + np.arange(N_INTERPOLATION_EDGES)]
    nodes = panels.t.reshape(-1, len(NODES))
    weights = np.ones((p, len(NODES), N_INTERPOLATION_EDGES))
    for k in range(N_INTERPOLATION_EDGES):
        for other in range(N_INTERPOLATION_EDGES):
            if other != k:
                gap = (edges[:, k] - edges[:, other])[:, None]
                weights[:, :, k] *= (nodes - edges[:, other, None]) / gap
    return first, weights


def _fundamental(transition: Array) -> Array:
    """State at each edge per unit of the state at the first, (p + 1, 2, 2): running products of (p, 2, 2)."""
    out = np.empty((len(transition) + 1, 2, 2))
    out[0] = np.eye(2)
    (a, b, c, d), (e, f, g, h) = (1.0, 0.0, 0.0, 1.0), transition.reshape(-1, 4).T.tolist()
    for i, (m, n, o, q) in enumerate(zip(e, f, g, h, strict=True), start=1):
        a, b, c, d = m * a + n * c, m * b + n * d, o * a + q * c, o * b + q * d
        out[i, 0, 0], out[i, 0, 1], out[i, 1, 0], out[i, 1, 1] = a, b, c, d
    return out
