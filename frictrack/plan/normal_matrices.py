"""Compute how well one effect explains another over any set of runs, from small matrices per run that add up.

Let J be the sensitivities of the law, l the run's friction level with standard deviation tau, V the columns of a rival
and d the traces of the true effects. A run contributes inner products of the columns that runs share; its own
parameters are eliminated (Schur complement):

    M - m m' / (l'l + 1/tau^2),     M of [J, V, d] (V shared) or of [J, d] with V eliminated (V per run)

Summed over runs, the part of a trace that neither the law nor the rival explains is d'd - d'S (S'S)^-1 S'd.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.fit.linearised import has_per_run_coefficients
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER
from frictrack.fit.stepwise import bic_penalty
from frictrack.plan.causes import Cause
from frictrack.plan.traces import PlannedRun, effect_columns
from frictrack.records import Array

RIDGE_RATIO = 1e-9  # regularises directions that no run shows
MIN_SQUARE_SHARE = 1e-10  # of a column's square, below which it is rounding


@dataclass(frozen=True)
class NormalMatrices:
    """Inner products of one run, or of several added, for G grid points of one rival and D true effects.

    Parameters
    ----------
    ss, sd, dd
        Products (2, G, s, s), (2, G, s, D) and (2, G, D) of shared columns s and traces d. First axis: friction levels
        free, or with their scatter as prior.
    moments
        Weighted sums (3, G, D) of 1, a and a^2, where a is the rival's amplitude in each run.
    runs, frames
        Number of runs and frames.

    """

    ss: Array
    sd: Array
    dd: Array
    moments: Array
    runs: int = 1
    frames: int = 0

    def __add__(self, other: NormalMatrices) -> NormalMatrices:
        return NormalMatrices(
            self.ss + other.ss,
            self.sd + other.sd,
            self.dd + other.dd,
            self.moments + other.moments,
            self.runs + other.runs,
            self.frames + other.frames,
        )

    def unexplained_chi2(self, *, scatter_known: bool = True) -> Array:
        """Chi-squared of every true effect that the law and the best fit of the rival leave unexplained.

        A rival that needs a different amplitude in every run gets them, at the penalty of BIC for each.

        Parameters
        ----------
        scatter_known
            Whether the scatter of the levels is known. Otherwise these runs alone show it, and what the friction levels
            say has only as many degrees of freedom.

        Returns
        -------
        ndarray, shape (D,)

        """
        left = self._unexplained(0)
        if self.runs >= MIN_RUNS_FOR_SCATTER:
            known = self._unexplained(1)
            left = known if scatter_known else left + chi2_equivalent(known - left, self.runs - 2)
        weight, first, second = self.moments
        one_amplitude = second - first**2 / np.maximum(weight, 1e-300)
        penalty = bic_penalty(self.runs - 1, max(self.frames, 2))
        return np.asarray(np.min(left + np.minimum(np.maximum(one_amplitude, 0.0), penalty), axis=0))

    def _unexplained(self, k: int) -> Array:
        """The same (G, D) at every grid point for one amplitude: with levels free (0) or with their prior (1)."""
        ss, sd = self.ss[k], self.sd[k]
        norm = np.sqrt(np.maximum(np.einsum("gss->gs", ss), 1e-300))
        unit = ss / norm[:, :, None] / norm[:, None, :] + RIDGE_RATIO * np.eye(ss.shape[1])
        right = sd / norm[:, :, None]
        explained = np.einsum("gsd,gsd->gd", right, np.linalg.solve(unit, right)) if ss.shape[1] else 0.0
        return np.asarray(self.dd[k] - explained)


def chi2_equivalent(t2: Array, df: int) -> Array:
    """Chi-squared of one degree of freedom that is as improbable as the square of Student's t.

    Parameters
    ----------
    t2
        Squares of t.
    df
        Degrees of freedom of the variance in t.

    Returns
    -------
    ndarray

    References
    ----------
    Wallace, D. L. (1959). Ann. Math. Stat. 30, 1121-1130.

    Examples
    --------
    >>> round(float(chi2_equivalent(np.array(10.13), 3)), 1)  # both of probability 0.05
    3.8

    """
    return np.asarray(((8 * df + 1) / (8 * df + 3)) ** 2 * df * np.log1p(np.maximum(t2, 0.0) / df))


def reduce_without_rival(run: PlannedRun, traces: Array, tau: float) -> NormalMatrices:
    """Reduce one run without a rival.

    Parameters
    ----------
    run
        The simulated run.
    traces
        Traces of the true effects, (n, D).
    tau
        Relative scatter of the friction level.

    Returns
    -------
    NormalMatrices

    """
    s = run.law_columns[None]
    return _reduce_shared(s, run.level_column, np.broadcast_to(traces, (1, *traces.shape)), tau)


def reduce_against_rival(run: PlannedRun, cause: Cause, traces: Array, tau: float) -> NormalMatrices:
    """Reduce one run against all grid points of a rival.

    Parameters
    ----------
    run
        The simulated run.
    cause
        The rival.
    traces
        Traces of the true effects, (n, D).
    tau
        Relative scatter of the friction level.

    Returns
    -------
    NormalMatrices

    """
    block = effect_columns(run, cause, cause.grid)
    if cause.is_event:
        return _reduce_event(run, block, traces, tau)
    cube = block.transpose(1, 0, 2)  # (G, n, k)
    law = np.broadcast_to(run.law_columns, (len(cube), *run.law_columns.shape))
    if not has_per_run_coefficients(cause.effect):
        return _reduce_shared(np.concatenate([law, cube], axis=2), run.level_column, traces[None], tau)
    return _reduce_per_run(run, cube, traces, tau)


def _reduce_shared(shared: Array, level: Array, traces: Array, tau: float) -> NormalMatrices:
    """Products of shared columns (G, n, s) and traces (1 or G, n, D), with the run's level eliminated."""
    g = len(shared)
    ss, sd = shared.transpose(0, 2, 1) @ shared, shared.transpose(0, 2, 1) @ traces
    dd = np.broadcast_to(np.einsum("gnd,gnd->gd", traces, traces), (g, traces.shape[2]))
    sl, dl = np.einsum("gns,n->gs", shared, level), np.einsum("gnd,n->gd", traces, level)
    ll = np.full(g, float(level @ level))
    return _eliminate_level(ss, sd, dd, (sl, np.broadcast_to(dl, dd.shape), ll), tau, len(level))


def _eliminate_level(
    ss: Array, sd: Array, dd: Array, level: tuple[Array, Array, Array], tau: float, frames: int
) -> NormalMatrices:
    """Eliminate the level from the products: once free, once with its scatter as prior."""
    sl, dl, ll = level
    both = []
    for prior in (1e-9 * np.maximum(ll, 1e-300), tau**-2):
        w = 1 / (ll + prior)
        both.append(
            (
                ss - w[:, None, None] * sl[:, :, None] * sl[:, None, :],
                sd - w[:, None, None] * sl[:, :, None] * dl[:, None, :],
                dd - w[:, None] * dl**2,
            )
        )
    stacked = [np.stack([b[i] for b in both]) for i in range(3)]
    return NormalMatrices(stacked[0], stacked[1], stacked[2], np.zeros((3, *dd.shape)), 1, frames)


def _reduce_per_run(run: PlannedRun, own: Array, traces: Array, tau: float) -> NormalMatrices:
    """Products for a rival with coefficients per run; its columns (G, n, k) are eliminated in each run."""
    p = run.law_columns.shape[1]
    x = np.column_stack([run.law_columns, run.level_column, traces])
    gram = own.transpose(0, 2, 1) @ own
    cross = own.transpose(0, 2, 1) @ x
    inverse = _inverse(gram)
    m = x.T @ x - cross.transpose(0, 2, 1) @ inverse @ cross
    d = slice(p + 1, None)
    level = m[:, :p, p], m[:, p, d], m[:, p, p]
    made = _eliminate_level(m[:, :p, :p], m[:, :p, d], np.einsum("gdd->gd", m[:, d, d]), level, tau, len(x))
    size = np.sqrt(np.sum((inverse @ cross[:, :, d]) ** 2, axis=1))
    weight = np.broadcast_to(np.einsum("gkk->g", gram)[:, None] / gram.shape[1], size.shape)
    return NormalMatrices(made.ss, made.sd, made.dd, np.stack([weight, weight * size, weight * size**2]), 1, len(x))


def _reduce_event(run: PlannedRun, block: Array, traces: Array, tau: float) -> NormalMatrices:
    """Products for a rival at a time of its own: each trace takes the time and width that explain it best."""
    q, _ = np.linalg.qr(np.column_stack([run.law_columns, run.level_column]))
    projected = block - np.einsum("nq,qgk->ngk", q, np.einsum("nq,ngk->qgk", q, block))
    gram = np.einsum("ngk,ngl->gkl", projected, projected)
    right = np.einsum("ngk,nd->gkd", projected, traces)
    best = np.argmax(np.einsum("gkd,gkl,gld->gd", right, _inverse(gram), right), axis=0)
    parts = [_reduce_per_run(run, block[:, g][None], traces[:, [d]], tau) for d, g in enumerate(best)]
    d = len(best)
    p = run.law_columns.shape[1]
    sd, dd = np.zeros((2, d, p, d)), np.full((2, d, d), np.inf)
    for i, part in enumerate(parts):
        sd[:, i, :, i], dd[:, i, i] = part.sd[:, 0, :, 0], part.dd[:, 0, 0]
    ss = np.concatenate([part.ss for part in parts], axis=1)
    return NormalMatrices(ss, sd, dd, np.zeros((3, d, d)), 1, len(traces))


def _inverse(gram: Array) -> Array:
    """Inverses of Gram matrices (G, k, k) on the directions that exist."""
    size = np.sqrt(np.maximum(np.einsum("gkk->gk", gram), 1e-300))
    w, v = np.linalg.eigh(gram / size[:, :, None] / size[:, None, :])
    good = (w > MIN_SQUARE_SHARE) & (np.max(np.einsum("gkk->gk", gram), axis=1)[:, None] > 1e-20)
    inverse = (v * np.where(good, 1 / np.maximum(w, MIN_SQUARE_SHARE), 0.0)[:, None, :]) @ v.transpose(0, 2, 1)
    return np.asarray(inverse / size[:, :, None] / size[:, None, :])


def sum_runs(parts: Sequence[NormalMatrices]) -> NormalMatrices:
    """Add the matrices of several runs."""
    out = parts[0]
    for part in parts[1:]:
        out = out + part
    return out
