"""The model linearised where Gauss-Newton converged, and the residual orthogonal to it.

Most unknowns of many runs (starts, levels) belong to single runs, and a piece of n frames spans only as many directions
as it has active unknowns. An orthonormal rotation of its frames leaves that many rows different from zero: block
angular least squares. Normal matrix, singular values and right singular vectors stay the same.

A model that lacks a force compensates with its own parameters. Its residual is therefore not the missing force but
the trace of that force in the data minus its projection on the model's sensitivities.

References
----------
Bjorck, A. (1996). Numerical Methods for Least Squares Problems, section 6.3. SIAM.
Golub, G. H. & Van Loan, C. F. (2013). Matrix Computations, section 5.2. Johns Hopkins.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from frictrack.fit.least_squares.problem import LeastSquaresProblem, PieceResponse
from frictrack.fit.parameters import (
    MIN_RUNS_FOR_SCATTER,
    JacobianBasis,
    jacobian_basis,
    penalty_jacobian,
    penalty_residual,
    prior_jacobian,
    prior_residual,
)
from frictrack.fit.pieces import consecutive_slices
from frictrack.records import Array, Mask
from frictrack.search import COST_OF_MEMORY
from frictrack.simulate.dynamics import KrylovResponse, LinearResponse

MIN_TAU_OF_OTHER_RUNS = 1e-3  # relative standard deviation of the friction levels
MAX_DISTANCE_HELD = 1e-9  # from a bound at which an unknown is held, relative beyond 1
MIN_SINGULAR_VALUE_PROJECTED = 1e-9  # relative; smaller singular values are not determined by the runs


@dataclass(frozen=True)
class Solution:
    """Where Gauss-Newton converged, and the model linearised there.

    Attributes
    ----------
    problem : LeastSquaresProblem
        What was fitted.
    p : array of shape (P,)
        The unknowns.
    starts : list of array of shape (2,)
        Start position (m) and speed (m/s) of every piece.
    tau : float
        Relative standard deviation of the friction levels.
    responses : list of PieceResponse
        Residuals and sensitivities of all pieces.
    objective : float
        Chi-squared plus penalties.

    """

    problem: LeastSquaresProblem
    p: Array
    starts: list[Array]
    tau: float
    responses: list[PieceResponse]
    objective: float

    @classmethod
    def at(cls, problem: LeastSquaresProblem, p: Array, starts: Sequence[Array], tau: float) -> Solution:
        """Simulate and linearise a problem at given unknowns and starts."""
        problem.budget.spend(COST_OF_MEMORY if problem.model.memory else 1.0)
        return cls._of(problem, p, list(starts), tau, problem.evaluate(p, starts))

    @classmethod
    def _of(
        cls, problem: LeastSquaresProblem, p: Array, starts: list[Array], tau: float, responses: list[PieceResponse]
    ) -> Solution:
        penalty = penalty_residual(problem.layout, p, tau)
        objective = sum(float(r.r_full @ r.r_full) for r in responses) + float(penalty @ penalty)
        return cls(problem, p, starts, tau, responses, objective)

    @property
    def chi2(self) -> float:
        """Sum of squared whitened residuals."""
        return float(sum(r.r @ r.r for r in self.responses))

    @property
    def jac(self) -> Array:
        """Whitened Jacobian of all frames, starts projected out, (N, P)."""
        return self.stacked([r.jac for r in self.responses])

    @property
    def residual(self) -> Array:
        """Whitened residual of all frames, starts projected out, (N,)."""
        return np.concatenate([r.r for r in self.responses])

    def stacked(self, blocks: Sequence[Array]) -> Array:
        """Stack rows (m, A) of every piece in the columns of all unknowns, (sum of m, P)."""
        return stacked_rows(blocks, [r.active for r in self.responses], len(self.p))

    @property
    def basis(self) -> JacobianBasis:
        """Orthonormal basis of the linearised model."""
        rows, expanded = self.rotated_jacobian()
        few = self._basis_of(rows)
        return replace(few, u=expanded(few.u))

    @property
    def fitted_numbers(self) -> float:
        """How many numbers the data determine: the trace of the smoothing matrix, starts not counted.

        A friction level counts as the share of it that the scatter of the levels leaves to the data (Hastie,
        Tibshirani & Friedman 2009, The Elements of Statistical Learning, section 7.6).
        """
        return float(np.trace(self._basis_of(self.few_rows).shrink(self.tau or 0.03)))

    def rotated_jacobian(self) -> tuple[Array, Callable[[Array], Array]]:
        """Return the Jacobian in few rows (M, P), and the rotation of columns (M, k) back to all frames, (N, k)."""
        factors = [np.linalg.qr(r.jac) for r in self.responses]
        ends = np.cumsum([q.shape[1] for q, _ in factors])[:-1]

        def expanded(few: Array) -> Array:
            return np.concatenate([q @ own for (q, _), own in zip(factors, np.split(few, ends), strict=True)])

        return self.stacked([upper for _, upper in factors]), expanded

    @property
    def few_rows(self) -> Array:
        """Few rows (M, P) with the normal matrix, singular values and right singular vectors of `jac`."""
        return self.few_rows_and_residual[0]

    @cached_property
    def _few_rows_of_pieces(self) -> list[Array]:
        """The Jacobian of every piece, and its residual as the last column, in few rows (m, A + 1)."""
        return [np.asarray(np.linalg.qr(np.column_stack([r.jac, r.r]), mode="r")) for r in self.responses]

    @cached_property
    def few_rows_and_residual(self) -> tuple[Array, Array]:
        """The linearised model in few rows: Jacobian (M, P) and residual (M,)."""
        pieces = self._few_rows_of_pieces
        return self.stacked([rows[:, :-1] for rows in pieces]), np.concatenate([rows[:, -1] for rows in pieces])

    @property
    def penalised_rows_and_residual(self) -> tuple[Array, Array]:
        """The linearised objective in few rows: Jacobian (M, P) and residual (M,), penalties included."""
        rows, right = self.few_rows_and_residual
        layout = self.problem.layout
        rows = np.vstack([rows, penalty_jacobian(layout, self.tau, self.p)])
        return rows, np.concatenate([right, -penalty_residual(layout, self.p, self.tau)])

    def _basis_of(self, rows: Array) -> JacobianBasis:
        layout = self.problem.layout
        return jacobian_basis(rows, layout.levels, prior_jacobian(layout, self.p))

    @cached_property
    def held(self) -> Mask:
        """Parameters (P,) at a bound beyond which the objective would fall: there they are not free.

        Friction levels count as free: their bounds only keep them finite.
        """
        rows, right = self.penalised_rows_and_residual
        descent, margin = rows.T @ right, MAX_DISTANCE_HELD * (1 + np.abs(self.p))
        low, high = self.problem.layout.bounds
        held = ((self.p <= low + margin) & (descent < 0)) | ((self.p >= high - margin) & (descent > 0))
        held[self.problem.layout.levels] = False
        return held

    def random_effect_data(self) -> Array:
        """Return the residual with the fitted deviations of levels and priors added back, (N,).

        These are the data from which the scatter of the levels is estimated.
        """
        departure = self._departure()
        return np.concatenate([r.r + r.jac @ departure[r.active] for r in self.responses])

    def level_scatter(self) -> float:
        """Estimate tau, the relative standard deviation of the friction levels.

        The other unknowns enter as they do at level one. At the fitted levels l, more Coulomb friction and less of a
        constant force is the pattern l - 1 itself, which would leave no scatter.
        """
        rows, residual = self.few_rows_and_residual
        data = residual + rows @ self._departure()
        basis = self._basis_of(self._few_rows_at_level_one())
        return basis.spread(basis.u.T @ data, float(data @ data))

    def _few_rows_at_level_one(self) -> Array:
        """The Jacobian in few rows (M, P), its sensitivities to what carries the load over the level of the run."""
        layout = self.problem.layout
        levels = [layout.values(self.p, r.piece.run)[1] for r in self.responses]
        return self.stacked(
            [
                rows[:, :-1] / np.where(layout.loaded[r.active], level, 1.0)
                for rows, r, level in zip(self._few_rows_of_pieces, self.responses, levels, strict=True)
            ]
        )

    def scatter_penalty(self, tau: float) -> float:
        """Compute what integrating out levels of scatter tau adds to minus twice the log-likelihood."""
        if not self.levels_are_random:
            return 0.0
        levels = self.few_rows[:, self.problem.layout.levels]
        return float(np.linalg.slogdet(np.eye(levels.shape[1]) + tau**2 * (levels.T @ levels))[1])

    def with_scatter(self, tau: float) -> Solution:
        """Return the same unknowns and responses with another scatter of the levels."""
        scattered = self._of(self.problem, self.p, self.starts, tau, self.responses)
        vars(scattered)["_few_rows_of_pieces"] = self._few_rows_of_pieces  # of the same responses
        return scattered

    @property
    def tau_of_other_runs(self) -> float:
        """Scatter to expect of the friction levels of other runs: those of few runs may be nearly equal by chance."""
        return max(self.tau, MIN_TAU_OF_OTHER_RUNS)

    @property
    def levels_are_random(self) -> bool:
        """Whether the friction levels are a random effect."""
        return len(self.problem.layout.levels) >= MIN_RUNS_FOR_SCATTER

    def _departure(self) -> Array:
        """Fitted deviations (P,) of levels and priors."""
        layout = self.problem.layout
        departure = np.zeros(len(self.p))
        if layout.priors:
            departure = np.linalg.pinv(prior_jacobian(layout, self.p)) @ prior_residual(layout, self.p)
        departure[layout.levels] += self.p[layout.levels] - 1
        return departure


def stacked_rows(blocks: Sequence[Array], active: Sequence[Sequence[int]], n_unknowns: int) -> Array:
    """Stack rows (m, A) of pieces in the columns of all unknowns, (sum of m, P)."""
    out = np.zeros((sum(len(block) for block in blocks), n_unknowns))
    row = 0
    for block, columns in zip(blocks, active, strict=True):
        out[row : row + len(block), columns] = block
        row += len(block)
    return out


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
        q = q[:, np.abs(np.diag(upper)) > MIN_SINGULAR_VALUE_PROJECTED * np.linalg.norm(columns, axis=0)]
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
    few, expanded = solution.rotated_jacobian()
    law = np.vstack([few, penalty_jacobian(layout, tau, solution.p)])
    law = law if kept is None else law[:, kept]
    r = np.concatenate([solution.residual, -penalty_residual(layout, solution.p, tau)])
    norm = np.linalg.norm(law, axis=0)
    norm[norm == 0] = 1.0
    u, s, _ = np.linalg.svd(law / norm, full_matrices=False)
    u = u[:, s > MIN_SINGULAR_VALUE_PROJECTED * s[0]] if len(s) else u
    u = np.concatenate([expanded(u[: len(few)]), u[len(few) :]])
    rows = consecutive_slices(len(response.r) for response in solution.responses)
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
