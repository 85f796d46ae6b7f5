"""The papers' domain: accelerations after low-pass and double difference, the model through the same chain.

For a fixed cut-off the chain is a linear map K from the frames of a piece to accelerations. Measured minus modelled
acceleration is then K (y - y_model) and its sensitivities are K J: the displacement's problem, seen through K. The
residuals count alike, as in the papers; their noise does not (it grows with the square of the frequency), so the
deviations come from the sandwich H^-1 J' V J H^-1 with V = K diag(sigma^2) K' (White 1982, Econometrica 50).
Start position and speed are those that suit the displacement best: the chain hardly sees them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from frictrack.fit.least_squares import (
    LeastSquaresProblem,
    PieceResponse,
    Solution,
    fit_with_scatter,
    inverse_normal_matrix,
    refine,
)
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER, penalty_jacobian
from frictrack.fit.segments import AccelerationChain, acceleration_chains, acceleration_noise
from frictrack.records import Array, Run


@dataclass(frozen=True)
class ForceResponse(PieceResponse):
    """A response seen through the chain; `plain` is the displacement's own."""

    displacement: PieceResponse

    def start_step(self, step: Array) -> Array:
        """Change of (x0, v0) that the displacement asks for."""
        return self.displacement.start_step(step)


class ForceProblem(LeastSquaresProblem):
    """The problem of the displacement seen through the chains, one per piece, in units of one noise for all."""

    def __init__(self, problem: LeastSquaresProblem, chains: Sequence[AccelerationChain]) -> None:
        super().__init__(problem.model, problem.layout, problem.pieces)
        self.chains = list(chains)
        self.noise = acceleration_noise(chains)

    def _respond(self, i: int, p: Array, start: Array) -> PieceResponse:
        displacement = super()._respond(i, p, start)
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
        """Noise of the displacement, frame by frame in units of sigma, that enters products with columns (M, k).

        The result Z (N, k) has Z'Z = columns' V columns.
        """
        out, at = [], 0
        for chain, response in zip(self.chains, responses, strict=True):
            mine = columns[at : at + len(response.r)]
            at += len(response.r)
            back = response.piece.coloured_transposed(chain.transposed(mine)) / self.noise
            out.append(back - response.q @ (response.q.T @ back))
        return np.concatenate(out)


def linearise_in_force_domain(solution: Solution, runs: Sequence[Run]) -> Solution:
    """The same law, linearised in the force domain."""
    problem = ForceProblem(solution.problem, acceleration_chains(runs, solution.problem.pieces))
    held = np.zeros(len(solution.p), dtype=bool)
    return refine(problem, solution.p, solution.starts, tau=solution.tau, free=held, max_steps=0)


def fit_accelerations(solution: Solution, runs: Sequence[Run]) -> Solution:
    """The law that minimises the squared acceleration residuals, from the best one of the displacement."""
    problem = ForceProblem(solution.problem, acceleration_chains(runs, solution.problem.pieces))
    return fit_with_scatter(problem, solution.p, solution.starts, solution.tau or 0.03)


def fit_starts(problem: LeastSquaresProblem, p: Array, starts: Sequence[Array], tau: float) -> Solution:
    """A given law in the displacement's domain: only the starts are fitted."""
    return refine(problem, p, starts, tau=tau, free=np.zeros(len(p), dtype=bool))


def reduced_chi2(solution: Solution) -> float:
    """Chi-squared over what the coloured noise leaves beside the fitted unknowns on average."""
    problem = solution.problem
    assert isinstance(problem, ForceProblem)
    z = problem.noise_in(solution.responses, solution.basis.u)
    return solution.chi2 / (len(solution.residual) - float(np.sum(z**2)))


def sandwich_covariance(solution: Solution) -> Array:
    """Covariance of the unknowns (P, P); the share of scattering levels is widened to Student's t as elsewhere."""
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
    widen = float(student.ppf(0.975, len(layout.levels) - 1) / 1.96) ** 2
    return fixed + widen * (full - fixed)
