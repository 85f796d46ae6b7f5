"""Integrate the equation of motion by collocation: panels with three Gauss-Legendre nodes each, and Newton's method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs

from frictrack.base.errors import FrictrackError
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
RELATIVE_STEP = 1e-7  # of a difference, over the range of x or v: the root of the rounding error, roughly
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


class LinearResponse:
    """Linear response x'' = a_x x + a_v v + g of a motion on p panels, or of R motions laid end to end.

    Parameters
    ----------
    panels
        Time axis.
    a_x, a_v
        Derivatives of the acceleration with respect to position (1/s^2) and velocity (1/s) at the nodes, each (3 p,).
    a_turn
        The same (1/s, (3 p,)) with respect to the velocity with which a panel is entered in which the motion turns.

    """

    def __init__(self, panels: Panels, a_x: Array, a_v: Array, a_turn: Array | None = None) -> None:
        self.panels = panels
        self._of_law = a_x, a_v, np.zeros_like(a_v) if a_turn is None else a_turn

    def part(self, panels: Panels, nodes: slice) -> LinearResponse:
        """The response of one of the motions; `panels` is its time axis, `nodes` are its nodes."""
        return LinearResponse(panels, *(own[nodes] for own in self._of_law))

    # arrays over the panels end with the panel axis, so that every operation runs over all panels at once

    @cached_property
    def within(self) -> WithinPanels:
        """How the law acts within the panels."""
        h, (ax, av, turn) = self.panels.h, (q.reshape(-1, 3).T for q in self._of_law)
        return WithinPanels(
            by_node=(ax * h**2)[:, None] * _AA[:, :, None] + (av * h)[:, None] * _A[:, :, None],
            by_start=np.stack([ax, ax * h * NODES[:, None] + av + turn], axis=1),
        )

    @cached_property
    def _inverse(self) -> Array:
        """Accelerations at the nodes per unit of what acts there, within one panel, (3, 3, p)."""
        return _invert_3x3(np.eye(3)[:, :, None] - self.within.by_node)

    @cached_property
    def _end_by_node(self) -> Array:
        """State at the end of each panel per unit of the accelerations at its nodes, (2 + k, 3, p)."""
        h = self.panels.h
        moved = np.stack([h**2 * _BA[:, None], h * _B[:, None]])
        return moved if self.within.kept_by_node is None else np.concatenate([moved, self.within.kept_by_node])

    @cached_property
    def end_gain(self) -> Array:
        """State at the end of each panel per unit of what acts at its nodes, (2 + k, 3, p)."""
        return np.einsum("cip,ijp->cjp", self._end_by_node, self._inverse)

    @cached_property
    def transition(self) -> Array:
        """State at the end of each panel per unit of the state at its beginning, (2 + k, 2 + k, p)."""
        out: Array = np.einsum("cjp,jsp->csp", self.end_gain, self.within.by_start)
        out[0, 0] += 1
        out[0, 1] += self.panels.h
        out[1, 1] += 1
        if self.within.kept_by_start is not None:
            out[2:] += self.within.kept_by_start
        return out

    @cached_property
    def _band(self) -> Array:
        """The system that carries states from panel to panel, as LAPACK lower bands."""
        return _bidiagonal_band(self.transition, self.panels)

    def newton_step(self, residual: Array) -> tuple[Array, Array]:
        """Newton correction (node accelerations (3 p,), edge positions (p + R,)) for a residual (3 p,)."""
        a, edges = self.respond_to_one(residual, np.zeros((2, 1)))
        return a, edges[0]

    def respond_to_one(self, g: Array, start: Array) -> tuple[Array, Array]:
        """Compute the change of the motion under one small input.

        Parameters
        ----------
        g
            Added acceleration at the nodes, m/s^2, shape (3 p,).
        start
            Change of position (m) and velocity (m/s) at the first edge of every motion, (2, R).

        Returns
        -------
        tuple of arrays
            Change of the node accelerations (3 p,), and of the state (x, v) at the edges, (2, p + R).

        """
        at_nodes = np.ascontiguousarray(g.reshape(-1, 3).T)
        states = self.carry(start[None], np.einsum("cjp,jp->cp", self.end_gain, at_nodes)[None])[0]
        at_nodes += np.einsum("jsp,sp->jp", self.within.by_start, states[:, self.panels.begin])
        return np.einsum("ijp,jp->pi", self._inverse, at_nodes).ravel(), states[:2]

    def respond(self, g: Array, start: Array) -> tuple[Array, Array]:
        """Compute the change of the motion under k small inputs.

        Parameters
        ----------
        g
            Added acceleration at the nodes, m/s^2, shape (3 p, k).
        start
            Change of position (m) and velocity (m/s) at the first edge of every motion, shape (2, k).

        Returns
        -------
        tuple of arrays
            Change of the node accelerations (3 p, k), and of the state (x, v) at the edges, (p + R, 2, k).

        """
        pairs = [self.respond_to_one(own, first[:, None]) for own, first in zip(g.T, start.T, strict=True)]
        nodes = np.stack([a for a, _ in pairs], axis=1) if pairs else np.zeros_like(g)
        return nodes, self.edge_states(g, start)

    def edge_states(self, g: Array, start: Array | None = None) -> Array:
        """Change of the state at the edges, (p + R, 2, k), under inputs g (3 p, k) and starts (2, k), default zero."""
        k = g.shape[1]
        at_nodes = np.ascontiguousarray(g.T.reshape(k, -1, 3).transpose(2, 0, 1))
        kicks = np.einsum("cjp,jkp->kcp", self.end_gain, at_nodes)
        first = np.zeros((k, 2, 1)) if start is None else start.T[:, :, None]
        return self.carry(first, kicks)[:, :2].transpose(2, 1, 0)

    def carry(self, start: Array, kicks: Array) -> Array:
        """States (k, d, p + R) at the edges from starts (k, 2, R or 1) and kicks (k, d, p)."""
        k, d, panels = len(kicks), kicks.shape[1], self.panels
        chain = np.empty((k, len(panels.edges), d))
        states, begins = chain.transpose(0, 2, 1), list(panels.starts)
        if len(begins) == 1:
            states[:, :, 1:] = kicks
        else:
            states[:, :, panels.begin + 1] = kicks
        states[:, :2, begins] = start
        if self.within.kept_at_start is not None:
            states[:, 2:, begins] = np.einsum("csr,ksr->kcr", self.within.kept_at_start, states[:, :2, begins])
        solved, info = dtbtrs(self._band, chain.reshape(k, -1).T, uplo="L", diag="U", overwrite_b=True)
        if info:
            raise FrictrackError("the motion could not be integrated: the linear system is singular")
        return np.asarray(solved.T.reshape(k, -1, d).transpose(0, 2, 1))


def _invert_3x3(m: Array) -> Array:
    """Invert 3 x 3 matrices (3, 3, p) by cofactors, which is accurate here: short panels put them near the identity.

    Raises FrictrackError if one of them is singular.
    """
    out = np.empty_like(m)
    for i in range(3):
        for j in range(3):
            k, n, q, r = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            out[j, i] = m[k, q] * m[n, r] - m[k, r] * m[n, q]
    size = m[0, 0] * out[0, 0] + m[0, 1] * out[1, 0] + m[0, 2] * out[2, 0]
    if not size.all():
        raise FrictrackError("the motion could not be integrated: the linear system is singular")
    out /= size
    return out


def _bidiagonal_band(transition: Array, panels: Panels) -> Array:
    """Store the block bidiagonal system z[i + 1] - M[i] z[i] = w[i] as LAPACK lower bands, (2 d, d (p + R)).

    Nothing is carried from the last edge of a motion to the first of the next.
    """
    d = len(transition)
    band = np.zeros((len(panels.edges), d, 2 * d))  # as LAPACK reads it: column by column
    band[:, :, 0] = 1.0
    for row in range(d):
        for column in range(d):
            band[panels.begin, column, d + row - column] = -transition[row, column]
    return band.reshape(-1, 2 * d).T


@dataclass(frozen=True)
class WithinPanels:
    """How a law acts within each of p panels, per unit of the state (x, v, y) at its beginning and of accelerations.

    Attributes
    ----------
    by_node, by_start
        Acceleration at the nodes by the accelerations there (3, 3, p), and by the state (3, 2 + k, p).
    kept_by_node, kept_by_start
        What is remembered at the end, by the same, (k, 3, p) and (k, 2 + k, p); None under a law without memory.
    kept_at_start
        What is remembered at the first edge of every motion, by its position and velocity there, (k, 2, R).

    """

    by_node: Array
    by_start: Array
    kept_by_node: Array | None = None
    kept_by_start: Array | None = None
    kept_at_start: Array | None = None


class ResponseWithMemory(LinearResponse):
    """Linear response of a motion on p panels, or of R motions laid end to end, under a law with memory."""

    def __init__(self, panels: Panels, within: WithinPanels) -> None:
        self.panels, self.within = panels, within

    def part(self, panels: Panels, nodes: slice) -> LinearResponse:
        """The response of one of the motions; `panels` is its time axis, `nodes` are its nodes."""
        rows, motion = (
            slice(nodes.start // 3, nodes.stop // 3),
            int(np.searchsorted(3 * self.panels.first, nodes.start)),
        )
        own = {f.name: getattr(self.within, f.name)[..., rows] for f in fields(WithinPanels)[:-1]}
        assert self.within.kept_at_start is not None
        return ResponseWithMemory(panels, WithinPanels(**own, kept_at_start=self.within.kept_at_start[..., [motion]]))


class LawWithMemory(Protocol):
    """A law whose memory y of k numbers is known wherever a panel begins."""

    def states(self, motion: CollocationSolution) -> Array:
        """What the law remembers at the beginning of every panel of a motion, (k, p)."""

    def within(self, x: Array, v: Array, states: Array, heading: Array) -> tuple[Array, Array]:
        """Accelerations at the nodes (3, p), and what is remembered at the end (k, p), of a motion within every panel.

        The motion x, v (5, p) is given where each panel begins, at its nodes, and where it ends; its direction is that
        of velocities `heading` (5, p).
        """

    def first_states(self, x: Array, v: Array) -> Array:
        """What the law remembers at the first edge of every motion, (k, R), that begins there with x, v (R,)."""


def response_with_memory(law: LawWithMemory, motion: CollocationSolution) -> ResponseWithMemory:
    """Differentiate a law with memory within every panel of a motion, by differences."""
    panels = motion.panels
    begin, end, h = panels.begin, panels.begin + 1, panels.h
    x, v = (
        np.stack([edge[begin], *node.reshape(-1, 3).T, edge[end]])
        for edge, node in ((motion.x_edge, motion.x), (motion.v_edge, motion.v))
    )
    states = law.states(motion)
    reach, speed = max(float(np.ptp(x)), 1e-3), max(float(np.max(np.abs(v))), 1e-3)
    at, still, unit = np.array([0.0, *NODES, 1.0]), np.zeros((5, len(h))), np.ones((5, len(h)))
    a, kept = law.within(x, v, states, v)

    def slopes(step: Array | float, dx: Array, dv: Array, dy: Array | float = 0.0, *, enters: bool = True) -> Array:
        """Change of the accelerations at the nodes, and of what is remembered at the end, (3 + k, p)."""
        # where a motion turns is known from how it enters a panel, not from what it does there
        moved = v + step * dv
        changed, own = law.within(x + step * dx, moved, states + step * dy, moved if enters else v)
        return np.concatenate([changed - a, own - kept]) / step

    by_start = [slopes(RELATIVE_STEP * reach, unit, still), slopes(RELATIVE_STEP * speed, at[:, None] * h, unit)]
    size = np.max(np.abs(states), axis=1, initial=0.0) + np.max(np.abs(kept - states), axis=1, initial=0.0)
    for y, one in zip(size, np.eye(len(states)), strict=True):
        by_start.append(slopes(RELATIVE_STEP * max(float(y), 1e-12), still, still, one[:, None]))
    by_node = [
        slopes(
            RELATIVE_STEP * speed / h,
            np.array([0.0, *_AA[:, j], _BA[j]])[:, None] * h**2,
            dv[:, None] * h,
            enters=False,
        )
        for j, dv in enumerate(np.column_stack([np.zeros(3), _A.T, _B]))
    ]
    x0, v0 = motion.x_edge[list(panels.starts)], motion.v_edge[list(panels.starts)]
    first, (ex, ev) = law.first_states(x0, v0), (RELATIVE_STEP * reach, RELATIVE_STEP * speed)
    at_start = [(law.first_states(x0 + ex, v0) - first) / ex, (law.first_states(x0, v0 + ev) - first) / ev]
    of_start, of_node = np.stack(by_start, axis=1), np.stack(by_node, axis=1)
    within = WithinPanels(of_node[:3], of_start[:3], of_node[3:], of_start[3:], np.stack(at_start, axis=1))
    return ResponseWithMemory(panels, within)


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
        State (x, v) at each edge per unit of the state at the first edge, (p + 1, 2, 2); only without memory.
    stiff
        Whether panels are chained one by one, because the fundamental matrix is ill-conditioned, or the law remembers.
    weights
        Of the running sums, shape (5, p + 1), unless stiff: two rows multiply the accelerations before each sum, two
        the sums, the last one the acceleration at the edge.

    """

    def __init__(self, linear: LinearResponse) -> None:
        self._linear = linear
        first, weights = _stencils(linear.panels)
        self._first_edge = first
        self._kick = linear.end_gain.transpose(2, 0, 1) @ weights  # (p, 2 + k, 4)
        self.stiff = len(linear.transition) > 2
        if self.stiff:
            return
        self.fundamental = _fundamental(linear.transition.transpose(2, 0, 1))  # (p + 1, 2, 2)
        with np.errstate(all="ignore"):  # singular where a state that is forgotten falls below the smallest number
            condition = np.abs(self.fundamental).max(axis=(1, 2)) ** 2 / np.abs(np.linalg.det(self.fundamental))
        self.stiff = not float(condition.max()) < MAX_CONDITION
        if not self.stiff:
            sums, own = self._running_sums(np.linalg.inv(self.fundamental)[1:] @ self._kick)
            self.weights = np.concatenate([sums, self.fundamental[:, 0].T, own[None]])

    @property
    def starts(self) -> Array:
        """Displacement at the edges per unit of start position (m) and of start velocity (m/s), shape (2, p + 1)."""
        return self._linear.edge_states(np.zeros((len(self._linear.panels.t), 2)), np.eye(2))[:, 0].T

    def __call__(self, g: Array) -> Array:
        """Displacements (k, p + 1) for accelerations (k, p + 1)."""
        return self._by_chaining(g) if self.stiff else self._by_running_sums(g)

    def _by_chaining(self, g: Array) -> Array:
        """The same displacements by the banded system of `LinearResponse.carry`."""
        nearest = g.T[self._first_edge[:, None] + np.arange(N_INTERPOLATION_EDGES)]  # (p, 4, k)
        kicks = (self._kick @ nearest).transpose(2, 1, 0)
        return np.ascontiguousarray(self._linear.carry(np.zeros((len(g), 2, 1)), kicks)[:, 0])

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
