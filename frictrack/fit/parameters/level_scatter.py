"""Run-to-run scatter of the friction level: a random effect whose spread is estimated (REML).

Everything is done in the orthonormal basis of the linearised model, so any spread tau costs only P x P algebra.
Patterson & Thompson 1971 (REML); Searle, Casella & McCulloch, Variance Components, ch. 6.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from frictrack.fit.parameters.constraints import MASS
from frictrack.fit.parameters.layout import MIN_RUNS_FOR_SCATTER, ParameterLayout
from frictrack.records import Array

SCATTER_BOUNDS = (1e-4, 0.5)  # where the relative spread of the level is looked for


@dataclass(frozen=True)
class JacobianBasis:
    """A linearised model J (N, P): its orthonormal basis and the prior on the friction levels in it.

    Directions that the data do not see at all are dropped, the levels following along them. `prior` is the level rows
    seen from the basis; `n_levels` how many of their directions are left.
    """

    u: Array  # (N, P')
    prior: Array  # (P', P'), to be divided by tau^2
    n_levels: int
    random: bool  # the level is a random effect; otherwise free up to its mean
    prior_precision: Array | float = 0.0  # (P', P'), what priors of parameters add

    def shrink(self, tau: float) -> Array:
        """(I + prior / tau^2)^-1: what the prior leaves of the basis, (P', P')."""
        weight = 1 / tau**2 if self.random else 1e8
        return np.asarray(
            np.linalg.inv(np.eye(len(self.prior)) + self.prior_precision + weight * self.prior), dtype=np.float64
        )

    def logdet(self, tau: float) -> float:
        """Determinant part of the restricted likelihood at this spread."""
        if not self.random:
            return 0.0
        _, value = np.linalg.slogdet(np.eye(len(self.prior)) + self.prior_precision + self.prior / tau**2)
        return float(value) + 2 * self.n_levels * np.log(tau)

    def misfit(self, on_basis: Array, total: Array, tau: float) -> Array:
        """Chi-squared left by the model: total (D,) minus what the basis takes; on_basis is u' e, (P', D)."""
        return total - np.einsum("pd,pq,qd->d", on_basis, self.shrink(tau), on_basis)

    def spread(self, on_basis: Array, total: float) -> float:
        """Restricted maximum likelihood of tau for one series; zero when the levels are free."""
        if not self.random:
            return 0.0

        def objective(log_tau: float) -> float:
            tau = float(np.exp(log_tau))
            return float(self.misfit(on_basis[:, None], np.array([total]), tau)[0]) + self.logdet(tau)

        low, high = (float(np.log(tau)) for tau in SCATTER_BOUNDS)
        found = minimize_scalar(objective, bounds=(low, high), method="bounded", options={"xatol": 1e-3})
        return float(np.exp(found.x))


def jacobian_basis(jac: Array, levels: list[int], known: Array | None = None) -> JacobianBasis:
    """Orthonormal basis of a whitened Jacobian (N, P) whose columns `levels` are friction levels.

    `known` (m, P) are the rows of parameters' priors.
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
    prior_precision = 0.0 if known is None or not len(known) else (known @ back).T @ (known @ back)
    return JacobianBasis(u[:, keep], seen.T @ seen, len(levels) - n_dropped, random, prior_precision)


def _levels_near_one(seen: Array, unseen: Array) -> tuple[Array, int]:
    """Levels per unit of the basis (m, P') where directions that no data see bring them as near to one as they can.

    `unseen` (m, d) are levels per unit of such directions: all levels up and Coulomb friction down is one. Also how
    many of the levels' directions they take.
    """
    u, size, _ = np.linalg.svd(unseen, full_matrices=False)
    removable = u[:, size > 1e-9 * max(float(np.abs(seen).max(initial=0.0)), 1e-300)]
    return seen - removable @ (removable.T @ seen), removable.shape[1]


def penalty_jacobian(layout: ParameterLayout, tau: float, p: Array | None = None) -> Array:
    """Rows (m, P) of what is known beside the runs: the levels about one, then the priors of parameters.

    Each level to within tau, or their mean when there are too few runs. `p` (P,) is where priors are linearised, which
    matters only where the mass is fitted too.
    """
    levels = layout.levels
    level_rows = np.zeros((len(levels), len(layout.slots)))
    level_rows[np.arange(len(levels)), levels] = 1.0
    if layout.levels_free or not levels:
        prior_precision = level_rows[:0]
    else:
        prior_precision = (
            level_rows / tau if len(levels) >= MIN_RUNS_FOR_SCATTER else level_rows.mean(axis=0, keepdims=True) * 1e4
        )
    return np.vstack([prior_precision, prior_jacobian(layout, p)])


def penalty_residual(layout: ParameterLayout, p: Array, tau: float) -> Array:
    """Departure of the unknowns p (P,) from what is known beside the runs, as `penalty_jacobian` weighs it, (m,)."""
    levels_at_one = np.array(p)
    levels_at_one[layout.levels] = 1.0
    count = len(layout.priors)
    levels = penalty_jacobian(layout, tau, p) @ (p - levels_at_one)
    return np.concatenate([levels[: len(levels) - count], prior_residual(layout, p)])


def prior_residual(layout: ParameterLayout, p: Array) -> Array:
    """Departure of every parameter that has a prior from its mean, in standard deviations, (m,)."""
    if not layout.priors:
        return np.empty(0)
    reported = layout.reported_values(p)
    return np.array([(_wrapped(reported[q.address] - q.mean, q.phase)) / q.std for q in layout.priors])


def prior_jacobian(layout: ParameterLayout, p: Array | None = None) -> Array:
    """Derivative of `prior_residual` in the unknowns, (m, P)."""
    rows = np.zeros((len(layout.priors), len(layout.slots)))
    needs_differences = [q for q in layout.priors if q.slot is None]
    for row, q in zip(rows, layout.priors, strict=True):
        if q.slot is not None:
            row[q.slot] = 1 / q.std
    if needs_differences:
        which = [i for i, q in enumerate(layout.priors) if q.slot is None]
        rows[which] = _differences(layout, _regular_point(layout) if p is None else p)[which]
    return rows


def _regular_point(layout: ParameterLayout) -> Array:
    """Unknowns (P,) at which no quotient vanishes, the mass as it is counted."""
    return np.array([0.0 if s.effect == MASS else 1.0 for s in layout.slots])


def _differences(layout: ParameterLayout, p: Array) -> Array:
    base = prior_residual(layout, p)
    out = np.zeros((len(base), len(p)))
    for i in range(len(p)):
        step = np.zeros(len(p))
        step[i] = 1e-6 * max(abs(p[i]), 1e-3)
        out[:, i] = (prior_residual(layout, p + step) - base) / step[i]
    return out


def prior_misfit(layout: ParameterLayout, points: Array) -> Array:
    """Sum of squared departures from priors of a population of unknowns (n, P), shape (n,)."""
    total = np.zeros(len(points))
    for q in layout.priors:
        if q.slot is not None:
            total += (_wrapped(points[:, q.slot] - q.mean, q.phase) / q.std) ** 2
    if any(q.slot is None for q in layout.priors):
        needs_differences = np.array([q.slot is None for q in layout.priors])
        total += np.array([np.sum(prior_residual(layout, p)[needs_differences] ** 2) for p in points])
    return total


def _wrapped(departure: Any, phase: bool) -> Any:
    """A departure, that of a phase the short way round."""
    return (departure + np.pi) % (2 * np.pi) - np.pi if phase else departure
