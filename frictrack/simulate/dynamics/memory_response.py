"""Compute the linear response of a motion under a law with memory, by a Krylov method.

A force with memory depends on the whole motion so far, so derivatives at single nodes do not describe it. The response
is solved iteratively from directional differences of the law itself; the response without memory is the
preconditioner (Newton-Krylov methods: Knoll & Keyes 2004, J. Comput. Phys. 193, 357-397).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.records import Array
from frictrack.simulate.dynamics.linear_response import LinearResponse

MAX_KRYLOV_DIRECTIONS = 80
N_FIRST_DIRECTIONS = 16  # that have room at first
MIN_NEW_SHARE = 1e-12  # share of a direction that remains after orthogonalisation; below it is rounding error
SENSITIVITY_RTOL = 1e-5  # residual over the input, of a sensitivity
NEWTON_STEP_RTOL = 1e-4  # the same of a Newton step, which the next step corrects


@dataclass(eq=False)
class _Directions:
    """Solved directions: orthonormal inputs (m, 3 p), their node accelerations (m, 3 p) and edge states (m, 2 p + 2).

    The arrays have room for more; `count` are in use.
    """

    inputs: Array
    accelerations: Array
    edges: Array
    count: int = 0

    def append(self, w: Array, a: Array, edges: Array) -> None:
        """Add a direction; the room is doubled where it is used up."""
        if self.count == len(self.inputs):
            self.inputs, self.accelerations, self.edges = (
                np.concatenate([q, np.empty_like(q)]) for q in (self.inputs, self.accelerations, self.edges)
            )
        self.inputs[self.count], self.accelerations[self.count], self.edges[self.count] = w, a, edges
        self.count += 1

    def components(self, inputs: Array, last: int = 0) -> tuple[Array, Array, Array]:
        """Parts of an input (3 p,) in the directions from `last` on: in inputs, accelerations and edge states."""
        used = slice(last, self.count)
        c = self.inputs[used] @ inputs
        return c @ self.inputs[used], c @ self.accelerations[used], c @ self.edges[used]


class KrylovResponse:
    """Linear response of a motion under a law with memory, with the interface of `LinearResponse`.

    Directions that were solved for one input are reused for the next.

    Parameters
    ----------
    local
        Response of the same law without its memory; the preconditioner.
    tangent
        Function of node accelerations (3 p,) and of a change of the start (2,). It returns the change of the law's
        acceleration (3 p,) along that small change of the motion.

    """

    def __init__(self, local: LinearResponse, tangent: Callable[[Array, Array], Array]) -> None:
        self._local, self._tangent = local, tangent
        nodes, edges = (N_FIRST_DIRECTIONS, len(local.panels.t)), (N_FIRST_DIRECTIONS, 2 * len(local.panels.edges))
        self._directions = _Directions(np.empty(nodes), np.empty(nodes), np.empty(edges))

    def newton_step(self, residual: Array) -> tuple[Array, Array]:
        """Newton correction (node accelerations (3 p,), edge positions (p + 1,)) for a residual (3 p,)."""
        a, edges = self.solve(residual, np.zeros(2), NEWTON_STEP_RTOL)
        return a, edges[:, 0]

    def respond(self, g: Array, start: Array) -> tuple[Array, Array]:
        """Compute the change of the motion under k small inputs; see `LinearResponse.respond`.

        Raises
        ------
        FrictrackError
            If the response grows beyond all bounds.

        """
        pairs = [self.solve(g[:, j], start[:, j]) for j in range(g.shape[1])]
        if not all(np.all(np.isfinite(edges)) for _, edges in pairs):
            raise FrictrackError("the motion could not be integrated: a small change of this law has no bounds")
        a = np.stack([p[0] for p in pairs], axis=1) if pairs else np.zeros_like(g)
        return a, np.stack([p[1] for p in pairs], axis=2) if pairs else self._local.respond(g, start)[1]

    def respond_to_one(self, g: Array, start: Array) -> tuple[Array, Array]:
        """Compute the change of the motion under one small input; see `LinearResponse.respond_to_one`."""
        a, edges = self.solve(g, start[:, 0])
        return a, edges.T

    def edge_states(self, g: Array, start: Array) -> Array:
        """Compute the change of the state at the edges, (p + 1, 2, k), under inputs g (3 p, k) and starts (2, k)."""
        return self.respond(g, start)[1]

    @np.errstate(all="ignore")  # a response that grows beyond all bounds becomes NaN
    def solve(self, g: Array, start: Array, rtol: float = SENSITIVITY_RTOL) -> tuple[Array, Array]:
        """Solve for one input by generalised conjugate residuals, preconditioned from the right.

        Parameters
        ----------
        g
            Added acceleration at the nodes, m/s^2, shape (3 p,).
        start
            Change of position and velocity at the first edge, (2,).
        rtol
            Norm of the residual over the norm of the input at which the iteration ends.

        Returns
        -------
        tuple of arrays
            Change of the node accelerations (3 p,), and of the state at the edges (p + 1, 2). Both are NaN if the law
            runs off to infinity.

        References
        ----------
        Eisenstat, Elman & Schultz 1983, SIAM J. Numer. Anal. 20, 345-357.

        """
        a, edges = (q[..., 0] for q in self._local.respond(np.zeros((len(g), 1)), start[:, None]))
        residual = g + self._tangent(a, start) - a if np.any(start) else g
        tolerance = rtol * max(float(np.linalg.norm(g)), float(np.linalg.norm(a)))
        known = 0  # directions that the residual is free of
        for left in range(MAX_KRYLOV_DIRECTIONS, -1, -1):
            own, a_own, edges_own = self._directions.components(residual, known)
            a, edges, residual = a + a_own, edges + edges_own.reshape(edges.shape), residual - own
            known, size = self._directions.count, float(np.linalg.norm(residual))
            if size <= tolerance or not left or not self._add_direction(residual / size):
                break
        if not np.all(np.isfinite(residual)):
            return np.full_like(a, np.nan), np.full_like(edges, np.nan)
        return a, edges

    def _add_direction(self, toward: Array) -> bool:
        """Solve one more direction, orthogonal to all before; False if nothing new remains of it."""
        a, edges = (q[..., 0] for q in self._local.respond(toward[:, None], np.zeros((2, 1))))
        w, edges = a - self._tangent(a, np.zeros(2)), edges.ravel()
        full_size = float(np.linalg.norm(w))
        for _ in range(2):  # Gram-Schmidt twice is enough (Giraud & Langou 2003, SIAM J. Sci. Comput. 25)
            own, a_own, edges_own = self._directions.components(w)
            w, a, edges = w - own, a - a_own, edges - edges_own
        size = float(np.linalg.norm(w))
        if not size > MIN_NEW_SHARE * full_size:
            return False
        self._directions.append(w / size, a / size, edges / size)
        return True


MotionResponse = LinearResponse | KrylovResponse
