"""Compute the linear response of a motion under a law with memory, by a Krylov method.

A force with memory depends on the whole motion so far, so derivatives at single nodes do not describe it. The response
is solved iteratively from directional differences of the law itself; the response without memory is the
preconditioner (Newton-Krylov methods: Knoll & Keyes 2004, J. Comput. Phys. 193, 357-397).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from frictrack.base.errors import FrictrackError
from frictrack.records import Array
from frictrack.simulate.dynamics.linear_response import LinearResponse

MAX_KRYLOV_DIRECTIONS = 80
N_FIRST_DIRECTIONS = 16  # that have room at first
MAX_CANCELLATION = 0.7  # share that remains after orthogonalisation; below it rounding errors are removed once more
MIN_NEW_SHARE = 1e-12  # share of a direction that remains after orthogonalisation; below it is rounding error
SENSITIVITY_RTOL = 1e-5  # residual over the input, of a sensitivity
CORRECTED_RTOL = 1e-4  # the same of its sum of directions, computed anew
MAX_CORRECTIONS, MIN_CORRECTION = 3, 0.5  # of this sum, and the share that one leaves at most
NEWTON_STEP_RTOL = 1e-4  # the same of a Newton step, which the next step corrects


@dataclass(eq=False)
class _Directions:
    """Solved directions: their inputs, node accelerations (m, 3 p) and edge states (m, 2 p + 2).

    The inputs are kept orthonormal (m, 3 p); `upper` (m, m) holds how the solved inputs are made of them. The arrays
    have room for more; `count` are in use.
    """

    inputs: Array
    upper: Array
    accelerations: Array
    edges: Array
    count: int = 0

    @classmethod
    def with_room(cls, nodes: int, edges: int) -> _Directions:
        """No directions yet."""
        m = N_FIRST_DIRECTIONS
        return cls(np.empty((m, nodes)), np.zeros((m, m)), np.empty((m, nodes)), np.empty((m, edges)))

    def append(self, w: Array, a: Array, edges: Array) -> bool:
        """Add the solution of an input w (3 p,); False if the known directions make up all of it."""
        made_of, new = self._orthogonalised(w)
        size = float(np.linalg.norm(new))
        if not size > MIN_NEW_SHARE * float(np.linalg.norm(w)):
            return False
        if self.count == len(self.inputs):
            self.inputs, self.accelerations, self.edges = (
                np.concatenate([q, np.empty_like(q)]) for q in (self.inputs, self.accelerations, self.edges)
            )
            self.upper = np.pad(self.upper, (0, self.count))
        self.inputs[self.count], self.accelerations[self.count], self.edges[self.count] = new / size, a, edges
        self.upper[: self.count, self.count], self.upper[self.count, self.count] = made_of, size
        self.count += 1
        return True

    def components(self, inputs: Array, last: int = 0) -> tuple[Array, Array]:
        """Components of an input (3 p,) in the orthonormal inputs from `last` on, and what is left of it."""
        used = self.inputs[last : self.count]
        c = used @ inputs
        return c, inputs - c @ used

    def _orthogonalised(self, w: Array) -> tuple[Array, Array]:
        """Components (m,) of an input in the known ones, and what is left of it."""
        made_of, left = self.components(w)
        if np.linalg.norm(left) < MAX_CANCELLATION * np.linalg.norm(w):
            again, left = self.components(left)  # twice is enough (Giraud & Langou 2003, SIAM J. Sci. Comput. 25)
            made_of = made_of + again
        return made_of, left

    def solution(self, components: Array) -> tuple[Array, Array]:
        """Node accelerations (3 p,) and edge states (2 p + 2,) under an input of given components (m,)."""
        m = len(components)
        c = solve_triangular(self.upper[:m, :m], components, check_finite=False) if m else components
        return c @ self.accelerations[:m], c @ self.edges[:m]


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
        self._directions = _Directions.with_room(len(local.panels.t), 2 * len(local.panels.edges))

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
        pairs = [self._solve_and_correct(g[:, j], start[:, j]) for j in range(g.shape[1])]
        if not all(np.all(np.isfinite(edges)) for _, edges in pairs):
            raise FrictrackError("the motion could not be integrated: a small change of this law has no bounds")
        a = np.stack([p[0] for p in pairs], axis=1) if pairs else np.zeros_like(g)
        return a, np.stack([p[1] for p in pairs], axis=2) if pairs else self._local.respond(g, start)[1]

    def respond_to_one(self, g: Array, start: Array) -> tuple[Array, Array]:
        """Compute the change of the motion under one small input; see `LinearResponse.respond_to_one`."""
        a, edges = self._solve_and_correct(g, start[:, 0])
        return a, edges.T

    def edge_states(self, g: Array, start: Array) -> Array:
        """Compute the change of the state at the edges, (p + 1, 2, k), under inputs g (3 p, k) and starts (2, k)."""
        return self.respond(g, start)[1]

    @np.errstate(all="ignore")
    def _solve_and_correct(self, g: Array, start: Array) -> tuple[Array, Array]:
        """Solve for one input, and correct the solution while that helps (iterative refinement).

        Directions of a stiff contact cancel by four decimals, and so multiply the errors of their differences: what
        the sum of them leaves is computed anew.
        """
        a, edges = self.solve(g, start)
        left = g + self._tangent(a, start) - a
        tolerance = CORRECTED_RTOL * max(float(np.linalg.norm(g)), float(np.linalg.norm(a)))
        for _ in range(MAX_CORRECTIONS):
            size = float(np.linalg.norm(left))
            if not size > tolerance:
                break
            more, more_edges = self.solve(left, np.zeros(2), max(SENSITIVITY_RTOL, tolerance / size))
            better = g + self._tangent(a + more, start) - a - more
            if not float(np.linalg.norm(better)) < MIN_CORRECTION * size:
                break
            a, edges, left = a + more, edges + more_edges, better
        return a, edges

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
        components = np.zeros(0)
        for left in range(MAX_KRYLOV_DIRECTIONS, -1, -1):
            own, residual = self._directions.components(residual, len(components))
            components, size = np.append(components, own), float(np.linalg.norm(residual))
            if size <= tolerance or not left or not self._add_direction(residual / size):
                break
        if not np.all(np.isfinite(residual)):
            return np.full_like(a, np.nan), np.full_like(edges, np.nan)
        a_own, edges_own = self._directions.solution(components)
        return a + a_own, edges + edges_own.reshape(edges.shape)

    def _add_direction(self, toward: Array) -> bool:
        """Solve one more direction; False if nothing new remains of it."""
        a, edges = (q[..., 0] for q in self._local.respond(toward[:, None], np.zeros((2, 1))))
        return self._directions.append(a - self._tangent(a, np.zeros(2)), a, edges.ravel())


MotionResponse = LinearResponse | KrylovResponse
