"""Estimate the scatter tau of friction levels between runs: a random effect, by restricted maximum likelihood (REML).

All computations use the orthonormal basis of the linearised model, so that another tau costs only P x P algebra.
Priors of parameters enter as further rows.

References
----------
Patterson, H. D. & Thompson, R. (1971). Recovery of inter-block information. Biometrika 58, 545-554.
Searle, S. R., Casella, G. & McCulloch, C. E. (1992). Variance Components, ch. 6. Wiley.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize_scalar

from frictrack.fit.parameters.layout import MIN_RUNS_FOR_SCATTER, ParameterLayout
from frictrack.fit.parameters.prior_penalties import prior_jacobian, prior_residual
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
        """Compute the chi-squared that the model leaves of several data series.

        Parameters
        ----------
        on_basis : array of shape (P', D)
            Coordinates u' e of the series in the basis.
        total : array of shape (D,)
            Sums of squares of the series.
        tau : float
            Standard deviation of the levels.

        Returns
        -------
        array of shape (D,)
            Chi-squared of every series.

        """
        return total - np.einsum("pd,pq,qd->d", on_basis, self.shrink(tau), on_basis)

    def spread(self, on_basis: Array, total: float) -> float:
        """Estimate tau of one series by restricted maximum likelihood.

        Parameters
        ----------
        on_basis : array of shape (P',)
            Coordinates of the series in the basis.
        total : float
            Its sum of squares.

        Returns
        -------
        float
            Relative standard deviation of the levels; 0 where they are not a random effect.

        """
        if not self.random:
            return 0.0

        def objective(log_tau: float) -> float:
            tau = float(np.exp(log_tau))
            return float(self.misfit(on_basis[:, None], np.array([total]), tau)[0]) + self.logdet(tau)

        low, high = (float(np.log(tau)) for tau in SCATTER_BOUNDS)
        found = minimize_scalar(objective, bounds=(low, high), method="bounded", options={"xatol": 1e-3})
        return float(np.exp(found.x))


def jacobian_basis(jac: Array, levels: list[int], known: Array | None = None) -> JacobianBasis:
    """Compute an orthonormal basis of a whitened Jacobian.

    Parameters
    ----------
    jac : array of shape (N, P)
        Whitened Jacobian.
    levels : list of int
        Columns of the friction levels.
    known : array of shape (m, P), optional
        Rows of the priors of parameters.

    Returns
    -------
    JacobianBasis
        The basis with its priors.

    """
    norm = np.linalg.norm(jac, axis=0)
    norm[norm == 0] = 1.0
    u, s, vt = np.linalg.svd(jac / norm, full_matrices=False)
    keep = s > 1e-9 * s[0]
    back = vt[keep].T / s[keep] / norm[:, None]  # unknowns per unit of basis coordinate
    random = len(levels) >= MIN_RUNS_FOR_SCATTER
    seen, unseen = back[levels], (vt[~keep].T / norm[:, None])[levels]
    if not random and levels:
        seen, unseen = seen.mean(axis=0, keepdims=True), unseen.mean(axis=0, keepdims=True)
    seen, n_dropped = _levels_near_one(seen, unseen)
    prior_rows = back[:0] if known is None else known @ back
    return JacobianBasis(u[:, keep], seen, len(levels) - n_dropped, random, prior_rows)


def _levels_near_one(seen: Array, unseen: Array) -> tuple[Array, int]:
    """Level rows (m, P') of the basis after a shift along undetermined directions, and the number of such directions.

    `unseen` (m, d) are the level changes per unit of an undetermined direction, such as all levels up and Coulomb
    friction down. Such a shift brings the levels as near to one as possible.
    """
    u, size, _ = np.linalg.svd(unseen, full_matrices=False)
    removable = u[:, size > 1e-9 * max(float(np.abs(seen).max(initial=0.0)), 1e-300)]
    return seen - removable @ (removable.T @ seen), removable.shape[1]


def penalty_jacobian(layout: ParameterLayout, tau: float, p: Array | None = None) -> Array:
    """Compute the Jacobian of the penalties: friction levels about one, then the priors of parameters.

    Each level is held to within tau. With too few runs only their mean is held.

    Parameters
    ----------
    layout : ParameterLayout
        The layout.
    tau : float
        Relative standard deviation of the levels.
    p : array of shape (P,), optional
        Where priors are linearised; it matters only where the mass is fitted too.

    Returns
    -------
    array of shape (m, P)
        One row per penalty, in standard deviations.

    """
    levels = layout.levels
    level_rows = np.zeros((len(levels), len(layout.slots)))
    level_rows[np.arange(len(levels)), levels] = 1.0
    if layout.levels_free or not levels:
        held = level_rows[:0]
    elif len(levels) >= MIN_RUNS_FOR_SCATTER:
        held = level_rows / tau
    else:
        held = level_rows.mean(axis=0, keepdims=True) * MEAN_LEVEL_WEIGHT
    return np.vstack([held, prior_jacobian(layout, p)])


def penalty_residual(layout: ParameterLayout, p: Array, tau: float) -> Array:
    """Compute the residuals (m,) of the penalties at unknowns p (P,), weighted as in `penalty_jacobian`."""
    levels_at_one = np.array(p)
    levels_at_one[layout.levels] = 1.0
    count = len(layout.priors)
    levels = penalty_jacobian(layout, tau, p) @ (p - levels_at_one)
    return np.concatenate([levels[: len(levels) - count], prior_residual(layout, p)])
