"""What the data would look like if nothing were missing: parametric bootstrap draws through the same pipeline.

A draw is white noise of the measured level plus levels scattering by the fitted spread, seen through the
linearised model. Its noise level and its spread are estimated again, as they were for the data, so that both
uncertainties enter every p-value.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.fit.simulated.scan import Family
from frictrack.fit.simulated.solve import Solution
from frictrack.fit.unknowns.scatter import Basis
from frictrack.motion import noise_level
from frictrack.records import Array

DRAWS = 999
TAUS = np.geomspace(0.002, 0.32, 9)
SMALL = 200  # forms times columns up to which the spread is profiled inside each candidate


@dataclass(frozen=True)
class Ensemble:
    """The data (first column) and the draws beside it, ready for any candidate.

    `series` (N, D) whitened, starts removed; `on_basis` (P', D); `best` (D,) index of each one's own spread.
    """

    basis: Basis
    series: Array
    on_basis: Array
    taus: Array
    shrinks: list[Array]
    profile: Array  # restricted likelihood of the bare model at every spread, (T, D)
    best: Array

    def rises(self, family: Family) -> Array:
        """Likelihood ratio of every form against the bare model, the spread estimated again: (G, D)."""
        projected = family.project(self.series)
        if len(family.grid) * family.gram.shape[1] <= SMALL:
            stacked = np.stack([family.gains(projected, self.on_basis, s) for s in self.shrinks])
            return np.asarray(self.profile.min(axis=0) - (self.profile[:, None] - stacked).min(axis=0))
        out = np.zeros((len(family.grid), self.series.shape[1]))
        for k, shrink in enumerate(self.shrinks):
            mine = np.flatnonzero(self.best == k)
            if len(mine):
                out[:, mine] = family.gains(projected[:, :, mine], self.on_basis[:, mine], shrink)
        return out

    def residuals(self) -> Array:
        """What the refitted bare model leaves of the data and of every draw, (N, D)."""
        out = self.series.copy()
        for k, shrink in enumerate(self.shrinks):
            mine = self.best == k
            out[:, mine] -= self.basis.u @ (shrink @ self.on_basis[:, mine])
        return out


def ensemble(solution: Solution, rng: np.random.Generator, draws: int = DRAWS) -> Ensemble:
    """Draws of the null hypothesis that the fitted model is the whole truth."""
    basis = solution.basis
    noise = np.concatenate([_noise(r.piece.t, r.q, rng, draws) for r in solution.responses])
    levels = solution.problem.layout.levels
    if basis.random:
        noise += solution.jac[:, levels] @ (solution.tau * rng.standard_normal((len(levels), draws)))
    series = np.column_stack([solution.unlevelled(), noise])
    on_basis = basis.u.T @ series
    total = np.einsum("nd,nd->d", series, series)
    taus = np.append(TAUS, solution.tau) if basis.random else np.array([1.0])
    shrinks = [basis.shrink(tau) for tau in taus]
    profile = np.stack([basis.misfit(on_basis, total, tau) + basis.logdet(tau) for tau in taus])
    return Ensemble(basis, series, on_basis, taus, shrinks, profile, np.argmin(profile, axis=0))


def _noise(t: Array, q: Array, rng: np.random.Generator, draws: int) -> Array:
    """White noise of one piece over its own estimated level, start removed, (n, draws)."""
    e = rng.standard_normal((len(t), draws))
    step = np.median(np.diff(t))
    frame = np.rint((t - t[0]) / step).astype(int)
    grid = np.zeros((frame[-1] + 1, draws))
    grid[frame] = e
    present = np.zeros(len(grid), dtype=bool)
    present[frame] = True
    e /= noise_level(grid, present)[0]
    return np.asarray(e - q @ (q.T @ e))
