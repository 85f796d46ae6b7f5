"""What many small forces do to one motion, all at once: forces and displacements at the panel edges, as rows.

Along a solved motion the state z = (x, v) answers an acceleration g by z[i + 1] = M[i] z[i] + w[i], w linear in g. With
the fundamental matrix P[i + 1] = M[i] P[i] this is z = P times the running sum of P^-1 w: two running sums per row
(variation of constants; Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, I.11). Within a panel g is
the cubic through its values at the nearest four edges.
"""

from __future__ import annotations

import numpy as np

from frictrack.records import Array
from frictrack.simulate.dynamics import NODES, Linear, Panels

STIFF = 1e8  # condition of the fundamental matrix beyond which the panels are chained one by one
TAPS = 4
NEAR = (-2, -1, 0, 1, 2)  # edges about one whose part in its running sum is not the usual


class Rows:
    """Displacements (k, p + 1) of a motion at its edges for accelerations (k, p + 1) there; it starts as it is."""

    def __init__(self, linear: Linear) -> None:
        self._linear = linear
        first, weights = _stencils(linear.panels)
        self._first = first
        self._kick = linear.pushed @ weights  # (p, 2, 4)
        self.fundamental = _fundamental(linear.across)  # (p + 1, 2, 2)
        inverse = np.linalg.inv(self.fundamental)
        size = np.abs(self.fundamental).max(axis=(1, 2)) * np.abs(inverse).max(axis=(1, 2))
        self.stiff = not float(size.max()) < STIFF
        if not self.stiff:
            self._sums, self._near = self._summed(inverse[1:] @ self._kick)

    @property
    def starts(self) -> Array:
        """What a unit of start position and of start speed does, (2, p + 1)."""
        return np.ascontiguousarray(self.fundamental[:, 0].T)

    def __call__(self, g: Array) -> Array:
        """Displacements (k, p + 1) for accelerations (k, p + 1)."""
        if self.stiff:
            return self._chained(g)
        x = self.fundamental[:, 0]
        out = np.cumsum(g * self._sums[0], axis=1)
        out *= x[:, 0]
        other = np.cumsum(g * self._sums[1], axis=1)
        other *= x[:, 1]
        out += other
        for near, tap in zip(NEAR, self._near, strict=True):
            _add(out, tap, g, near, other)
        return out

    def _chained(self, g: Array) -> Array:
        nearest = g.T[self._first[:, None] + np.arange(TAPS)]  # (p, 4, k)
        edges = self._linear.chained(np.zeros((2, len(g))), self._kick @ nearest)
        return np.ascontiguousarray(edges[:, 0].T)

    def _summed(self, kick: Array) -> tuple[Array, Array]:
        """Weights (2, p + 1) of both running sums, and what the edges near the last one have too much, (5, p + 1)."""
        p = len(kick)
        sums, near = np.zeros((2, p + 1)), np.zeros((len(NEAR), p + 1, 2))
        panel = np.arange(p)
        for k in range(TAPS):
            at = self._first + k
            np.add.at(sums, (slice(None), at), kick[:, :, k].T)
            for o, offset in enumerate(NEAR):
                last = at - offset  # the edge up to which is summed
                inside = (last >= 0) & (last <= p)
                early = inside & (panel < last) if offset > 0 else inside & (panel >= last)
                np.add.at(near[o], last[early], kick[early, :, k] * (1.0 if offset > 0 else -1.0))
        return sums, np.einsum("omc,mc->om", near, self.fundamental[:, 0])


def _add(out: Array, tap: Array, g: Array, offset: int, spare: Array) -> None:
    """Add tap[m] g[m + offset] to every row of `out`, in place; `spare` is room to work in."""
    used = np.flatnonzero(tap)
    if not len(used):
        return
    a, b = int(used[0]), int(used[-1]) + 1
    part = spare[:, a:b]
    np.multiply(g[:, a + offset : b + offset], tap[a:b], out=part)
    out[:, a:b] += part


def _stencils(panels: Panels) -> tuple[Array, Array]:
    """First of the four edges by which every panel is interpolated (p,), and their weights at its nodes (p, 3, 4)."""
    p = len(panels.h)
    first = np.clip(np.arange(p) - 1, 0, max(p + 1 - TAPS, 0))
    edges = panels.edges[first[:, None] + np.arange(TAPS)]
    nodes = panels.t.reshape(-1, len(NODES))
    weights = np.ones((p, len(NODES), TAPS))
    for k in range(TAPS):
        for other in range(TAPS):
            if other != k:
                gap = (edges[:, k] - edges[:, other])[:, None]
                weights[:, :, k] *= (nodes - edges[:, other, None]) / gap
    return first, weights


def _fundamental(across: Array) -> Array:
    """State at every edge per unit of the state at the first, (p + 1, 2, 2)."""
    out = np.empty((len(across) + 1, 2, 2))
    out[0] = np.eye(2)
    (a, b, c, d), (e, f, g, h) = (1.0, 0.0, 0.0, 1.0), across.reshape(-1, 4).T.tolist()
    for i, (m, n, o, q) in enumerate(zip(e, f, g, h, strict=True), start=1):
        a, b, c, d = m * a + n * c, m * b + n * d, o * a + q * c, o * b + q * d
        out[i, 0, 0], out[i, 0, 1], out[i, 1, 0], out[i, 1, 1] = a, b, c, d
    return out
