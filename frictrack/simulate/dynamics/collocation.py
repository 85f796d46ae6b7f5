"""Cut time into panels with three Gauss-Legendre nodes each, and integrate accelerations over them.

The method is Gauss-Legendre collocation of order 6 at the panel edges (Hairer, Norsett & Wanner 1993, Solving Ordinary
Differential Equations I, section II.7). `_A` and `_B` are its Butcher tableau; for x'' the tableau is applied twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask

Start = float | Array  # of one motion, or of each of several (R,)
Rows = NDArray[np.int_]

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
_WEIGHTS = np.column_stack([_B, _BA, _A.T, _AA.T])  # of velocity and position at the end and at the nodes


@dataclass(frozen=True)
class Panels:
    """Time axis cut into p panels with three nodes each; the axes of R motions may be laid end to end.

    Attributes
    ----------
    edges
        Times at which panels begin and end, s, shape (p + R,), increasing within each motion.
    starts
        Index of the first edge of each of the R motions.

    Examples
    --------
    >>> panels = Panels(np.array([0.0, 1.0, 2.0]))
    >>> len(panels.t)
    6
    >>> _, _, x_edge, v_edge = panels.integrate(np.full(6, 2.0), x0=1.0, v0=0.0)
    >>> x_edge.round(12).tolist(), v_edge.round(12).tolist()
    ([1.0, 2.0, 5.0], [0.0, 2.0, 4.0])

    """

    edges: Array
    starts: tuple[int, ...] = (0,)

    @classmethod
    def joined(cls, parts: Sequence[Panels]) -> Panels:
        """Lay the time axes of single motions end to end.

        Examples
        --------
        >>> one = Panels(np.array([0.0, 1.0, 2.0]))
        >>> both = Panels.joined([one, one])
        >>> len(both.h), both.starts
        (4, (0, 3))

        """
        if len(parts) == 1:
            return parts[0]
        counts = np.cumsum([0, *(len(part.edges) for part in parts)])
        return cls(np.concatenate([part.edges for part in parts]), tuple(counts[:-1].tolist()))

    @cached_property
    def h(self) -> Array:
        """Panel lengths, s, shape (p,)."""
        return np.diff(self.edges)[self._is_panel] if len(self.starts) > 1 else np.diff(self.edges)

    @cached_property
    def t(self) -> Array:
        """Node times, s, shape (3 p,)."""
        return (self.edges[self.begin, None] + self.h[:, None] * NODES).ravel()

    @cached_property
    def _is_panel(self) -> Mask:
        """Which of the intervals between neighbouring edges are panels; the others lie between two motions."""
        inside = np.ones(len(self.edges) - 1, dtype=bool)
        inside[np.array(self.starts[1:], dtype=int) - 1] = False
        return inside

    @cached_property
    def begin(self) -> Rows:
        """Index of the edge at which each panel begins, shape (p,)."""
        return np.flatnonzero(self._is_panel)

    @cached_property
    def counts(self) -> Rows:
        """Number of panels of each motion, shape (R,)."""
        return np.diff([*self.starts, len(self.edges)]) - 1

    @cached_property
    def first(self) -> Rows:
        """Index of the first panel of each motion, shape (R,)."""
        return np.array(self.starts) - np.arange(len(self.starts))

    def per_node(self, values: Array) -> Array:
        """One value per motion (R,), for each of its nodes, (3 p,)."""
        return np.repeat(values, 3 * self.counts)

    def largest(self, series: Array) -> Array:
        """Largest value of a series (3 p,) in each motion, (R,)."""
        return np.asarray(np.maximum.reduceat(series, 3 * self.first))

    def largest_at_edges(self, series: Array) -> Array:
        """Largest value of a series (p + R,) in each motion, (R,)."""
        return np.asarray(np.maximum.reduceat(series, np.array(self.starts)))

    def integrate(self, a: Array, x0: Start, v0: Start) -> tuple[Array, Array, Array, Array]:
        """Integrate accelerations twice; exact for accelerations that are quadratic in time within each panel.

        Parameters
        ----------
        a
            Acceleration at the nodes, m/s^2, shape (3 p,).
        x0, v0
            Position (m) and velocity (m/s) at the first edge, of every motion (R,) if there are several.

        Returns
        -------
        tuple of arrays
            Position and velocity at the nodes, each (3 p,), then position and velocity at the edges, each (p + R,).

        """
        h, sums = self.h, a.reshape(-1, 3) @ _WEIGHTS
        v_edge = self._running_sum(v0, h * sums[:, 0])
        x_edge = self._running_sum(x0, h * (v_edge[self.begin] + h * sums[:, 1]))
        h_node, elapsed, first = self._at_nodes
        v = h_node * sums[:, 2:5].ravel()
        x = h_node * (h_node * sums[:, 5:].ravel())
        v_begin = v_edge[first]
        v += v_begin
        x += x_edge[first]
        x += elapsed * v_begin
        return x, v, x_edge, v_edge

    @cached_property
    def _at_nodes(self) -> tuple[Array, Array, Rows]:
        """Of every node: the length of its panel, the time since its beginning, and the edge there, (3 p,) each."""
        return np.repeat(self.h, 3), (self.h[:, None] * NODES).ravel(), np.repeat(self.begin, 3)

    def _running_sum(self, start: Start, gains: Array) -> Array:
        """Running sum (p + R,) of gains (p,), begun anew at the start of every motion."""
        steps = np.empty(len(self.edges))
        steps[self.begin + 1] = gains
        steps[0] = np.ravel(start)[0]
        if len(self.starts) > 1:  # step back from the end of one motion to the start of the next
            begins = np.broadcast_to(start, len(self.starts))
            steps[list(self.starts[1:])] = begins[1:] - (begins + np.add.reduceat(gains, self.first))[:-1]
        return np.cumsum(steps)


@dataclass(frozen=True)
class CollocationSolution:
    """Motion that satisfies the law at every node; R motions if the panels are those of several.

    Attributes
    ----------
    panels
        Time axis.
    x, v, a
        Position (m), velocity (m/s) and acceleration (m/s^2) at the nodes, each (3 p,).
    x_edge, v_edge
        Position (m) and velocity (m/s) at the panel edges, each (p + R,).

    """

    panels: Panels
    x: Array
    v: Array
    a: Array
    x_edge: Array
    v_edge: Array

    def part(self, panels: Panels, nodes: slice, edges: slice) -> CollocationSolution:
        """The motion over some of the nodes and edges; `panels` is their time axis."""
        return CollocationSolution(
            panels, self.x[nodes], self.v[nodes], self.a[nodes], self.x_edge[edges], self.v_edge[edges]
        )
