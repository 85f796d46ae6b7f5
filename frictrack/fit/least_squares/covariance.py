"""Compute the covariance of the fitted unknowns from the linearised model."""

from __future__ import annotations

import numpy as np
from scipy.fft import dct

from frictrack.base.distributions import student_ppf
from frictrack.fit.least_squares.problem import PieceResponse
from frictrack.fit.least_squares.solution import Solution
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER, penalty_jacobian
from frictrack.measure.motion import CORRELATION_COST, slow_spectrum
from frictrack.records import Array

NORMAL_QUANTILE_975 = 1.96  # 97.5 % quantile of the normal distribution
SCATTER_STEP = 1.05  # factor on tau, to see which variances depend on it
MIN_BATCHES_PER_UNKNOWN = 2  # least number of batches per unknown
MIN_SINGULAR_VALUE = 1e-8  # relative; smaller singular values are not determined by the data


def white_noise_covariance(solution: Solution) -> tuple[Array, Array]:
    """Compute the covariance of the unknowns for white noise and a known scatter of the levels.

    It is the inverse curvature of the objective: a profile of the linearised model rises by one per variance.

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

    """
    return inverse_normal_matrix(
        np.vstack([solution.few_rows, penalty_jacobian(solution.problem.layout, solution.tau or 0.03, solution.p)])
    )


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
    tau = solution.tau or 0.03
    white, unseen = white_noise_covariance(solution)
    if any(p.cut for p in solution.problem.pieces):
        return _batch_covariance(solution, white), unseen
    full = white + _systematic_covariance(solution, white)
    full = full * (student_ppf(0.975, solution.problem.n_frames / CORRELATION_COST) / NORMAL_QUANTILE_975) ** 2
    if len(layout.levels) < MIN_RUNS_FOR_SCATTER:
        return full, unseen
    larger_scatter, _ = inverse_normal_matrix(
        np.vstack([solution.few_rows, penalty_jacobian(layout, SCATTER_STEP * tau, solution.p)])
    )
    variance = np.maximum(np.diag(white), 1e-300)
    share = np.maximum(
        np.log(np.maximum(np.diag(larger_scatter), 1e-300) / variance) / (2 * np.log(SCATTER_STEP)), 1e-3
    )
    widening = student_ppf(0.975, (len(layout.levels) - 1) / share**2) / NORMAL_QUANTILE_975
    return full * widening[:, None] * widening, unseen


def _systematic_covariance(solution: Solution, bread: Array) -> Array:
    """Covariance (P, P) that slow tracking errors and the remaining camera shake add."""
    added = solution.stacked([_systematic_gradients(r) for r in solution.responses]) @ bread
    return added.T @ added


def _systematic_gradients(r: PieceResponse) -> Array:
    """Gradient (m, A) of the objective under each systematic error of a piece, one standard deviation of each.

    Empty where the model is compared behind a filter, whose rows are not frames.
    """
    piece = r.piece
    blocks = [np.zeros((0, r.jac.shape[1]))]
    if len(r.jac) != len(piece.sigma):
        return blocks[0]
    whitened_jacobian = piece.whitened_transposed(r.jac)
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
    """Covariance (P, P) from batches of segments.

    With as many batches as segments per batch, batches are nearly independent (Flegal & Jones 2010, Batch means, Annals
    of Statistics 38, 1034-1070).
    """
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
