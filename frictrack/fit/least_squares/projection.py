"""Project a force that the model lacks onto what the model cannot explain: its trace in the residual.

A model that lacks a force compensates with its own parameters. Its residual is therefore not the missing force but
the trace of that force in the displacement minus its projection on the model's sensitivities. The model is linear
here: starts, coefficients, non-linear parameters, and friction levels as far as their scatter permits.
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

MIN_SINGULAR_VALUE = 1e-9  # relative; smaller singular values are not determined by the runs


@dataclass(frozen=True)
class ModelProjection:
    """The linearised model over all N frames and m penalty rows, and the residual orthogonal to it.

    Attributes
    ----------
    solution : Solution
        The fit.
    rows : list of slice
        Rows of every piece.
    u : array of shape (N + m, P')
        Orthonormal basis of the model.
    r : array of shape (N + m,)
        Whitened residual orthogonal to `u`.

    """

    solution: Solution
    rows: list[slice]
    u: Array
    r: Array

    @property
    def responses(self) -> list[PieceResponse]:
        """Responses of the pieces."""
        return self.solution.responses

    def with_columns(self, columns: Array) -> ModelProjection:
        """Return the projection with further columns (N + m, k) in the model."""
        left = columns - self.u @ (self.u.T @ columns)
        left -= self.u @ (self.u.T @ left)
        q, upper = np.linalg.qr(left)
        q = q[:, np.abs(np.diag(upper)) > MIN_SINGULAR_VALUE * np.linalg.norm(columns, axis=0)]
        return ModelProjection(self.solution, self.rows, np.hstack([self.u, q]), self.r - q @ (q.T @ self.r))


def model_projection(solution: Solution, kept: Sequence[int] | None = None) -> ModelProjection:
    """Compute the projection of a fitted model, linearised where it converged.

    Parameters
    ----------
    solution : Solution
        The fit.
    kept : sequence of int, optional
        Use only these unknowns.

    Returns
    -------
    ModelProjection
        Basis and residual.

    """
    layout = solution.problem.layout
    tau = solution.tau_of_other_runs
    rotated = solution.rotated_jacobian
    law = np.vstack([rotated.rows, penalty_jacobian(layout, tau, solution.p)])
    law = law if kept is None else law[:, kept]
    r = np.concatenate([solution.residual, -penalty_residual(layout, solution.p, tau)])
    norm = np.linalg.norm(law, axis=0)
    norm[norm == 0] = 1.0
    u, s, _ = np.linalg.svd(law / norm, full_matrices=False)
    u = u[:, s > MIN_SINGULAR_VALUE * s[0]] if len(s) else u
    few = len(rotated.rows)
    u = np.concatenate([rotated.expanded(u[:few]), u[few:]])
    ends = np.cumsum([0, *[len(response.r) for response in solution.responses]])
    rows = [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]
    return ModelProjection(solution, rows, u, r - u @ (u.T @ r))


def displacement_response(response: PieceResponse, force: Array) -> Array:
    """Compute the trace of forces in the displacement of one piece: whitened, start projected out.

    A model with memory responds here as if it had none; that is accurate enough over the range of a local force.

    Parameters
    ----------
    response : PieceResponse
        The piece under the model.
    force : array of shape (3 p, k)
        Forces at the nodes, N.

    Returns
    -------
    array of shape (n, k)
        Traces at the frames, in standard deviations.

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
    """Return position (m) and velocity (m/s) of the simulated motion at the frames of one piece, (n,) each."""
    piece = response.piece
    return response.motion.x_edge[piece.at], response.motion.v_edge[piece.at]
