"""Run-to-run scatter of the friction level: a random effect whose spread is estimated (REML).

Everything is done in the orthonormal basis of the linearised model, so any spread tau costs only P x P algebra.
Patterson & Thompson 1971 (REML); Searle, Casella & McCulloch, Variance Components, ch. 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from frictrack.fit.layout import Layout
from frictrack.records import Array

TAU = (1e-4, 0.5)  # where the relative spread of the level is looked for
MIN_RUNS = 4  # fewer cannot tell a spread: their levels are free


@dataclass(frozen=True)
class Basis:
    """A linearised model J (N, P): its orthonormal basis and the prior on the friction levels in it.

    Directions that the data do not see at all are dropped. `prior` is the level rows seen from the basis.
    """

    u: Array  # (N, P')
    prior: Array  # (P', P'), to be divided by tau^2
    n_levels: int
    random: bool  # the level is a random effect; otherwise free up to its mean

    def shrink(self, tau: float) -> Array:
        """(I + prior / tau^2)^-1: what the prior leaves of the basis, (P', P')."""
        weight = 1 / tau**2 if self.random else 1e8
        return np.asarray(np.linalg.inv(np.eye(len(self.prior)) + weight * self.prior), dtype=np.float64)

    def logdet(self, tau: float) -> float:
        """Determinant part of the restricted likelihood at this spread."""
        if not self.random:
            return 0.0
        _, value = np.linalg.slogdet(np.eye(len(self.prior)) + self.prior / tau**2)
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

        low, high = (float(np.log(tau)) for tau in TAU)
        found = minimize_scalar(objective, bounds=(low, high), method="bounded", options={"xatol": 1e-3})
        return float(np.exp(found.x))


def basis_of(jac: Array, levels: list[int]) -> Basis:
    """Orthonormal basis of a whitened Jacobian (N, P) whose columns `levels` are friction levels."""
    norm = np.linalg.norm(jac, axis=0)
    norm[norm == 0] = 1.0
    u, s, vt = np.linalg.svd(jac / norm, full_matrices=False)
    keep = s > 1e-9 * s[0]
    back = vt[keep].T / s[keep] / norm[:, None]  # unknowns per unit of basis coordinate
    random = len(levels) >= MIN_RUNS
    seen = back[levels]
    if not random and levels:
        seen = seen.mean(axis=0, keepdims=True)
    return Basis(u[:, keep], seen.T @ seen, len(levels), random)


def restraint_rows(layout: Layout, tau: float) -> Array:
    """Rows (m, P) that hold the levels about one: each to within tau, or their mean when there are too few runs."""
    levels = layout.levels
    pick = np.zeros((len(levels), len(layout.slots)))
    pick[np.arange(len(levels)), levels] = 1.0
    if layout.levels_free or not levels:
        return pick[:0]
    return pick / tau if len(levels) >= MIN_RUNS else pick.mean(axis=0, keepdims=True) * 1e4


def restraint(layout: Layout, p: Array, tau: float) -> Array:
    """Departure of the levels from one, as `restraint_rows` weighs it, (m,)."""
    at_one = np.zeros(len(p))
    at_one[layout.levels] = 1.0
    departure: Array = restraint_rows(layout, tau) @ (p - at_one)
    return departure
