"""The observation of accelerations, as in the papers: low-pass and double difference, the model through the same chain.

For a fixed cut-off frequency the chain is a linear map K from the frames of a piece to accelerations. Measured minus
modelled acceleration is K (y - y_model), with sensitivities K J. All residuals have equal weight, as in the papers,
although their noise grows with the square of the frequency. So the covariance is the sandwich H^-1 J' V J H^-1 with V
= K diag(sigma^2) K'. Start position and speed are fitted to the displacement, because the chain removes them.

References
----------
Huber, P. J. (1967). Proc. Fifth Berkeley Symposium 1, 221-233.
White, H. (1982). Maximum likelihood estimation of misspecified models. Econometrica 50, 1-25.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.base.distributions import student_ppf
from frictrack.fit.least_squares import (
    NORMAL_QUANTILE_975,
    LeastSquaresProblem,
    PieceResponse,
    Solution,
    fit_with_scatter,
    hold,
    inverse_normal_matrix,
    refine,
)
from frictrack.fit.observations.displacement import DisplacementObservation
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER, ParameterLayout, penalty_jacobian
from frictrack.fit.pieces import AccelerationChain, Piece, acceleration_chains, acceleration_noise
from frictrack.fit.routes import FitOutcome, FittedRuns
from frictrack.fit.uncertainty import Estimates, linear_estimates
from frictrack.records import Array, Mask, Run

BLOCK_PERIODS = 2.0  # length of held-out blocks in periods of the cut-off frequency


@dataclass(frozen=True)
class AccelerationResponse(PieceResponse):
    """The response of a piece after the chain; `displacement` is the response before it."""

    displacement: PieceResponse

    def start_step(self, step: Array) -> Array:
        """Compute the change of (x0, v0) that the displacement asks for."""
        return self.displacement.start_step(step)


class AccelerationProblem(LeastSquaresProblem):
    """The displacement problem seen through the acceleration chains, one per piece, in units of one common noise."""

    observed = "acceleration"

    def __init__(self, problem: LeastSquaresProblem, chains: Sequence[AccelerationChain]) -> None:
        super().__init__(problem.model, problem.layout, problem.pieces)
        self.chains = list(chains)
        self.noise = acceleration_noise(chains)

    def rebuild(self, layout: ParameterLayout, pieces: Sequence[Piece]) -> AccelerationProblem:
        """Create the same kind of problem for another layout or other data of the same frames."""
        return AccelerationProblem(super().rebuild(layout, pieces), self.chains)

    def evaluate(self, p: Array, starts: Sequence[Array]) -> list[PieceResponse]:
        """Simulate every piece and linearise it, seen through its chain."""
        out: list[PieceResponse] = []
        for displacement, chain in zip(super().evaluate(p, starts), self.chains, strict=True):
            filtered = self._filtered(displacement, chain)
            seen = {"jac": filtered[:, :-1], "r": filtered[:, -1], "r_full": filtered[:, -1]}
            out.append(AccelerationResponse(**vars(displacement) | seen, displacement=displacement))
        return out

    def _filtered(self, displacement: PieceResponse, chain: AccelerationChain) -> Array:
        """Sensitivities and residual (m, A + 1) after a chain."""
        rows = np.column_stack([displacement.jac, displacement.r])
        return chain.apply(displacement.piece.coloured(rows)) / self.noise

    def hidden_frames(self, responses: Sequence[PieceResponse]) -> list[Mask]:
        """Return every other block of frames of every piece, each longer than the filter."""
        return [_alternate_blocks(r.piece.t, chain) for r, chain in zip(responses, self.chains, strict=True)]

    def kept_rows(self, responses: Sequence[PieceResponse], hidden: Sequence[Mask]) -> list[Array]:
        """Return sensitivities and residual (m, A + 1) of every piece at the accelerations of the other frames."""
        return [
            self._filtered(r.displacement, chain.only(~rows))
            for r, chain, rows in zip(responses, self.chains, hidden, strict=True)
            if isinstance(r, AccelerationResponse)
        ]

    def noise_in(self, responses: Sequence[PieceResponse], columns: Array) -> Array:
        """Return Z (N, k), in units of sigma, with Z'Z = C' V C for columns C (M, k) over all accelerations."""
        out, ends = [], np.cumsum([len(r.r) for r in responses])[:-1]
        for chain, response, own in zip(self.chains, responses, np.split(columns, ends), strict=True):
            back = response.piece.coloured_transposed(chain.transposed(own)) / self.noise
            out.append(back - response.q @ (response.q.T @ back))
        return np.concatenate(out)


def _alternate_blocks(t: Array, chain: AccelerationChain) -> Mask:
    """Every other block of the frames t (n,)."""
    length = max(round(BLOCK_PERIODS / (chain.cutoff * float(np.median(np.diff(t))))), 1)
    odd: Mask = (np.arange(len(t)) // min(length, max(len(t) // 4, 1))) % 2 == 1
    return odd


class AccelerationObservation(DisplacementObservation):
    """Residuals of acceleration: the force domain of the papers. Errors, curves and motion are of the displacement."""

    def estimates(self, fitted: FittedRuns) -> Estimates:
        """Return the parameters with standard deviations of the linearised model."""
        return linear_estimates(fitted.compared, sandwich_covariance(fitted.compared))

    def reduced_chi2(self, fitted: FittedRuns) -> float:
        """Return chi-squared over its expectation for the coloured noise of the accelerations."""
        solution = fitted.compared
        z = _problem_of(solution).noise_in(solution.responses, solution.basis.u)
        return solution.chi2 / (len(solution.residual) - float(np.sum(z**2)))

    def _band_covariance(self, fitted: FittedRuns, covariance: Callable[[], Array]) -> Array:
        return covariance()


def fit_accelerations(solution: Solution, runs: Sequence[Run]) -> FitOutcome:
    """Minimise the squared acceleration residuals, starting from the best fit of the displacement."""
    problem = AccelerationProblem(solution.problem, acceleration_chains(runs, solution.problem.pieces))
    force = fit_with_scatter(problem, solution.p, solution.starts, solution.tau or 0.03)
    return FitOutcome(fit_starts(solution.problem, force.p, force.starts, force.tau), force)


def linearise_accelerations(solution: Solution, runs: Sequence[Run]) -> Solution:
    """Return the same solution, linearised in the force domain."""
    problem = AccelerationProblem(solution.problem, acceleration_chains(runs, solution.problem.pieces))
    return hold(problem, solution.p, solution.starts, solution.tau)


def fit_starts(problem: LeastSquaresProblem, p: Array, starts: Sequence[Array], tau: float) -> Solution:
    """Fit only the starts, in the displacement domain; the unknowns (P,) stay as they are."""
    return refine(problem, p, starts, tau=tau, free=np.zeros(len(p), dtype=bool))


def sandwich_covariance(solution: Solution) -> Array:
    """Compute the sandwich covariance (P, P) of the unknowns of a fit to accelerations.

    The part that comes from the scatter of the friction levels is widened to Student's t.
    """
    layout, jac = solution.problem.layout, solution.jac
    z = _problem_of(solution).noise_in(solution.responses, jac)
    rows = penalty_jacobian(layout, solution.tau or 0.03)
    bread, _ = inverse_normal_matrix(np.vstack([jac, rows]))
    if len(layout.levels) < MIN_RUNS_FOR_SCATTER:
        return bread @ (z.T @ z) @ bread
    full = bread @ (z.T @ z + rows.T @ rows) @ bread
    held, _ = inverse_normal_matrix(np.vstack([jac, rows * solution.tau / 1e-6]))
    fixed = held @ (z.T @ z) @ held
    widening = float(student_ppf(0.975, len(layout.levels) - 1) / NORMAL_QUANTILE_975) ** 2
    return fixed + widening * (full - fixed)


def _problem_of(solution: Solution) -> AccelerationProblem:
    assert isinstance(solution.problem, AccelerationProblem)
    return solution.problem
