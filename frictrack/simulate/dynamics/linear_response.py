"""Compute the linear response of a motion: how it changes under a small force or a small change of the start.

The law is linearised along the motion: x'' = a_x x + a_v v + g. Within a panel that is a 3 x 3 system for the node
accelerations; from panel to panel the state (x, v) is carried on by a block bidiagonal system, solved as a banded one.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dtbtrs

from frictrack.errors import FrictrackError
from frictrack.records import Array
from frictrack.simulate.dynamics.collocation import _A, _AA, _B, _BA, NODES, Panels


class LinearResponse:
    """Linear response x'' = a_x x + a_v v + g of a motion on p panels.

    Parameters
    ----------
    panels
        Time axis.
    a_x, a_v
        Derivatives of the acceleration with respect to position (1/s^2) and velocity (1/s) at the nodes, each (3 p,).

    Attributes
    ----------
    transition
        State (x, v) at the end of each panel per unit of the state at its beginning, shape (p, 2, 2).

    """

    def __init__(self, panels: Panels, a_x: Array, a_v: Array) -> None:
        h = panels.h[:, None, None]
        ax, av = a_x.reshape(-1, 3, 1), a_v.reshape(-1, 3, 1)
        stiffness = np.eye(3) - ax * h**2 * _AA - av * h * _A
        start = np.concatenate([ax, ax * h * NODES[:, None] + av], axis=2)
        self._inverse = _invert_3x3(stiffness)
        self._start = self._inverse @ start  # node response to the panel's first x and v
        self._end = np.stack([panels.h[:, None] ** 2 * _BA, panels.h[:, None] * _B], axis=1)  # (p, 2, 3)
        self.panels = panels
        self.transition = self._end @ self._start
        self.transition[:, 0, 0] += 1
        self.transition[:, 0, 1] += panels.h
        self.transition[:, 1, 1] += 1
        self._band = _bidiagonal_band(self.transition)

    @cached_property
    def end_gain(self) -> Array:
        """State (x, v) at the end of each panel per unit of acceleration at its nodes, shape (p, 2, 3)."""
        return np.asarray(self._end @ self._inverse)

    def newton_step(self, residual: Array) -> tuple[Array, Array]:
        """Newton correction (node accelerations (3 p,), edge positions (p + 1,)) for a residual (3 p,)."""
        a, edges = self.respond(residual[:, None], np.zeros((2, 1)))
        return a[:, 0], edges[:, 0, 0]

    def respond(self, g: Array, start: Array) -> tuple[Array, Array]:
        """Compute the change of the motion under k small inputs.

        Parameters
        ----------
        g
            Added acceleration at the nodes, m/s^2, shape (3 p, k).
        start
            Change of position (m) and velocity (m/s) at the first edge, shape (2, k).

        Returns
        -------
        tuple of arrays
            Change of the node accelerations (3 p, k), and of the state (x, v) at the edges, (p + 1, 2, k).

        """
        k = g.shape[1]
        u = self._inverse @ g.reshape(-1, 3, k)
        edges = self.chain_panels(start, self._end @ u)
        return (u + self._start @ edges[:-1]).reshape(-1, k), edges

    def edge_states(self, g: Array) -> Array:
        """Change of the state at the edges, (p + 1, 2, k), under inputs g (3 p, k) at an unchanged start."""
        k = g.shape[1]
        return self.chain_panels(np.zeros((2, k)), self.end_gain @ g.reshape(-1, 3, k))

    def chain_panels(self, start: Array, kicks: Array) -> Array:
        """Carry states from panel to panel.

        Parameters
        ----------
        start
            State (x, v) at the first edge, (2, k).
        kicks
            What each panel adds to the state at its end, (p, 2, k).

        Returns
        -------
        Array
            State at the edges, (p + 1, 2, k).

        Raises
        ------
        FrictrackError
            If the banded system is singular.

        """
        k = start.shape[1]
        chain = np.concatenate([start[None], kicks]).reshape(-1, k)
        edges, info = dtbtrs(self._band, chain, uplo="L", diag="U")
        if info:
            raise FrictrackError("the motion could not be integrated: the linear system is singular")
        return np.asarray(edges.reshape(-1, 2, k))


def _invert_3x3(a: Array) -> Array:
    """Invert 3 x 3 matrices (p, 3, 3) by cofactors, which is accurate here: short panels put them near the identity.

    Raises FrictrackError if one of them is singular.
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


def _bidiagonal_band(transition: Array) -> Array:
    """Store the block bidiagonal system z[i + 1] - M[i] z[i] = w[i] as LAPACK lower bands, (4, 2 p + 2)."""
    p = len(transition)
    band = np.zeros((4, 2 * p + 2))
    band[0] = 1.0
    band[2, 0 : 2 * p : 2] = -transition[:, 0, 0]
    band[1, 1 : 2 * p : 2] = -transition[:, 0, 1]
    band[3, 0 : 2 * p : 2] = -transition[:, 1, 0]
    band[2, 1 : 2 * p : 2] = -transition[:, 1, 1]
    return band
