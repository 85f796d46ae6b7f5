"""Control the length of Gauss-Newton steps: damped steps within a radius, adapted to what the last step gained.

The radius shrinks where a step gains much less than predicted, to the minimum of the parabola through the last step. It
grows again where the prediction holds.

References
----------
Levenberg, K. (1944). Quarterly of Applied Mathematics 2, 164-168.
Marquardt, D. W. (1963). SIAM J. Appl. Math. 11, 431-441.
More, J. J. (1978). The Levenberg-Marquardt algorithm. Lecture Notes in Mathematics 630, 105-116.
Conn, A. R., Gould, N. I. M. & Toint, P. L. (2000). Trust-Region Methods. SIAM.

"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from frictrack.records import Array

FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-8, 1e-12, 1e8
DAMPINGS_PER_DECADE = 4
POOR_GAIN, GOOD_GAIN = 0.25, 0.75  # share of the predicted fall (Conn, Gould & Toint 2000, algorithm 6.1.1)
RADIUS_GROWTH = 4.0  # after a step of good gain
MIN_SHRINKAGE, MAX_SHRINKAGE = 0.5, 0.1  # of the radius after a step of poor gain
MAX_OVERSHOOT = 3.0  # times the predicted fall: a larger rise is not described by a parabola


@dataclass(frozen=True)
class DampedStep:
    """A step of the unknowns (P,), its length in units of the columns, and the predicted fall of the objective."""

    values: Array
    length: float
    predicted_fall: float


@dataclass(frozen=True)
class TrustRegion:
    """Damping and largest length of the next step.

    Attributes
    ----------
    damping : float
        Smallest damping, relative to the squared norms of the columns.
    radius : float
        Largest length in units of the columns.

    """

    damping: float = FIRST_DAMPING
    radius: float = np.inf

    def after(self, step: DampedStep, fall: float) -> TrustRegion:
        """Return the region after a step that lowered the objective by `fall`."""
        predicted = step.predicted_fall
        if fall >= GOOD_GAIN * predicted:
            return TrustRegion(max(0.01 * self.damping, MIN_DAMPING), max(self.radius, RADIUS_GROWTH * step.length))
        if fall >= POOR_GAIN * predicted:
            return self
        shrinkage = predicted / (2 * predicted - fall) if fall <= 0 else MIN_SHRINKAGE
        return TrustRegion(self.damping, float(np.clip(shrinkage, MAX_SHRINKAGE, MIN_SHRINKAGE)) * step.length)

    def sufficient_damping(self, eigenvalues: Array, on_basis: Array) -> float:
        """Return the smallest damping with which the step is not longer than the radius.

        Parameters
        ----------
        eigenvalues : array of shape (P,)
            Of the normal matrix of normalised columns.
        on_basis : array of shape (P,)
            The gradient along its eigenvectors.

        """
        if not np.isfinite(self.radius):
            return self.damping
        decades = np.log10(MAX_DAMPING / self.damping)
        dampings = self.damping * 10.0 ** np.linspace(0, decades, int(decades * DAMPINGS_PER_DECADE) + 1)
        lengths = np.linalg.norm(on_basis / (eigenvalues + dampings[:, None]), axis=1)
        return float(dampings[np.argmax(lengths <= self.radius)]) if lengths[-1] <= self.radius else MAX_DAMPING

    def reduced_by(self, fixed: Array) -> TrustRegion:
        """Return the region of the other unknowns beside steps (m,) of fixed length, in units of the columns."""
        return replace(self, radius=float(np.sqrt(max(self.radius**2 - float(fixed @ fixed), 0.0))))

    def after_divergence(self, step: DampedStep) -> TrustRegion:
        """Return the region after a step whose motion could not be integrated."""
        return TrustRegion(self.damping, MAX_SHRINKAGE * step.length)


def is_converged(step: DampedStep, fall: float, threshold: float) -> bool:
    """Return whether a step of poor gain leaves less than a threshold to gain along it, by a parabola.

    The parabola has the predicted slope at the start of the step and the actual fall at its end.
    """
    predicted = step.predicted_fall
    if not -MAX_OVERSHOOT * predicted < fall < POOR_GAIN * predicted:
        return False
    return predicted**2 / (2 * predicted - fall) - max(fall, 0.0) < threshold


def damped_step(rows: Array, right: Array, bounds: tuple[Array, Array], region: TrustRegion) -> DampedStep:
    """Solve a linear least-squares problem within bounds and a trust region.

    Parameters
    ----------
    rows : array of shape (M, P)
        The linear problem; columns of zeros belong to unknowns that do not change.
    right : array of shape (M,)
        Its right-hand side.
    bounds : tuple of two arrays of shape (P,)
        Smallest and largest step.
    region : TrustRegion
        Damping and largest length.

    Returns
    -------
    DampedStep

    """
    norm = np.linalg.norm(rows, axis=0)
    norm[norm == 0] = 1.0
    z = _bounded_step(rows / norm, right, (bounds[0] * norm, bounds[1] * norm), region)
    step = z / norm
    fall = float(right @ right - np.sum((right - rows @ step) ** 2))
    return DampedStep(step, float(np.linalg.norm(z)), fall)


def _bounded_step(rows: Array, right: Array, bounds: tuple[Array, Array], region: TrustRegion) -> Array:
    """Damped step (P,) of normalised columns: unknowns that would leave their bounds stay there, the others go on.

    The damping is that of the unknowns that move. An unknown at its bound would otherwise shorten the steps of all.
    """
    (low, high), z, free = bounds, np.zeros(rows.shape[1]), np.ones(rows.shape[1], dtype=bool)
    damping = region.damping
    while np.any(free):
        left = right - rows[:, ~free] @ z[~free]
        z[free], damping = _free_step(rows[:, free], left, region.reduced_by(z[~free]))
        outside = (z < low) | (z > high)
        if not np.any(outside):
            break
        z, free = np.clip(z, low, high), free & ~outside
    gradient = rows.T @ (right - rows @ z) - damping * z
    if np.any(~free & np.where(z <= low, gradient > 0, gradient < 0)):  # one of them should move again
        damped = np.vstack([rows, np.sqrt(damping) * np.eye(len(z))])
        z = lsq_linear(damped, np.concatenate([right, np.zeros(len(z))]), bounds=bounds, method="bvls").x
    return z


def _free_step(rows: Array, right: Array, region: TrustRegion) -> tuple[Array, float]:
    """Damped step without bounds, and its damping."""
    u, size, vt = np.linalg.svd(rows, full_matrices=False)
    on_basis = size * (u.T @ right)
    damping = region.sufficient_damping(size**2, on_basis)
    return (on_basis / (size**2 + damping)) @ vt, damping
