"""Compute the uncertainty of the parameters while the model misses a force.

The standard deviations of a fit hold if only noise is left. A rejected model misses a force, which biases its
parameters by far more than noise does. The missing force is modelled as a Gaussian process: independent in every run,
or a function of position or speed that all runs share. Its size and length have the highest restricted likelihood.
Its effect on the least-squares parameters is the sandwich

    (J'J)^-1 J'T S T'J (J'J)^-1

with T the trace of the force in the data and S its covariance. The part of the force that looks like the model cannot
be seen in the residual, but it is as large as the part that can.

References
----------
Kennedy, M. C. & O'Hagan, A. (2001). Bayesian calibration of computer models. J. R. Stat. Soc. B 63, 425-464.
Rasmussen, C. E. & Williams, C. K. I. (2006). Gaussian Processes for Machine Learning, ch. 5. MIT Press.
White, H. (1982). Maximum likelihood estimation of misspecified models. Econometrica 50, 1-25.

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictrack.fit.least_squares import (
    ModelProjection,
    PieceResponse,
    Solution,
    displacement_response,
    model_projection,
    white_noise_covariance,
)
from frictrack.fit.smooth_functions import (
    correlation_time_frames,
    linear_interpolation_matrix,
    matern_root,
    most_likely_process,
)
from frictrack.records import Array

KNOTS = {"x": 60, "v": 40}  # knots of a force that all runs share
MAX_KNOTS, MIN_KNOTS, KNOTS_A_RUN = 400, 3, 32  # knots of independent forces: over all pieces; per piece
CORRELATION_LENGTHS = (4.0, 1.5, 0.5, 0.2, 0.08)  # correlation lengths of the force, share of the axis
SMOOTHNESS = 1.5  # of the force: its slope may jump, as at an edge; a smoother one would promise too much
MAX_TRACE = 100.0  # standard deviations of noise; a larger force would not leave the motion as it was linearised
MIN_EVIDENCE_SHARE = 0.5  # share of the best evidence; less plausible axes are ignored
MIN_EVIDENCE = 10.0  # twice the rise of the log likelihood from which a misfit is reported
MIN_AXIS_RANGE = 1e-6  # share of the largest value; narrower axes are ignored
REJECTION_REMARK = (
    "the model is rejected: it misses a force. A standard deviation of noise alone means nothing then; the wider one "
    "holds for a missing force of the size that the residual shows"
)
MAX_NOISE_CHI2 = 1.2  # chi-squared per degree of freedom up to which a residual counts as noise

_Forces = list[tuple[slice, Array]]  # per piece: which of all K forces act there, and their values (m, k) at its nodes


@dataclass(frozen=True)
class Misfit:
    """The missing force of a rejected model."""

    axis: str  # what the force is a function of: "t" (independent in every run), "x" or "v"
    evidence: float  # twice the rise of the log restricted likelihood
    covariance: Array  # what it adds to the covariance of the unknowns, (P, P)

    def summary(self) -> dict[str, Any]:
        """Return the JSON `misfit` of a fit."""
        return {"axis": self.axis, "evidence": self.evidence, "words": REJECTION_REMARK}


def misfit_of(solution: Solution) -> Misfit | None:
    """Find the most likely missing force of a model, and its effect on the unknowns; None for noise alone."""
    if len(solution.responses) * MIN_KNOTS > MAX_KNOTS:
        return None
    law = model_projection(solution)
    inverse_hessian, _ = white_noise_covariance(solution)
    candidates = []
    for axis, forces, roots in _force_bases(solution):
        gram, data, gradient = _trace_products(law, forces)
        force = most_likely_process(gram, data, roots, MAX_TRACE)
        moved = inverse_hessian @ gradient @ force.prior
        candidates.append(Misfit(axis, force.gain, moved @ moved.T))
    best = max(candidates, key=lambda m: m.evidence)
    plausible = [m for m in candidates if m.evidence > MIN_EVIDENCE_SHARE * best.evidence]
    return _widest_covariance(best, plausible) if best.evidence > MIN_EVIDENCE else None


def _trace_products(law: ModelProjection, forces: _Forces) -> tuple[Array, Array, Array]:
    """Inner products of the traces of K unit forces in the data."""
    # they are those of what the model cannot follow of them with itself (K, K), with the residual (K,), and those of
    # the whole traces with the Jacobian (P, K)
    size = max(columns.stop for columns, _ in forces)
    gram, data = np.zeros((size, size)), np.zeros(size)
    on_model, gradient = np.zeros((law.u.shape[1], size)), np.zeros((len(law.solution.p), size))
    for rows, response, (columns, values) in zip(law.rows, law.responses, forces, strict=True):
        trace = displacement_response(response, values)
        gram[columns, columns] += trace.T @ trace
        data[columns] += law.r[rows] @ trace
        on_model[:, columns] += law.u[rows].T @ trace
        gradient[response.active, columns] += response.jac.T @ trace
    return gram - on_model.T @ on_model, data, gradient


def _widest_covariance(best: Misfit, plausible: list[Misfit]) -> Misfit:
    """The most likely force, its covariance scaled to the largest standard deviation under any plausible force."""
    # the axis of the missing force is uncertain, and the standard deviations must hold for each plausible one
    own = np.sqrt(np.maximum(np.diag(best.covariance), 1e-300))
    largest = np.sqrt(np.max([np.diag(m.covariance) for m in plausible], axis=0))
    scale = np.maximum(largest / own, 1.0)
    return Misfit(best.axis, best.evidence, best.covariance * scale[:, None] * scale)


def dispersion(solution: Solution) -> float:
    """Compute the factor by which differences of chi-squared are divided while a model leaves more than noise.

    It is chi-squared per degree of freedom times the correlation time of the residual in frames, at least 1
    (quasi-likelihood; Wedderburn 1974, Biometrika 61, 439-447).
    """
    free = max(solution.problem.n_frames - len(solution.p) - 2 * len(solution.responses), 1)
    chi2_per_frame = solution.chi2 / free
    if chi2_per_frame < MAX_NOISE_CHI2:
        return 1.0
    return max(chi2_per_frame * max(1.0, *(correlation_time_frames(r.r) for r in solution.responses)), 1.0)


def _force_bases(solution: Solution) -> Iterator[tuple[str, _Forces, list[Array]]]:
    """Yield axis, unit forces through knots along every piece, and roots of their covariances for every length."""
    motions = [_motion_at_nodes(solution, r) for r in solution.responses]
    count = int(np.clip(MAX_KNOTS // len(motions), MIN_KNOTS, KNOTS_A_RUN))
    own: _Forces = [
        (slice(i * count, (i + 1) * count), linear_interpolation_matrix(t, np.linspace(t[0], t[-1], count)))
        for i, (t, *_) in enumerate(motions)
    ]
    yield "t", own, [np.asarray(np.kron(np.eye(len(motions)), root)) for root in _roots(count)]
    for axis, values in (("x", [x for _, x, _, _ in motions]), ("v", [np.abs(v) for _, _, v, _ in motions])):
        low, high = min(float(u.min()) for u in values), max(float(u.max()) for u in values)
        if not high - low > MIN_AXIS_RANGE * max(abs(low), abs(high)):
            continue
        knots = np.linspace(low, high, KNOTS[axis])
        dry = [factor for *_, factor in motions]
        for factors in (dry, [np.sign(f) if axis == "v" else np.ones_like(f) for f in dry]):
            pairs = zip(values, factors, strict=True)
            shared = [(slice(0, len(knots)), linear_interpolation_matrix(u, knots) * f[:, None]) for u, f in pairs]
            yield axis, shared, _roots(len(knots))


def _roots(count: int) -> list[Array]:
    return [matern_root(np.linspace(0.0, 1.0, count), length, SMOOTHNESS) for length in CORRELATION_LENGTHS]


def _motion_at_nodes(solution: Solution, response: PieceResponse) -> tuple[Array, Array, Array, Array]:
    """Time, position, velocity, and load times direction at the nodes of one piece, (m,) each."""
    piece = response.piece
    _, level = solution.problem.layout.values(solution.p, piece.run)
    path = piece.path_at_nodes(response.motion.x, response.motion.v, level)
    return piece.panels.t, path.x, path.v, path.load * path.s
