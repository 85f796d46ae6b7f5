"""The model linearised where Gauss-Newton converged, and the residual orthogonal to it.

Most unknowns of many runs (starts, levels) belong to single runs, and a piece of n frames spans only as many directions
as it has active unknowns. An orthonormal rotation of its frames leaves that many rows different from zero: block
angular least squares. Normal matrix, singular values and right singular vectors stay the same.

A model that lacks a force compensates with its own parameters. Its residual is therefore not the missing force but
the trace of that force in the data minus its projection on the model's sensitivities.

Compute the held-out error: the error of the model at frames that were not used to fit it.

By run: the shared parameters come from the other runs. The run's own parameters (start, level, phases, event times)
come from its kept frames, and its hidden frames are scored. Where the other runs cannot determine a shared parameter
well enough, the kept frames of all runs are fitted and the hidden ones scored. The result states which was used.

Everything is linear algebra about the fitted model: leaving out frames changes the parameters little, so one
Gauss-Newton step suffices.

References
----------
Bjorck, A. (1996). Numerical Methods for Least Squares Problems, section 6.3. SIAM.
Golub, G. H. & Van Loan, C. F. (2013). Matrix Computations, section 5.2. Johns Hopkins.
Cook, R. D. & Weisberg, S. (1982). Residuals and Influence in Regression, ch. 5. Chapman & Hall.

"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.fft import dct
from scipy.linalg import block_diag

from frictrack.base.distributions import student_ppf
from frictrack.fit.least_squares.problem import LeastSquaresProblem, PieceResponse
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER
from frictrack.fit.penalties import (
    JacobianBasis,
    jacobian_basis,
    penalty_jacobian,
    penalty_residual,
    prior_jacobian,
    prior_residual,
)
from frictrack.fit.pieces import Piece, column_norms
from frictrack.fit.smooth_functions import rms
from frictrack.measure.motion import slow_spectrum
from frictrack.records import Array, Mask
from frictrack.sampling import CORRELATION_COST
from frictrack.search import COST_OF_MEMORY

MIN_TAU_OF_OTHER_RUNS = 1e-3  # relative standard deviation of the friction levels
MAX_DISTANCE_HELD = 1e-9  # from a bound at which an unknown is held, relative beyond 1
MIN_SINGULAR_VALUE_PROJECTED = 1e-9  # relative; smaller singular values are not determined by the runs
NORMAL_QUANTILE_975 = 1.96  # 97.5 % quantile of the normal distribution
SCATTER_STEP = 1.05  # factor on tau, to see which variances depend on it
MIN_BATCHES_PER_UNKNOWN = 2  # least number of batches per unknown
N_ROUNDING_WAVES, MAX_ERROR_SIGMAS = 30, 2.0  # of rounding errors; standard deviations of the noise besides them
MIN_SINGULAR_VALUE = 1e-8  # relative; smaller singular values are not determined by the data
MAX_PREDICTION_VARIANCE = 0.25  # largest ratio of prediction variance to noise variance
MIN_KEPT_SHARE = 0.01  # of the information of all frames, usually a half; own unknowns keep their values below it
MIN_SINGULAR_VALUE_HELD_OUT = 1e-7  # relative; parameters keep their values along smaller ones


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

    def level_scatter(self, reach: float = np.inf) -> tuple[float, float]:
        """Estimate tau, the relative standard deviation of the friction levels, near its present value.

        Log tau changes by at most `reach`. Also returned is by how much the determinant term of the restricted
        likelihood rises. The other unknowns enter as they do at level one. At the fitted levels l, more Coulomb
        friction and less of a constant force is the pattern l - 1 itself, which would leave no scatter.
        """
        rows, residual = self.few_rows_and_residual
        data = residual + rows @ self._departure()
        basis = self._basis_of(self._few_rows_at_level_one())
        tau = basis.spread(basis.u.T @ data, float(data @ data))
        low, high = self.tau * np.exp(np.clip((-reach, reach), -50.0, 50.0))  # wider than any bounds of tau
        tau = float(np.clip(tau, low, high))
        return tau, basis.logdet(tau) - basis.logdet(self.tau)

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


def model_projection(solution: Solution) -> tuple[Array, Array]:
    """Compute an orthonormal basis u (N + m, P') of a fitted model, and what of the residual is orthogonal to it.

    The rows are those of all N frames, then those of the m penalties.
    """
    few, expanded = solution.rotated_jacobian()
    tau = solution.tau_of_other_runs
    law = np.vstack([few, penalty_jacobian(solution.problem.layout, tau, solution.p)])
    r = np.concatenate([solution.residual, -penalty_residual(solution.problem.layout, solution.p, tau)])
    u, s, _ = np.linalg.svd(law / column_norms(law), full_matrices=False)
    u = u[:, s > MIN_SINGULAR_VALUE_PROJECTED * s[0]] if len(s) else u
    u = np.concatenate([expanded(u[: len(few)]), u[len(few) :]])
    return u, r - u @ (u.T @ r)


def displacement_response(response: PieceResponse, force: Array) -> Array:
    """Compute the trace of forces in the displacement of one piece: whitened, start projected out.

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
    edges = linear.edge_states(-force / piece.mass)
    moved = piece.whitened((1 + response.shift_slope)[:, None] * edges[piece.at, 0])
    return moved - response.q @ (response.q.T @ moved)


def position_and_velocity(response: PieceResponse) -> tuple[Array, Array]:
    """Return position (m) and velocity (m/s) of the simulated motion at the frames of one piece, (n,) each."""
    piece = response.piece
    return response.motion.x_edge[piece.at], response.motion.v_edge[piece.at]


def white_noise_covariance(solution: Solution, tau: float | None = None) -> tuple[Array, Array]:
    """Compute the covariance of the unknowns for white noise and a known scatter of the levels.

    It is the inverse curvature of the objective: a profile of the linearised model rises by one per variance.

    Parameters
    ----------
    solution : Solution
        The fit.
    tau : float, optional
        Scatter of the levels; default that of the fit.

    Returns
    -------
    covariance : array of shape (P, P)
        Covariance of the unknowns.
    unseen : array of bool, shape (P,)
        Unknowns that the data do not determine.

    """
    penalty = penalty_jacobian(solution.problem.layout, tau or solution.tau or 0.03, solution.p)
    covariance, unseen = inverse_normal_matrix(np.vstack([solution.few_rows, penalty]))
    levels = solution.problem.layout.levels
    if levels and not solution.levels_are_random:  # their mean is one exactly, and not only to its weight in a fit
        mean = covariance[:, levels].sum(axis=1)
        covariance -= np.outer(mean, mean) / mean[levels].sum()
    return covariance, unseen


def covariance_of(solution: Solution) -> tuple[Array, Array]:
    """Compute the covariance of the unknowns with all known sources of error.

    The noise level is estimated from fifth differences, so the variances are widened to Student's t with that many
    degrees of freedom. A variance that depends on the scatter of few runs is widened likewise, with (runs -
    1)/share^2 degrees, share = d log variance / d log tau^2 (Satterthwaite). Systematic tracking errors are added. If
    a run is cut into segments, the covariance comes from batches of segments.

    Parameters
    ----------
    solution : Solution
        The fit.

    Returns
    -------
    covariance : array of shape (P, P)
        Covariance of the unknowns.
    unseen : array of bool, shape (P,)
        Unknowns that the data do not determine.

    References
    ----------
    Satterthwaite, F. E. (1946). Biometrics Bulletin 2, 110-114.

    """
    layout = solution.problem.layout
    white, unseen = white_noise_covariance(solution)
    if any(p.cut for p in solution.problem.pieces):
        return _batch_covariance(solution, white), unseen
    waves, share = _rounding_noise(solution)
    gradients = [np.vstack([_systematic_gradients(r), _rounding_gradients(r, waves)]) for r in solution.responses]
    systematic = solution.stacked(gradients) @ white
    widening = student_ppf(0.975, solution.problem.n_frames / CORRELATION_COST) / NORMAL_QUANTILE_975
    full = (white * (1.0 - share) + systematic.T @ systematic) * widening**2
    if len(layout.levels) < MIN_RUNS_FOR_SCATTER:
        return full, unseen
    larger_scatter, _ = white_noise_covariance(solution, SCATTER_STEP * (solution.tau or 0.03))
    before, after = (np.maximum(np.diag(covariance), 1e-300) for covariance in (white, larger_scatter))
    share = np.maximum(np.log(after / before) / (2 * np.log(SCATTER_STEP)), 1e-3)
    widening = student_ppf(0.975, (len(layout.levels) - 1) / share**2) / NORMAL_QUANTILE_975
    return full * widening[:, None] * widening, unseen


def _systematic_gradients(r: PieceResponse) -> Array:
    """Gradient (m, A) of the objective under each systematic error of a piece, one standard deviation of each."""
    # empty where the model is compared behind a filter, whose rows are not frames
    piece = r.piece
    blocks = [np.zeros((0, r.jac.shape[1]))]
    if len(r.jac) != len(piece.sigma):
        return blocks[0]
    whitened_jacobian = piece.whitening.transposed(r.jac)
    if piece.systematic:
        size = slow_spectrum(len(whitened_jacobian))
        blocks.append(
            piece.systematic * size[:, None] * dct(whitened_jacobian, axis=0, norm="ortho")[1 : 1 + len(size)]
        )
    if piece.clock_error:  # a relative error of the clock moves the mass by v t times it
        moved = piece.clock_error * r.motion.v_edge[piece.at] * piece.t
        blocks.append((moved @ whitened_jacobian)[None])
    if piece.shake:
        frequency, rms = piece.shake
        phase = 2 * np.pi * frequency * piece.t
        blocks.append(rms * np.stack([np.cos(phase), np.sin(phase)]) @ whitened_jacobian)
    return np.vstack(blocks)


def _rounding_noise(solution: Solution) -> tuple[Array, float]:
    """Errors of rounding: waves (K,) over the place with k periods per step, and their share in all noise.

    They are deviations over that of rounding. Other noise, of variance s^2, blurs a wave by exp(-2 (pi k s / step)^2).
    It is known from the residual, but for its error: the waves are as large, and the rest is as large, as it may be.
    """
    responses = solution.responses
    if not all(r.piece.step and len(r.jac) == len(r.piece.sigma) for r in responses):
        return np.zeros(0), 0.0
    n = np.array([len(r.r) for r in responses])
    total = 12.0 * np.array([np.mean((r.r * r.piece.sigma / r.piece.step) ** 2) for r in responses])  # 1 of rounding
    other, k = max(float(n @ total / np.sum(n)) - 1.0, 0.0) / 12.0, np.arange(1.0, N_ROUNDING_WAVES + 1.0)
    most = other + MAX_ERROR_SIGMAS * float(np.sqrt(0.8 / np.sum(n))) / 12.0  # of squares of uniform errors
    waves, least = (6.0 / (np.pi * k) ** 2 * np.exp(-4.0 * (np.pi * k) ** 2 * s) for s in (other, most))
    assumed = 12.0 * np.array([np.mean((r.piece.sigma / r.piece.step) ** 2) for r in responses])
    return np.sqrt(waves), float(np.sum(least) * np.sum(n) / (n @ assumed))


def _rounding_gradients(r: PieceResponse, amplitudes: Array) -> Array:
    """Gradient (2 K, A) of the objective under the waves of rounding along the motion of a piece."""
    if not len(amplitudes):
        return np.zeros((0, r.jac.shape[1]))
    piece, k = r.piece, np.arange(1, len(amplitudes) + 1)
    phase = 2 * np.pi * k[:, None] * (r.model_y - r.model_y[0]) / piece.step
    waves = np.concatenate([np.cos(phase), np.sin(phase)]) * np.tile(amplitudes, 2)[:, None]
    return np.asarray(piece.step / np.sqrt(12.0) * waves @ piece.whitening.transposed(r.jac))


def batch_count(solution: Solution) -> int:
    """Compute the number of batches of segments: about the square root of the segments, but enough for the unknowns."""
    n = len(solution.responses)
    return int(min(max(round(np.sqrt(n)), MIN_BATCHES_PER_UNKNOWN * len(solution.p)), n))


def clustered_covariance(solution: Solution, bread: Array, gradients: Array) -> Array:
    """Compute the covariance from the scatter of the gradients of clusters of frames (cluster-robust sandwich).

    Unmodelled forces are correlated between neighbouring frames, so the clusters must be longer than this correlation.

    Parameters
    ----------
    solution : Solution
        The fit.
    bread : array of shape (P, P)
        Inverse normal matrix.
    gradients : array of shape (k, P)
        Gradient of the objective from every cluster.

    Returns
    -------
    array of shape (P, P)
        Covariance of the unknowns, widened to Student's t for the number of clusters.

    References
    ----------
    Huber, P. J. (1967). Proc. Fifth Berkeley Symposium 1, 221-233.
    Liang, K.-Y. & Zeger, S. L. (1986). Longitudinal data analysis. Biometrika 73, 13-22.
    White, H. (1980). Econometrica 48, 817-838.

    """
    count = len(gradients)
    widening = (student_ppf(0.975, count - 1) / NORMAL_QUANTILE_975) ** 2 * count / (count - 1)
    penalty = penalty_jacobian(solution.problem.layout, solution.tau or 0.03, solution.p)
    return np.asarray(bread @ (widening * gradients.T @ gradients + penalty.T @ penalty) @ bread)


def _batch_covariance(solution: Solution, bread: Array) -> Array:
    """Covariance (P, P) from batches of segments."""
    # with as many batches as segments per batch, batches are nearly independent (Flegal & Jones 2010, Batch means,
    # Annals of Statistics 38, 1034-1070)
    gradients = solution.stacked([(r.jac.T @ r.r)[None] for r in solution.responses])
    batches = np.array([part.sum(axis=0) for part in np.array_split(gradients, batch_count(solution))])
    return clustered_covariance(solution, bread, batches)


def inverse_normal_matrix(jac: Array) -> tuple[Array, Array]:
    """Compute (J'J)^-1 in the directions that the data determine.

    Parameters
    ----------
    jac : array of shape (N, P)
        Whitened Jacobian.

    Returns
    -------
    inverse : array of shape (P, P)
        Pseudo-inverse of the normal matrix, its columns scaled before the cut-off.
    unseen : array of bool, shape (P,)
        Unknowns that the data do not determine.

    Examples
    --------
    >>> inverse, unseen = inverse_normal_matrix(np.array([[2.0, 0.0], [0.0, 0.0], [0.0, 0.0]]))
    >>> inverse[0, 0].item(), unseen.tolist()
    (0.25, [False, True])

    """
    norm = np.linalg.norm(jac, axis=0)
    dead = norm == 0
    norm[dead] = 1.0
    _, s, vt = np.linalg.svd(jac / norm, full_matrices=False)
    keep = s > MIN_SINGULAR_VALUE * s[0]
    unseen = dead | (np.max(np.abs(vt[~keep]), axis=0, initial=0.0) > 1e-2)
    half = vt[keep] / s[keep, None] / norm
    return half.T @ half, unseen


def heldout_rms(solution: Solution, by: str | None = None, compared: Solution | None = None) -> tuple[float, str]:
    """Compute the root mean square of the held-out residual.

    Parameters
    ----------
    solution : Solution
        The fit, whose residual is scored.
    by : {"run", "frames"}, optional
        What is held out. By default runs, wherever the other runs can predict every run.
    compared : Solution, optional
        The same unknowns where other residuals were minimised, or where a search stopped before the optimum. Only the
        change of the unknowns with the frames counts then.

    Returns
    -------
    rms : float
        Held-out error, m or N.
    by : str
        What was held out: "run" or "frames".

    """
    fitted = compared or solution
    runs = _linear_runs(solution, solution.problem.hidden_frames(solution.responses))
    whole = np.zeros(len(solution.p)) if compared is None else _step(compared)
    if by == "frames" or len(runs) < 2 or (by is None and not _are_predictable(solution, runs)):
        hidden = fitted.problem.hidden_frames(fitted.responses)
        step = _step(fitted, fitted.problem.kept_rows(fitted.responses, hidden)) - whole
        none = np.zeros(len(step), dtype=bool)
        errors = [run.hidden_errors(step, none) for run in _linear_runs(solution, hidden).values()]
        return rms(np.concatenate(errors)), "frames"
    errors = []
    for i, run in runs.items():
        own = _own_unknowns(solution, i)
        rows = [None if r.piece.run == i else np.column_stack([r.jac, r.r]) for r in fitted.responses]
        errors.append(run.hidden_errors(np.where(own, 0.0, _step(fitted, rows, ~own) - whole), own))
    return rms(np.concatenate(errors)), "run"


@dataclass(frozen=True)
class _LinearRun:
    """One run about the fitted model, its pieces stacked."""

    # whitened residual (n,), sensitivities (n, P) and starts (n_s, 2) of every piece; which frames are hidden (n,)

    pieces: list[Piece]
    residual: Array
    jac: Array
    starts: list[Array]
    hidden: Mask

    def hidden_errors(self, step: Array, own: Mask) -> Array:
        """Errors, m or N, at the hidden frames after a step; starts and `own` unknowns come from the kept frames."""
        ends = np.cumsum([len(p.t) for p in self.pieces])[:-1]
        residual, kept = self.residual - self.jac @ step, ~self.hidden
        if own.any():  # all pieces share them
            columns = np.concatenate([self.jac[:, own], block_diag(*self.starts)], axis=1)
            left = np.split(_without_columns(columns, residual, kept), ends)
        else:
            left = list(map(_without_columns, self.starts, np.split(residual, ends), np.split(kept, ends)))
        errors = [p.coloured(r) for p, r in zip(self.pieces, left, strict=True)]
        return np.asarray(np.concatenate(errors)[self.hidden])


def _linear_runs(solution: Solution, hidden: Sequence[Mask]) -> dict[int, _LinearRun]:
    """Every run about the fitted model."""
    out = {}
    for run in dict.fromkeys(r.piece.run for r in solution.responses):
        own = [r for r in solution.responses if r.piece.run == run]
        out[run] = _LinearRun(
            pieces=[r.piece for r in own],
            residual=np.concatenate([r.r for r in own]),
            jac=stacked_rows([r.jac for r in own], [r.active for r in own], len(solution.p)),
            starts=[r.q for r in own],
            hidden=np.concatenate([h for r, h in zip(solution.responses, hidden, strict=True) if r.piece.run == run]),
        )
    return out


def _are_predictable(solution: Solution, runs: Mapping[int, _LinearRun]) -> bool:
    """Whether the other runs determine the shared parameters well enough to predict every run."""
    rows = penalty_jacobian(solution.problem.layout, solution.tau or 0.03)
    norm = column_norms(np.vstack([*(r.jac for r in runs.values()), rows]))
    for i, run in runs.items():
        own = _own_unknowns(solution, i)
        known = np.vstack([*(r.jac for k, r in runs.items() if k != i), rows])[:, ~own] / norm[~own]
        covariance = np.linalg.inv(known.T @ known + 1e-13 * np.eye(known.shape[1]))
        basis, _ = np.linalg.qr(run.jac[:, own])
        shared = run.jac[:, ~own] / norm[~own]
        shared = shared - basis @ (basis.T @ shared)
        if np.mean(np.einsum("ni,ij,nj->n", shared, covariance, shared)) > MAX_PREDICTION_VARIANCE:  # j' C j by frame
            return False
    return True


def _own_unknowns(solution: Solution, run: int) -> Mask:
    """Which unknowns belong to the run alone."""
    return np.array([s.run == run for s in solution.problem.layout.slots])


def _step(solution: Solution, rows: Sequence[Array | None] | None = None, free: Mask | None = None) -> Array:
    """Gauss-Newton step (P,) of the free unknowns for some rows [J, r] of every piece, by default all of them."""
    # directions that these rows hardly determine, compared with all frames, stay 0
    layout, tau = solution.problem.layout, solution.tau or 0.03
    free = np.ones(len(solution.p), dtype=bool) if free is None else free
    rows = [np.column_stack([r.jac, r.r]) for r in solution.responses] if rows is None else rows
    used = [(r.active, own) for r, own in zip(solution.responses, rows, strict=True) if own is not None]
    jac = stacked_rows([own[:, :-1] for _, own in used], [active for active, _ in used], len(solution.p))
    left = np.concatenate([jac, penalty_jacobian(layout, tau, solution.p)])[:, free]
    right = np.concatenate([*(own[:, -1] for _, own in used), -penalty_residual(layout, solution.p, tau)])
    norm = column_norms(solution.jac[:, free])
    step = np.zeros(len(solution.p))
    step[free] = np.linalg.lstsq(left / norm, right, rcond=MIN_SINGULAR_VALUE_HELD_OUT)[0] / norm
    return step


def _without_columns(columns: Array, residual: Array, kept: Mask) -> Array:
    """Residual (n,) without columns (n, k) of its own, whose coefficients come from the kept frames."""
    # directions along which the kept frames hold nearly none of the information stay 0: the time of an event that lies
    # between two frames may show in one frame alone, and linear extrapolation from the others means nothing
    if not columns.shape[1]:
        return residual
    norm = column_norms(columns)
    _, size, vt = np.linalg.svd(columns / norm, full_matrices=False)
    found = size > MIN_SINGULAR_VALUE_HELD_OUT * size[0]
    to_columns = vt[found].T / size[found]  # directions of unit information in all frames
    u, share, wt = np.linalg.svd((columns[kept] / norm) @ to_columns, full_matrices=False)
    seen = share**2 > MIN_KEPT_SHARE
    coordinates = wt[seen].T @ ((u[:, seen].T @ residual[kept]) / share[seen])
    return np.asarray(residual - columns @ (to_columns @ coordinates / norm))
