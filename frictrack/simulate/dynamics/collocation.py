"""Cut time into panels with three Gauss-Legendre nodes each, and integrate accelerations over them.

The method is Gauss-Legendre collocation of order 6 at the panel edges (Hairer, Norsett & Wanner 1993, Solving Ordinary
Differential Equations I, section II.7). `_A` and `_B` are its Butcher tableau; for x'' the tableau is applied twice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
    """Time axis cut into p panels with three nodes each.

    Attributes
    ----------
    edges
        Times at which panels begin and end, s, shape (p + 1,), increasing.

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

    @property
    def h(self) -> Array:
        """Panel lengths, s, shape (p,)."""
        return np.diff(self.edges)

    @property
    def t(self) -> Array:
        """Node times, s, shape (3 p,)."""
        return (self.edges[:-1, None] + self.h[:, None] * NODES).ravel()

    def integrate(self, a: Array, x0: float, v0: float) -> tuple[Array, Array, Array, Array]:
        """Integrate accelerations twice; exact for accelerations that are quadratic in time within each panel.

        Parameters
        ----------
        a
            Acceleration at the nodes, m/s^2, shape (3 p,).
        x0, v0
            Position (m) and velocity (m/s) at the first edge.

        Returns
        -------
        tuple of arrays
            Position and velocity at the nodes, each (3 p,), then position and velocity at the edges, each (p + 1,).

        """
        h, acc = self.h, a.reshape(-1, 3)
        v_edge = v0 + np.concatenate([[0.0], np.cumsum(h * (acc @ _B))])
        x_edge = x0 + np.concatenate([[0.0], np.cumsum(h * v_edge[:-1] + h**2 * (acc @ _BA))])
        v = v_edge[:-1, None] + h[:, None] * (acc @ _A.T)
        x = x_edge[:-1, None] + h[:, None] * NODES * v_edge[:-1, None] + (h**2)[:, None] * (acc @ _AA.T)
        return x.ravel(), v.ravel(), x_edge, v_edge


@dataclass(frozen=True)
class CollocationSolution:
    """Motion that satisfies the law at every node.

    Attributes
    ----------
    panels
        Time axis.
    x, v, a
        Position (m), velocity (m/s) and acceleration (m/s^2) at the nodes, each (3 p,).
    x_edge, v_edge
        Position (m) and velocity (m/s) at the panel edges, each (p + 1,).

    """

    panels: Panels
    x: Array
    v: Array
    a: Array
    x_edge: Array
    v_edge: Array
