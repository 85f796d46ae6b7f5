"""How well the unknowns of a fitted law are known: their covariance from the linearised model."""

from __future__ import annotations

import numpy as np
from scipy.fft import dct
from scipy.stats import t as student

from frictrack.fit.least_squares.gauss_newton import Solution
from frictrack.fit.least_squares.problem import PieceResponse
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER, penalty_jacobian
from frictrack.motion.noise import CORRELATION_COST, slow_spectrum
from frictrack.records import Array

NORMAL_QUANTILE_975 = 1.96  # standard deviations of a normal law that hold 95 %
SCATTER_STEP = 1.05  # factor on the spread, to see which variances follow it
MIN_BATCHES_PER_UNKNOWN = 2  # batches of segments per unknown at least
MIN_SINGULAR_VALUE = 1e-8  # singular value, over the largest, below which a direction is not seen by the data


def white_noise_covariance(solution: Solution) -> tuple[Array, Array]:
    """Covariance of the unknowns (P, P) as white noise and a known spread make it, and which are not seen, (P,).

    It is what the curvature of the misfit says: a profile of the linearised law rises by one per such variance.
    """
    return inverse_normal_matrix(
        np.vstack([solution.jac, penalty_jacobian(solution.problem.layout, solution.tau or 0.03, solution.p)])
    )


def covariance_of(solution: Solution) -> tuple[Array, Array]:
    """Covariance of the unknowns (P, P), and which of them the data do not see, (P,).

    The noise is told by the frames themselves, so a variance is known as well as it is: Student's t with as many
    degrees of freedom as fifth differences leave. It is also known as well as the spread of few runs is, as far as it
    follows it: (runs - 1)/share^2 degrees, share = d log variance / d log spread^2 (Satterthwaite 1946). What a film is
    off by beside its noise comes on top.
    """
    layout = solution.problem.layout
    tau = solution.tau or 0.03
    full, unseen = white_noise_covariance(solution)
    if any(p.cut for p in solution.problem.pieces):
        return _batch_covariance(solution, full), unseen
    full = full + _systematic_covariance(solution, full)
    full = full * (student.ppf(0.975, solution.problem.n_frames / CORRELATION_COST) / NORMAL_QUANTILE_975) ** 2
    if len(layout.levels) < MIN_RUNS_FOR_SCATTER:
        return full, unseen
    larger_scatter, _ = inverse_normal_matrix(
        np.vstack([solution.jac, penalty_jacobian(layout, SCATTER_STEP * tau, solution.p)])
    )
    variance = np.maximum(np.diag(white_noise_covariance(solution)[0]), 1e-300)
    share = np.maximum(
        np.log(np.maximum(np.diag(larger_scatter), 1e-300) / variance) / (2 * np.log(SCATTER_STEP)), 1e-3
    )
    widening = student.ppf(0.975, (len(layout.levels) - 1) / share**2) / NORMAL_QUANTILE_975
    return full * widening[:, None] * widening, unseen


def _systematic_covariance(solution: Solution, bread: Array) -> Array:
    """Covariance (P, P) that slow errors of a tracker and what is left of a camera shake add."""
    gradients = [np.zeros((0, len(solution.p)))]
    for r in solution.responses:
        gradient = _systematic_gradients(r)
        gradients.append(np.zeros((len(gradient), len(solution.p))))
        gradients[-1][:, r.active] = gradient
    added = np.vstack(gradients) @ bread
    return added.T @ added


def _systematic_gradients(r: PieceResponse) -> Array:
    """What each of a piece's errors beside its noise, one standard deviation of it, pulls the law to, (m, A).

    None where the law is compared behind a filter, whose rows are no frames.
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
    if piece.shake:
        frequency, rms = piece.shake
        phase = 2 * np.pi * frequency * piece.t
        blocks.append(rms * np.stack([np.cos(phase), np.sin(phase)]) @ whitened_jacobian)
    return np.vstack(blocks)


def batch_count(solution: Solution) -> int:
    """Into how many batches the segments go: as many as there are segments in each, but enough for the unknowns."""
    n = len(solution.responses)
    return int(min(max(round(np.sqrt(n)), MIN_BATCHES_PER_UNKNOWN * len(solution.p)), n))


def _batch_covariance(solution: Solution, bread: Array) -> Array:
    """Covariance (P, P) where segments hold more than noise: the scatter of what batches of them pull the law to.

    What is not modelled is alike within a segment (Liang & Zeger 1986, Biometrika 73) and often in its neighbours too:
    as many batches as there are segments in each (batch means; Flegal & Jones 2010, Annals of Statistics 38), known
    as well as so many scatter (Student's t).
    """
    gradients = np.zeros((len(solution.responses), len(solution.p)))
    for gradient, r in zip(gradients, solution.responses, strict=True):
        gradient[r.active] = r.jac.T @ r.r
    count = batch_count(solution)
    batches = np.array([part.sum(axis=0) for part in np.array_split(gradients, count)])
    widening = (student.ppf(0.975, count - 1) / NORMAL_QUANTILE_975) ** 2 * count / (count - 1)
    penalty = penalty_jacobian(solution.problem.layout, solution.tau or 0.03, solution.p)
    return np.asarray(bread @ (widening * batches.T @ batches + penalty.T @ penalty) @ bread)


def inverse_normal_matrix(jac: Array) -> tuple[Array, Array]:
    """(J'J)^-1 in the directions that the data see, (P, P), and which unknowns they do not see, (P,)."""
    norm = np.linalg.norm(jac, axis=0)
    dead = norm == 0
    norm[dead] = 1.0
    _, s, vt = np.linalg.svd(jac / norm, full_matrices=False)
    keep = s > MIN_SINGULAR_VALUE * s[0]
    unseen = dead | (np.max(np.abs(vt[~keep]), axis=0, initial=0.0) > 1e-2)
    half = vt[keep] / s[keep, None] / norm
    return half.T @ half, unseen
