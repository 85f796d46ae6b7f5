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
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import idct
from scipy.interpolate import CubicSpline
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import LinearOperator, aslinearoperator

from frictrack.base.distributions import student_ppf
from frictrack.fit.cutting import MIN_FRAMES
from frictrack.fit.least_squares import (
    LeastSquaresProblem,
    PieceResponse,
    Solution,
    fit_with_scatter,
    hold,
    inverse_normal_matrix,
    refine,
)
from frictrack.fit.least_squares.solution import NORMAL_QUANTILE_975
from frictrack.fit.observations.displacement import DisplacementObservation
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER, ParameterLayout
from frictrack.fit.penalties import penalty_jacobian
from frictrack.fit.pieces import Piece
from frictrack.fit.routes import FitOutcome, FittedRuns
from frictrack.fit.separable.model import DataBlock, friction_series, path_of
from frictrack.fit.smooth_functions import rms
from frictrack.fit.uncertainty import linear_estimates
from frictrack.fit.uncertainty.estimates import Estimates
from frictrack.measure.motion import (
    STENCIL_FRAMES,
    FactoredSmoother,
    FilterMethod,
    Smoother,
    SmootherData,
    Structure,
    frame_grid,
    frame_weights,
    stencils,
    unit_responses,
)
from frictrack.records import Array, Mask, Run

PASSBAND_FACTOR = 3.2  # times the cut-off; beyond, the chain passes less than a thousandth
SCAN_BAND_FACTOR = 2.0  # times the cut-off; beyond, the chain passes less than a sixtieth
NOISE_DRAWS = 50  # of which the mean square is known to a few percent
BLOCK_PERIODS = 2.0  # length of held-out blocks in periods of the cut-off frequency


@dataclass(frozen=True)
class AccelerationChain:
    """Low-pass and double difference of one piece: a linear map from its n frames to m accelerations, m/s^2.

    The frames within the run's guard of either end are smoothed but not compared.
    """

    linear: LinearOperator  # (m, n)
    sigma_a: Array  # noise of the accelerations, (m,)
    kept: NDArray[np.int64]  # the compared frames of the piece, (m,)
    cutoff: float  # Hz

    def apply(self, columns: Array) -> Array:
        """Compute accelerations (m, k), m/s^2, of displacements (n, k), m."""
        return np.asarray(self.linear.matmat(columns))

    def transposed(self, columns: Array) -> Array:
        """Apply the transposed map to columns (m, k), shape (n, k)."""
        return np.asarray(self.linear.rmatmat(columns))

    def only(self, rows: Mask) -> AccelerationChain:
        """Return the same chain, compared only at the marked frames (n,) of the piece."""
        use = rows[self.kept]
        pick = eye_array(len(use), format="csr")[use]
        return replace(
            self, linear=aslinearoperator(pick) @ self.linear, sigma_a=self.sigma_a[use], kept=self.kept[use]
        )


def acceleration_chain(run: Run, piece: Piece) -> AccelerationChain:
    """Create the chain of one piece: the filter that the run's motion was asked for, else a low-pass at its cut-off."""
    n = len(piece.t)
    guard = min(run.motion.guard, n // 8, max((n - MIN_FRAMES) // 2, 0))
    kept = np.arange(guard, n - guard)
    method = Smoother.read(run.motion.filter).method if run.motion.filter else None
    linear, sigma_a = _low_pass(run, piece, kept) if method is None else _filter(method, piece, kept)
    return AccelerationChain(linear, sigma_a, kept, run.motion.cutoff)


class _LowPass(LinearOperator):
    """Low-pass and second derivative: accelerations (m,) of displacements (n,) that stand in `frames` of a grid."""

    def __init__(self, second: csr_array, smoother: FactoredSmoother, frames: NDArray[np.int64], weight: Array) -> None:
        super().__init__(float, (second.shape[0], len(frames)))  # type: ignore[call-arg]
        self._second, self._smoother, self._frames, self._weight = second, smoother, frames, weight

    def _matmat(self, displacements: Array) -> Array:
        full = np.zeros((len(self._weight), displacements.shape[1]))
        full[self._frames] = displacements
        return np.asarray(self._second @ self._smoother.smooth(full))

    def _rmatmat(self, accelerations: Array) -> Array:
        back = self._smoother.posterior_covariance_times(self._second.T @ accelerations)
        return np.asarray(self._weight[:, None] * back)[self._frames]


def _low_pass(run: Run, piece: Piece, kept: NDArray[np.int64]) -> tuple[LinearOperator, Array]:
    """Low-pass at the run's cut-off and second derivative: the map, and the noise at the kept frames."""
    grid = frame_grid(piece.t)
    weight = grid.to_frames(frame_weights(piece.sigma, np.ones(len(piece.t), dtype=bool)))
    low_pass = Structure.low_pass(run.motion.cutoff, grid.interval)
    smoother = low_pass.factor_smoother(SmootherData(np.zeros(grid.n), weight))
    start, table = stencils(grid.n, grid.interval)
    frames = grid.frames[kept]
    noise = float(np.mean(piece.sigma**-2.0) ** -0.5)
    sigma_a = noise * np.sqrt(smoother.noise_variances(start, table[2:]))[0]
    rows = np.repeat(np.arange(len(kept)), STENCIL_FRAMES)
    columns = (start[frames, None] + np.arange(STENCIL_FRAMES)).ravel()
    second = csr_array((table[2, frames].ravel(), (rows, columns)), shape=(len(kept), grid.n))

    return _LowPass(second, smoother, grid.frames, weight), sigma_a[frames]


def _filter(method: FilterMethod, piece: Piece, kept: NDArray[np.int64]) -> tuple[LinearOperator, Array]:
    """Second derivative by another filter, as a matrix of its responses to every frame, and the noise."""
    grid = frame_grid(piece.t)
    known = grid.to_frames(np.ones(len(piece.t))) > 0
    responses = [response[grid.frames[kept]] for _, response in unit_responses(method, known, 2)]
    matrix = np.concatenate(responses, axis=1) / grid.interval**2
    return aslinearoperator(matrix), np.linalg.norm(matrix * piece.sigma, axis=1)


def _block(piece: Piece, chain: AccelerationChain, noise: float) -> DataBlock:
    """The accelerations of a piece, in units of noise, in the coordinates that a force along the path changes."""
    # the force enters by its cosine components within the passband of the chain, so that the map is one small matrix
    t = piece.t
    k = min(len(t), int(2 * (t[-1] - t[0]) * PASSBAND_FACTOR * chain.cutoff) + 8)
    cosines = idct(np.eye(len(t), k), norm="ortho", axis=0)
    known = np.interp(t, piece.panels.t, piece.known)
    twice = CubicSpline(t, np.column_stack([cosines, known])).antiderivative(2)(t)
    basis, response = np.linalg.qr(chain.apply(twice[:, :k] / piece.mass) / noise)
    measured = chain.apply((piece.y - twice[:, k])[:, None])[:, 0] / noise
    data = basis.T @ measured
    through = -cosines @ response.T

    def picture(rows: Array) -> Array:
        flat = chain.apply(rows.reshape(-1, rows.shape[-1]).T).T / noise
        return np.asarray(flat.reshape(*rows.shape[:-1], -1) @ basis)

    return DataBlock(
        run=piece.run,
        path=path_of(piece),
        data=data,
        forward=lambda rows: rows @ through,
        picture=picture,
        friction=friction_series(piece),
        rest=max(float(measured @ measured - data @ data), 0.0),
        highest=SCAN_BAND_FACTOR * chain.cutoff,
    )


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
        self.noise = rms(np.concatenate([c.sigma_a for c in chains]))  # m/s^2

    def rebuild(self, layout: ParameterLayout, pieces: Sequence[Piece] | None = None) -> AccelerationProblem:
        """Create the same kind of problem for another layout or other data of the same frames."""
        return AccelerationProblem(LeastSquaresProblem(layout.model, layout, pieces or self.pieces), self.chains)

    @property
    def blocks(self) -> list[DataBlock]:
        """The accelerations of every piece."""
        return [_block(piece, chain, self.noise) for piece, chain in zip(self.pieces, self.chains, strict=True)]

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

    def expected_square(self) -> float:
        """Return the expected sum of squares of all accelerations' noise; draws where it is not white."""
        if all(piece.whitening.correlation is None for piece in self.pieces):
            return float(sum(np.sum(chain.sigma_a**2) for chain in self.chains)) / self.noise**2
        rng = np.random.default_rng(0)
        draws = (
            chain.apply(piece.coloured(rng.standard_normal((len(piece.t), NOISE_DRAWS))))
            for piece, chain in zip(self.pieces, self.chains, strict=True)
        )
        return float(sum(np.sum(a**2) for a in draws)) / self.noise**2 / NOISE_DRAWS

    def noise_in(self, responses: Sequence[PieceResponse], columns: Array) -> Array:
        """Return Z (N, k), in units of sigma, with Z'Z = C' V C for columns C (M, k) over all accelerations."""
        out, ends = [], np.cumsum([len(r.r) for r in responses])[:-1]
        for chain, response, own in zip(self.chains, responses, np.split(columns, ends), strict=True):
            back = response.piece.whitening.coloured_transposed(chain.transposed(own)) / self.noise
            out.append(back - response.q @ (response.q.T @ back))
        return np.concatenate(out)


def _alternate_blocks(t: Array, chain: AccelerationChain) -> Mask:
    """Every other block of the frames t (n,)."""
    length = max(round(BLOCK_PERIODS / (chain.cutoff * float(np.median(np.diff(t))))), 1)
    return (np.arange(len(t)) // min(length, max(len(t) // 4, 1))) % 2 == 1


class AccelerationObservation(DisplacementObservation):
    """Residuals of acceleration: the force domain of the papers. Errors, curves and motion are of the displacement."""

    def estimates(self, fitted: FittedRuns) -> Estimates:
        """Return the parameters with standard deviations of the linearised model."""
        return linear_estimates(fitted.compared, sandwich_covariance(fitted.compared))

    def reduced_chi2(self, fitted: FittedRuns) -> float:
        """Return chi-squared over its expectation for the coloured noise of the accelerations."""
        solution = fitted.compared
        problem = _problem_of(solution)
        z = problem.noise_in(solution.responses, solution.basis.u)
        return solution.chi2 / (problem.expected_square() - float(np.sum(z**2)))

    def _band_covariance(self, fitted: FittedRuns, covariance: Callable[[], Array]) -> Array:
        return covariance()


def through_chains(problem: LeastSquaresProblem, runs: Sequence[Run]) -> AccelerationProblem:
    """Return the problem of displacements seen through the acceleration chains of the runs."""
    return AccelerationProblem(problem, [acceleration_chain(runs[piece.run], piece) for piece in problem.pieces])


def fit_accelerations(solution: Solution, runs: Sequence[Run]) -> FitOutcome:
    """Minimise the squared acceleration residuals, starting from the best fit of the displacement."""
    problem = through_chains(solution.problem, runs)
    force = fit_with_scatter(problem, solution.p, solution.starts, solution.tau or 0.03)
    return FitOutcome(fit_starts(solution.problem, force.p, force.starts, force.tau), force)


def linearise_accelerations(solution: Solution, runs: Sequence[Run]) -> Solution:
    """Return the same solution, linearised in the force domain."""
    return hold(through_chains(solution.problem, runs), solution.p, solution.starts, solution.tau)


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
