"""What a force that the law lacks would leave in the runs, beside all that the law could still take up of it.

A law that lacks something bends to make up for it elsewhere, so its residual is not the missing force: it is that
force's trace in the displacement less the trace's projection on the law's own sensitivities. Here the law is linear:
starts, coefficients, non-linear parameters and friction levels as far as their scatter lets them.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.fit.least_squares.gauss_newton import Solution
from frictrack.fit.least_squares.problem import PieceResponse
from frictrack.fit.parameters import penalty_jacobian, penalty_residual
from frictrack.records import Array
from frictrack.simulate.dynamics import KrylovResponse, LinearResponse

MIN_SINGULAR_VALUE = 1e-9  # of the largest singular value: directions of the law that the runs do not show
MIN_SCATTER = 1e-3  # of the friction levels


@dataclass(frozen=True)
class ModelProjection:
    """The linearised law over all N frames and the m rows that hold it, and the residual beside it.

    `u` (N + m, P') is an orthonormal basis of the law, `r` (N + m,) what it leaves, whitened; `rows` of every piece.
    """

    solution: Solution
    rows: list[slice]
    u: Array
    r: Array

    @property
    def responses(self) -> list[PieceResponse]:
        """The pieces."""
        return self.solution.responses

    def with_columns(self, columns: Array) -> ModelProjection:
        """The same with further columns (N + m, k) in the law."""
        left = columns - self.u @ (self.u.T @ columns)
        left -= self.u @ (self.u.T @ left)
        q, upper = np.linalg.qr(left)
        q = q[:, np.abs(np.diag(upper)) > MIN_SINGULAR_VALUE * np.linalg.norm(columns, axis=0)]
        return ModelProjection(self.solution, self.rows, np.hstack([self.u, q]), self.r - q @ (q.T @ self.r))


def model_projection(solution: Solution, kept: Sequence[int] | None = None) -> ModelProjection:
    """The law of a solution, linearised where it came to rest; with `kept`, only these of its unknowns."""
    layout = solution.problem.layout
    tau = max(solution.tau, MIN_SCATTER)
    law = np.vstack([solution.jac, penalty_jacobian(layout, tau, solution.p)])
    law = law if kept is None else law[:, kept]
    r = np.concatenate([solution.residual, -penalty_residual(layout, solution.p, tau)])
    norm = np.linalg.norm(law, axis=0)
    norm[norm == 0] = 1.0
    u, s, _ = np.linalg.svd(law / norm, full_matrices=False)
    u = u[:, s > MIN_SINGULAR_VALUE * s[0]] if len(s) else u
    ends = np.cumsum([0, *[len(response.r) for response in solution.responses]])
    rows = [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]
    return ModelProjection(solution, rows, u, r - u @ (u.T @ r))


def displacement_response(response: PieceResponse, force: Array) -> Array:
    """What forces (3 p, k), N at the nodes of one piece, leave in it: whitened, start removed, (n, k).

    A law with memory answers as if it had none: over the reach of a local force that is near enough.
    """
    linear, piece = response.linear, response.piece
    if isinstance(linear, KrylovResponse):
        still = np.zeros(len(piece.panels.t))
        linear = LinearResponse(piece.panels, still, still)
    edges = linear.edge_states(-force / piece.mass)
    moved = piece.whitened((1 + response.shift_slope)[:, None] * edges[piece.at, 0])
    left: Array = moved - response.q @ (response.q.T @ moved)
    return left


def position_and_velocity(response: PieceResponse) -> tuple[Array, Array]:
    """Place and velocity of the law's own motion at the frames of one piece, m and m/s."""
    piece = response.piece
    return response.motion.x_edge[piece.at], response.motion.v_edge[piece.at]
