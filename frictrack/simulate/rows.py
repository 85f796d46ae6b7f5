"""What many small forces do to one motion, all at once: forces and displacements at the panel edges, as rows.

Along a solved motion the state z = (x, v) answers an acceleration g by z[i + 1] = M[i] z[i] + w[i], w linear in g. With
the fundamental matrix P[i + 1] = M[i] P[i] this is z = P times the running sum of P^-1 w: two running sums per row
(variation of constants; Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, I.11). Within a panel g is
the cubic through its values at the nearest four edges.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array
from frictrack.simulate.dynamics import NODES, Linear, Panels

STIFF = 1e8  # condition of the fundamental matrix beyond which the panels are chained one by one
TAPS = 4


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
            self._sums, self._here = self._summed(inverse[1:] @ self._kick)

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
        out += np.multiply(g, self._here, out=other)
        return out

    def _chained(self, g: Array) -> Array:
        nearest = g.T[self._first[:, None] + np.arange(TAPS)]  # (p, 4, k)
        edges = self._linear.chained(np.zeros((2, len(g))), self._kick @ nearest)
        return np.ascontiguousarray(edges[:, 0].T)

    def _summed(self, kick: Array) -> tuple[Array, Array]:
        """Weights (2, p + 1) of both running sums, and of every edge itself what its running sums have too much.

        Up to an edge its neighbours are not all counted as they will be; for a smooth g that is a multiple of g there.
        """
        p = len(kick)
        sums, early = np.zeros((2, p + 1)), np.zeros((p + 1, 2))
        panel = np.arange(p)
        for k in range(TAPS):
            at = self._first + k
            for total, own in zip(sums, kick[:, :, k].T, strict=True):
                np.add.at(total, at, own)
            for last in (at + gap for gap in range(-TAPS + 1, TAPS)):  # edges up to which is summed
                inside = (last >= 0) & (last <= p)
                before, counted = inside & (panel < last) & (at > last), inside & (panel >= last) & (at <= last)
                np.add.at(early, last[before], kick[before, :, k])
                np.add.at(early, last[counted], -kick[counted, :, k])
        return sums, np.einsum("mc,mc->m", early, self.fundamental[:, 0])


def _stencils(panels: Panels) -> tuple[NDArray[np.int_], Array]:
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
