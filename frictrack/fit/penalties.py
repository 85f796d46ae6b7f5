"""Hold unknowns by penalties, which are further rows of a least-squares problem: friction levels, and priors.

Friction levels scatter between runs about one: a random effect, whose standard deviation tau is estimated by restricted
maximum likelihood (REML). All computations use the orthonormal basis of the linearised model, so that another tau costs
only P x P algebra.

Priors are a multivariate normal distribution of reported parameters. With deviations d of the reported values from
their means and covariance C, the penalty is d' C^-1 d, the sum of squares of W d with W' W = C^-1.

References
----------
Patterson, H. D. & Thompson, R. (1971). Recovery of inter-block information. Biometrika 58, 545-554.
Searle, S. R., Casella, G. & McCulloch, C. E. (1992). Variance Components, ch. 6. Wiley.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize_scalar

from frictrack.fit.parameters import MASS, MIN_RUNS_FOR_SCATTER, ParameterLayout, whitening_matrix
from frictrack.fit.pieces import column_norms
from frictrack.records import Array

SCATTER_BOUNDS = (1e-6, 0.5)  # range of the relative standard deviation of the levels
MEAN_LEVEL_WEIGHT = 1e4  # that holds the mean of few levels at one


@dataclass(frozen=True)
class JacobianBasis:
    """An orthonormal basis of a linearised model J (N, P), with the prior of the friction levels expressed in it.

    Directions that the data do not determine are dropped; the levels are adjusted along them.

    Attributes
    ----------
    u : array of shape (N, P')
        The basis.
    level_rows : array of shape (m, P')
        Levels per unit of the basis coordinates, to be divided by tau.
    n_levels : int
        Number of level directions that are left.
    random : bool
        Whether the levels are a random effect. Otherwise only their mean is constrained.
    prior_rows : array of shape (k, P')
        Rows of the priors of parameters, in standard deviations per unit of the basis coordinates.

    """

    u: Array
    level_rows: Array
    n_levels: int
    random: bool
    prior_rows: Array

    def shrink(self, tau: float) -> Array:
        """Compute the shrinkage matrix (I + R'R)^-1 of the basis coordinates, (P', P'); R are the rows of all priors.

        A level or parameter that the data hardly determine has rows that are many orders of magnitude above 1. Their
        squares cannot be added to I; a QR decomposition with the largest rows first keeps the small ones.
        """
        inverse = solve_triangular(self._root(tau if self.random else 1 / MEAN_LEVEL_WEIGHT), np.eye(self.u.shape[1]))
        return np.asarray(inverse @ inverse.T, dtype=np.float64)

    def logdet(self, tau: float) -> float:
        """Compute the determinant term of the restricted likelihood at this tau."""
        if not self.random:
            return 0.0
        return 2 * float(np.sum(np.log(np.abs(np.diag(self._root(tau)))))) + 2 * self.n_levels * float(np.log(tau))

    def _root(self, tau: float) -> Array:
        """Upper triangular root (P', P') of I + R'R."""
        rows = np.vstack([self.level_rows / tau, self.prior_rows, np.eye(self.u.shape[1])])
        order = np.argsort(-np.abs(rows).max(axis=1, initial=0.0), kind="stable")
        return np.asarray(np.linalg.qr(rows[order], mode="r"))

    def misfit(self, on_basis: Array, total: Array, tau: float) -> Array:
        """Compute the chi-squared (D,) that the model leaves of D data series e.

        `on_basis` (P', D) holds their coordinates u' e in the basis, `total` (D,) their sums of squares.
        """
        return total - np.einsum("pd,pq,qd->d", on_basis, self.shrink(tau), on_basis)  # e'e - (u'e)' S (u'e)

    def spread(self, on_basis: Array, total: float) -> float:
        """Estimate tau of one series by REML, from its coordinates (P',) and its sum of squares; 0 without scatter."""
        if not self.random:
            return 0.0

        def objective(log_tau: float) -> float:
            tau = float(np.exp(log_tau))
            return float(self.misfit(on_basis[:, None], np.array([total]), tau)[0]) + self.logdet(tau)

        low, high = (float(np.log(tau)) for tau in SCATTER_BOUNDS)
        found = minimize_scalar(objective, bounds=(low, high), method="bounded", options={"xatol": 1e-3})
        return float(np.exp(found.x))


def jacobian_basis(jac: Array, levels: list[int], known: Array | None = None) -> JacobianBasis:
    """Compute an orthonormal basis of a whitened Jacobian (N, P) with its priors.

    `levels` are the columns of the friction levels, `known` (m, P) rows of the priors of parameters.
    """
    norm = column_norms(jac)
    u, s, vt = np.linalg.svd(jac / norm, full_matrices=False)
    keep = s > 1e-9 * s[0]
    back = vt[keep].T / s[keep] / norm[:, None]  # unknowns per unit of basis coordinate
    random = len(levels) >= MIN_RUNS_FOR_SCATTER
    seen, unseen = back[levels], (vt[~keep].T / norm[:, None])[levels]
    if not random and levels:
        seen, unseen = seen.mean(axis=0, keepdims=True), unseen.mean(axis=0, keepdims=True)
    # shifts along undetermined directions, such as all levels up and Coulomb friction down, bring levels nearest to one
    shifts, size, _ = np.linalg.svd(unseen, full_matrices=False)
    shifts = shifts[:, size > 1e-9 * max(float(np.abs(seen).max(initial=0.0)), 1e-300)]
    seen = seen - shifts @ (shifts.T @ seen)
    prior_rows = back[:0] if known is None else known @ back
    return JacobianBasis(u[:, keep], seen, len(levels) - shifts.shape[1], random, prior_rows)


def penalty_jacobian(layout: ParameterLayout, tau: float, p: Array | None = None) -> Array:
    """Compute the Jacobian (m, P) of the penalties: friction levels about one, then the priors, in standard deviations.

    Each level is held to within tau. With too few runs only their mean is held. Priors are linearised at p (P,); it
    matters only where the mass is fitted too.
    """
    return np.vstack([_level_jacobian(layout, tau), prior_jacobian(layout, p)])


def penalty_residual(layout: ParameterLayout, p: Array, tau: float) -> Array:
    """Compute the residuals (m,) of the penalties at unknowns p (P,), weighted as in `penalty_jacobian`."""
    levels = layout.levels
    return np.concatenate([_level_jacobian(layout, tau)[:, levels] @ (p[levels] - 1.0), prior_residual(layout, p)])


def _level_jacobian(layout: ParameterLayout, tau: float) -> Array:
    """Rows (m, P) that hold the friction levels."""
    levels = layout.levels
    rows = np.eye(len(layout.slots))[levels]
    if not levels:
        return rows[:0]
    return rows / tau if len(levels) >= MIN_RUNS_FOR_SCATTER else rows.mean(axis=0, keepdims=True) * MEAN_LEVEL_WEIGHT


def prior_departure(layout: ParameterLayout, p: Array) -> Array:
    """Compute the deviation of every parameter with a prior from its mean, in its unit, (m,)."""
    reported = layout.reported_values(p)
    return np.array([_wrapped(reported[q.address] - q.mean, q.phase) for q in layout.priors])


def prior_residual(layout: ParameterLayout, p: Array) -> Array:
    """Compute the deviations from the means of the priors, in independent standard deviations, (m,)."""
    return np.asarray(layout.prior_whitening @ prior_departure(layout, p)) if layout.priors else np.empty(0)


def prior_jacobian(layout: ParameterLayout, p: Array | None = None) -> Array:
    """Compute the derivative of `prior_residual` with respect to the unknowns, (m, P)."""
    rows = np.zeros((len(layout.priors), len(layout.slots)))
    if not layout.priors:
        return rows
    for row, q in zip(rows, layout.priors, strict=True):
        if q.slot is not None:
            row[q.slot] = 1.0
    if converted := [i for i, q in enumerate(layout.priors) if q.slot is None]:
        # without p at unknowns where no reported value is singular
        p = np.array([0.0 if s.effect == MASS else 1.0 for s in layout.slots]) if p is None else p
        base, steps = prior_departure(layout, p), np.diag(1e-6 * np.maximum(np.abs(p), 1e-3))
        changes = np.array([prior_departure(layout, p + step) - base for step in steps]).T
        rows[converted] = (changes / np.diag(steps))[converted]
    return np.asarray(layout.prior_whitening @ rows)


def prior_misfit(layout: ParameterLayout, points: Array) -> Array:
    """Compute the sum of squared prior residuals for a population of unknowns (n, P), shape (n,)."""
    if not layout.priors:
        return np.zeros(len(points))
    if any(q.slot is None for q in layout.priors):
        departures = np.array([prior_departure(layout, p) for p in points]).reshape(len(points), -1)
    else:
        departures = np.stack([_wrapped(points[:, q.slot] - q.mean, q.phase) for q in layout.priors], axis=1)
    return np.asarray(np.sum((departures @ layout.prior_whitening.T) ** 2, axis=1))


def direct_prior_equations(layout: ParameterLayout, free: Sequence[int]) -> tuple[Array, Array]:
    """Compute rows (m, P) and targets (m,) of the priors of some unknowns that are reported as they are.

    Correlations with other priors are left out: these rows are their marginal distribution.
    """
    slots = [q.slot for q in layout.priors]
    which = [i for i, slot in enumerate(slots) if slot is not None and slot in free]
    rows = np.eye(len(layout.slots))[[slots[i] or 0 for i in which]]
    if not which:
        return rows, np.zeros(0)
    white = whitening_matrix(layout.prior_covariance[np.ix_(which, which)])
    return white @ rows, white @ np.array([layout.priors[i].mean for i in which])


def _wrapped(departure: Any, phase: bool) -> Any:
    """A deviation; that of a phase wrapped to (-pi, pi]."""
    return (departure + np.pi) % (2 * np.pi) - np.pi if phase else departure
