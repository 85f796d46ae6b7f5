"""Compute the linear response of a motion: how it changes under a small force or a small change of the start.

The law is linearised along the motion: x'' = a_x x + a_v v + g. Within a panel that is a 3 x 3 system for the node
accelerations; from panel to panel the state (x, v) is carried on by a block bidiagonal system, solved as a banded one.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dtbtrs

from frictrack.base.errors import FrictrackError
from frictrack.records import Array
from frictrack.simulate.dynamics.collocation import _A, _AA, _B, _BA, NODES, Panels


class LinearResponse:
    """Linear response x'' = a_x x + a_v v + g of a motion on p panels, or of R motions laid end to end.

    Parameters
    ----------
    panels
        Time axis.
    a_x, a_v
        Derivatives of the acceleration with respect to position (1/s^2) and velocity (1/s) at the nodes, each (3 p,).

    """

    def __init__(self, panels: Panels, a_x: Array, a_v: Array) -> None:
        self.panels = panels
        self._a_x, self._a_v = a_x, a_v

    def acceleration(self, dx: Array, dv: Array) -> Array:
        """Change of the acceleration at the nodes (3 p,), m/s^2, by small changes of position and velocity there."""
        return self._a_x * dx + self._a_v * dv

    def part(self, panels: Panels, nodes: slice) -> LinearResponse:
        """The response of one of the motions; `panels` is its time axis, `nodes` are its nodes."""
        return LinearResponse(panels, self._a_x[nodes], self._a_v[nodes])

    @property
    def transition(self) -> Array:
        """State (x, v) at the end of each panel per unit of the state at its beginning, shape (p, 2, 2)."""
        return np.ascontiguousarray(self._transition.transpose(2, 0, 1))

    @cached_property
    def end_gain(self) -> Array:
        """State (x, v) at the end of each panel per unit of acceleration at its nodes, shape (p, 2, 3)."""
        return np.ascontiguousarray(self._end_gain.transpose(2, 0, 1))

    # arrays over the panels end with the panel axis, so that every operation runs over all panels at once

    @cached_property
    def _inverse(self) -> Array:
        """Accelerations at the nodes per unit of what acts there, within one panel, (3, 3, p)."""
        h, ax, av = self.panels.h, self._a_x.reshape(-1, 3).T, self._a_v.reshape(-1, 3).T
        stiffness = -(ax * h**2)[:, None] * _AA[:, :, None] - (av * h)[:, None] * _A[:, :, None]
        return _invert_3x3(stiffness + np.eye(3)[:, :, None])

    @cached_property
    def _by_start(self) -> Array:
        """What the panel's first position and velocity act at the nodes, (3, 2, p)."""
        ax, av = self._a_x.reshape(-1, 3).T, self._a_v.reshape(-1, 3).T
        return np.stack([ax, ax * self.panels.h * NODES[:, None] + av], axis=1)

    @cached_property
    def _end_gain(self) -> Array:
        """State at the end of each panel per unit of acceleration at its nodes, (2, 3, p)."""
        h = self.panels.h
        return np.einsum("cip,ijp->cjp", np.stack([h**2 * _BA[:, None], h * _B[:, None]]), self._inverse)

    @cached_property
    def _transition(self) -> Array:
        """State at the end of each panel per unit of the state at its beginning, (2, 2, p)."""
        out: Array = np.einsum("cjp,jsp->csp", self._end_gain, self._by_start)
        out[0, 0] += 1
        out[0, 1] += self.panels.h
        out[1, 1] += 1
        return out

    @cached_property
    def _band(self) -> Array:
        """The system that carries states from panel to panel, as LAPACK lower bands."""
        return _bidiagonal_band(self._transition, self.panels)

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
        edges = self._carry(start[None], np.einsum("cjp,jp->cp", self._end_gain, at_nodes)[None])[0]
        at_nodes += np.einsum("jsp,sp->jp", self._by_start, edges[:, self.panels.begin])
        return np.einsum("ijp,jp->pi", self._inverse, at_nodes).ravel(), edges

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
        kicks = np.einsum("cjp,jkp->kcp", self._end_gain, at_nodes)
        first = np.zeros((k, 2, 1)) if start is None else start.T[:, :, None]
        return self._carry(first, kicks).transpose(2, 1, 0)

    def chain_panels(self, start: Array, kicks: Array) -> Array:
        """Carry states from panel to panel.

        Parameters
        ----------
        start
            State (x, v) at the first edge of every motion, (2, k).
        kicks
            What each panel adds to the state at its end, (p, 2, k).

        Returns
        -------
        Array
            State at the edges, (p + R, 2, k).

        Raises
        ------
        FrictrackError
            If the banded system is singular.

        """
        return self._carry(start.T[:, :, None], kicks.transpose(2, 1, 0)).transpose(2, 1, 0)

    def _carry(self, start: Array, kicks: Array) -> Array:
        """States (k, 2, p + R) at the edges from starts (k, 2, R or 1) and kicks (k, 2, p)."""
        k, panels = len(kicks), self.panels
        chain = np.empty((k, len(panels.edges), 2))
        states = chain.transpose(0, 2, 1)
        if len(panels.starts) == 1:
            states[:, :, 1:] = kicks
        else:
            states[:, :, panels.begin + 1] = kicks
        states[:, :, list(panels.starts)] = start
        solved, info = dtbtrs(self._band, chain.reshape(k, -1).T, uplo="L", diag="U", overwrite_b=True)
        if info:
            raise FrictrackError("the motion could not be integrated: the linear system is singular")
        return np.asarray(solved.T.reshape(k, -1, 2).transpose(0, 2, 1))


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
    """Store the block bidiagonal system z[i + 1] - M[i] z[i] = w[i] as LAPACK lower bands, (4, 2 p + 2 R).

    Nothing is carried from the last edge of a motion to the first of the next.
    """
    band = np.zeros((len(panels.edges), 2, 4))  # as LAPACK reads it: column by column
    band[:, :, 0] = 1.0
    begin = panels.begin
    band[begin, 0, 2] = -transition[0, 0]
    band[begin, 1, 1] = -transition[0, 1]
    band[begin, 0, 3] = -transition[1, 0]
    band[begin, 1, 2] = -transition[1, 1]
    return band.reshape(-1, 4).T
