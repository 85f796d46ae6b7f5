"""Fit accelerations, as the papers do: low-pass and double difference, with the model through the same chain.

For a fixed cut-off frequency the chain is a linear map K from the frames of a piece to accelerations. Measured minus
modelled acceleration is K (y - y_model), with sensitivities K J. All residuals have equal weight, as in the papers,
although their noise grows with the square of the frequency. So the covariance is the sandwich H^-1 J' V J H^-1 with V
= K diag(sigma^2) K'. Start position and speed are fitted to the displacement, because the chain removes them.

References
----------
White, H. (1982). Maximum likelihood estimation of misspecified models. Econometrica 50, 1-25.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.distributions import student_ppf
from frictrack.fit.least_squares import (
    LeastSquaresProblem,
    PieceResponse,
    Solution,
    fit_with_scatter,
    inverse_normal_matrix,
    refine,
)
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER, penalty_jacobian
from frictrack.fit.pieces import AccelerationChain, acceleration_chains, acceleration_noise
from frictrack.records import Array, Run


@dataclass(frozen=True)
class ForceResponse(PieceResponse):
    """The response of a piece after the chain; `displacement` is the response before it."""

    displacement: PieceResponse

    def start_step(self, step: Array) -> Array:
        """Compute the change of (x0, v0) that the displacement asks for."""
        return self.displacement.start_step(step)


class ForceProblem(LeastSquaresProblem):
    """The displacement problem seen through the acceleration chains, one per piece, in units of one common noise."""

    def __init__(self, problem: LeastSquaresProblem, chains: Sequence[AccelerationChain]) -> None:
        super().__init__(problem.model, problem.layout, problem.pieces)
        self.chains = list(chains)
        self.noise = acceleration_noise(chains)

    def evaluate(self, p: Array, starts: Sequence[Array]) -> list[PieceResponse]:
        """Simulate every piece and linearise it, seen through its chain."""
        return [self._filtered(i, r) for i, r in enumerate(super().evaluate(p, starts))]

    def _filtered(self, i: int, displacement: PieceResponse) -> PieceResponse:
        """The response of piece i after its chain."""
        columns = displacement.piece.coloured(np.column_stack([displacement.jac, displacement.r]))
        filtered = self.chains[i].apply(columns) / self.noise
        known = {name: getattr(displacement, name) for name in PieceResponse.__dataclass_fields__}
        return ForceResponse(
            **known
            | {
                "jac": filtered[:, :-1],
                "r": filtered[:, -1],
                "r_full": filtered[:, -1],
            },
            displacement=displacement,
        )

    def noise_in(self, responses: Sequence[PieceResponse], columns: Array) -> Array:
        """Compute the displacement noise that enters products with columns.

        Parameters
        ----------
        responses : sequence of PieceResponse
            The pieces.
        columns : array of shape (M, k)
            Columns over all compared accelerations.

        Returns
        -------
        array of shape (N, k)
            Z with Z'Z = columns' V columns, frame by frame in units of sigma.

        """
        out, at = [], 0
        for chain, response in zip(self.chains, responses, strict=True):
            mine = columns[at : at + len(response.r)]
            at += len(response.r)
            back = response.piece.coloured_transposed(chain.transposed(mine)) / self.noise
            out.append(back - response.q @ (response.q.T @ back))
        return np.concatenate(out)


def linearise_in_force_domain(solution: Solution, runs: Sequence[Run]) -> Solution:
    """Return the same solution, linearised in the force domain."""
    problem = ForceProblem(solution.problem, acceleration_chains(runs, solution.problem.pieces))
    held = np.zeros(len(solution.p), dtype=bool)
    return refine(problem, solution.p, solution.starts, tau=solution.tau, free=held, max_steps=0)


def fit_accelerations(solution: Solution, runs: Sequence[Run]) -> Solution:
    """Minimise the squared acceleration residuals, starting from the best fit of the displacement.

    Parameters
    ----------
    solution : Solution
        The fit of the displacement.
    runs : sequence of Run
        The fitted runs.

    Returns
    -------
    Solution
        The fit in the force domain.

    """
    problem = ForceProblem(solution.problem, acceleration_chains(runs, solution.problem.pieces))
    return fit_with_scatter(problem, solution.p, solution.starts, solution.tau or 0.03)


def fit_starts(problem: LeastSquaresProblem, p: Array, starts: Sequence[Array], tau: float) -> Solution:
    """Fit only the starts, in the displacement domain.

    Parameters
    ----------
    problem : LeastSquaresProblem
        The displacement problem.
    p : array of shape (P,)
        The unknowns, which stay as they are.
    starts : sequence of array of shape (2,)
        First starts.
    tau : float
        Relative standard deviation of the friction levels.

    Returns
    -------
    Solution
        The same unknowns with fitted starts.

    """
    return refine(problem, p, starts, tau=tau, free=np.zeros(len(p), dtype=bool))


def reduced_chi2(solution: Solution) -> float:
    """Compute chi-squared over its expectation for the coloured noise of the accelerations."""
    problem = solution.problem
    assert isinstance(problem, ForceProblem)
    z = problem.noise_in(solution.responses, solution.basis.u)
    return solution.chi2 / (len(solution.residual) - float(np.sum(z**2)))


def sandwich_covariance(solution: Solution) -> Array:
    """Compute the sandwich covariance of the unknowns in the force domain.

    The part that comes from the scatter of the friction levels is widened to Student's t.

    Parameters
    ----------
    solution : Solution
        A fit of a `ForceProblem`.

    Returns
    -------
    array of shape (P, P)
        Covariance of the unknowns.

    References
    ----------
    Huber, P. J. (1967). Proc. Fifth Berkeley Symposium 1, 221-233.
    White, H. (1982). Econometrica 50, 1-25.

    """
    problem = solution.problem
    assert isinstance(problem, ForceProblem)
    layout = problem.layout
    jac = solution.jac
    z = problem.noise_in(solution.responses, jac)
    rows = penalty_jacobian(layout, solution.tau or 0.03)
    bread, _ = inverse_normal_matrix(np.vstack([jac, rows]))
    if len(layout.levels) < MIN_RUNS_FOR_SCATTER:
        return bread @ (z.T @ z) @ bread
    full = bread @ (z.T @ z + rows.T @ rows) @ bread
    held, _ = inverse_normal_matrix(np.vstack([jac, rows * solution.tau / 1e-6]))
    fixed = held @ (z.T @ z) @ held
    widen = float(student_ppf(0.975, len(layout.levels) - 1) / 1.96) ** 2
    return fixed + widen * (full - fixed)
