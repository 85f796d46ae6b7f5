"""How well one cause explains another over any set of runs: every run reduced once to small matrices that add up.

With the law's sensitivities J, the run's own level l of spread tau, a rival's columns V and the traces d of the true
causes, a run counts by the inner products of what it shares with other runs, its own numbers taken out:

    M - m m' / (l'l + 1/tau^2),     M of [J, V, d] (V shared) or of [J, d] beside V (V the run's own)

Summed over runs, the trace that no law and no form of the rival explains is d'd - d'S (S'S)^-1 S'd.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.fit.linearised import has_per_run_coefficients
from frictrack.fit.parameters import MIN_RUNS_FOR_SCATTER
from frictrack.plan.causes import Cause
from frictrack.plan.traces import Filmed, columns
from frictrack.records import Array

RIDGE = 1e-9  # of a unit matrix: directions that no run shows
GONE = 1e-10  # share of a column's square below which it is rounding


@dataclass(frozen=True)
class Reduced:
    """One run (or several, added) against all forms (G) of one rival, for D true causes.

    The first axis of ss (2, G, s, s), sd (2, G, s, D) and dd (2, G, D) tells levels that are free from those that
    scatter. size (G, D) and weight (G, D) are the rival's own amplitude in this run and how well that is told;
    moments (3, G, D) are the weighted sums of 1, size, size^2.
    """

    ss: Array
    sd: Array
    dd: Array
    moments: Array
    runs: int = 1
    frames: int = 0

    def __add__(self, other: Reduced) -> Reduced:
        return Reduced(
            self.ss + other.ss,
            self.sd + other.sd,
            self.dd + other.dd,
            self.moments + other.moments,
            self.runs + other.runs,
            self.frames + other.frames,
        )

    def left(self) -> Array:
        """Chi-squared of every true cause that the law and the best form of the rival leave unexplained, (D,).

        A rival whose runs need different amplitudes has these, or pays for each.
        """
        k = 0 if self.runs < MIN_RUNS_FOR_SCATTER else 1
        ss, sd = self.ss[k], self.sd[k]
        norm = np.sqrt(np.maximum(np.einsum("gss->gs", ss), 1e-300))
        unit = ss / norm[:, :, None] / norm[:, None, :] + RIDGE * np.eye(ss.shape[1])
        right = sd / norm[:, :, None]
        taken = np.einsum("gsd,gsd->gd", right, np.linalg.solve(unit, right)) if ss.shape[1] else 0.0
        weight, first, second = self.moments
        tied = second - first**2 / np.maximum(weight, 1e-300)
        price = (self.runs - 1) * np.log(max(self.frames, 2))
        return np.asarray(np.min(self.dd[k] - taken + np.minimum(np.maximum(tied, 0.0), price), axis=0))


def nothing(filmed: Filmed, traces: Array, tau: float) -> Reduced:
    """One run against no rival at all: what the law alone leaves of the traces (n, D)."""
    s = filmed.law[None]
    return _levelled(s, filmed.level, np.broadcast_to(traces, (1, *traces.shape)), tau)


def rival(filmed: Filmed, cause: Cause, traces: Array, tau: float) -> Reduced:
    """One run against all forms of a rival, for traces (n, D)."""
    block = columns(filmed, cause, cause.forms)
    if cause.event:
        return _event(filmed, block, traces, tau)
    cube = block.transpose(1, 0, 2)  # (G, n, k)
    law = np.broadcast_to(filmed.law, (len(cube), *filmed.law.shape))
    if not has_per_run_coefficients(cause.effect):
        return _levelled(np.concatenate([law, cube], axis=2), filmed.level, traces[None], tau)
    return _beside(filmed, cube, traces, tau)


def _levelled(shared: Array, level: Array, traces: Array, tau: float) -> Reduced:
    """Products of shared columns (G, n, s) and traces (1 or G, n, D), the run's level taken out."""
    g = len(shared)
    ss, sd = shared.transpose(0, 2, 1) @ shared, shared.transpose(0, 2, 1) @ traces
    dd = np.broadcast_to(np.einsum("gnd,gnd->gd", traces, traces), (g, traces.shape[2]))
    sl, dl = np.einsum("gns,n->gs", shared, level), np.einsum("gnd,n->gd", traces, level)
    ll = np.full(g, float(level @ level))
    return _out(ss, sd, dd, (sl, np.broadcast_to(dl, dd.shape), ll), tau, len(level))


def _out(ss: Array, sd: Array, dd: Array, level: tuple[Array, Array, Array], tau: float, frames: int) -> Reduced:
    """The level taken out of products: free, and scattering by tau."""
    sl, dl, ll = level
    both = []
    for held in (1e-9 * np.maximum(ll, 1e-300), tau**-2):
        w = 1 / (ll + held)
        both.append(
            (
                ss - w[:, None, None] * sl[:, :, None] * sl[:, None, :],
                sd - w[:, None, None] * sl[:, :, None] * dl[:, None, :],
                dd - w[:, None] * dl**2,
            )
        )
    stacked = [np.stack([b[i] for b in both]) for i in range(3)]
    return Reduced(stacked[0], stacked[1], stacked[2], np.zeros((3, *dd.shape)), 1, frames)


def _beside(filmed: Filmed, own: Array, traces: Array, tau: float) -> Reduced:
    """A rival with coefficients of its own in every run: its columns (G, n, k) are taken out run by run."""
    p = filmed.law.shape[1]
    x = np.column_stack([filmed.law, filmed.level, traces])
    gram = own.transpose(0, 2, 1) @ own
    cross = own.transpose(0, 2, 1) @ x
    inverse = _inverse(gram)
    m = x.T @ x - cross.transpose(0, 2, 1) @ inverse @ cross
    d = slice(p + 1, None)
    level = m[:, :p, p], m[:, p, d], m[:, p, p]
    made = _out(m[:, :p, :p], m[:, :p, d], np.einsum("gdd->gd", m[:, d, d]), level, tau, len(x))
    size = np.sqrt(np.sum((inverse @ cross[:, :, d]) ** 2, axis=1))
    weight = np.broadcast_to(np.einsum("gkk->g", gram)[:, None] / gram.shape[1], size.shape)
    return Reduced(made.ss, made.sd, made.dd, np.stack([weight, weight * size, weight * size**2]), 1, len(x))


def _event(filmed: Filmed, block: Array, traces: Array, tau: float) -> Reduced:
    """A rival that comes at a moment of its own: for every trace the moment (and width) that explains it best."""
    q, _ = np.linalg.qr(np.column_stack([filmed.law, filmed.level]))
    beside = block - np.einsum("nq,qgk->ngk", q, np.einsum("nq,ngk->qgk", q, block))
    gram = np.einsum("ngk,ngl->gkl", beside, beside)
    right = np.einsum("ngk,nd->gkd", beside, traces)
    best = np.argmax(np.einsum("gkd,gkl,gld->gd", right, _inverse(gram), right), axis=0)
    parts = [_beside(filmed, block[:, g][None], traces[:, [d]], tau) for d, g in enumerate(best)]
    d = len(best)
    p = filmed.law.shape[1]
    sd, dd = np.zeros((2, d, p, d)), np.full((2, d, d), np.inf)
    for i, part in enumerate(parts):
        sd[:, i, :, i], dd[:, i, i] = part.sd[:, 0, :, 0], part.dd[:, 0, 0]
    ss = np.concatenate([part.ss for part in parts], axis=1)
    return Reduced(ss, sd, dd, np.zeros((3, d, d)), 1, len(traces))


def _inverse(gram: Array) -> Array:
    """Inverses of Gram matrices (G, k, k), without directions that are not there."""
    size = np.sqrt(np.maximum(np.einsum("gkk->gk", gram), 1e-300))
    w, v = np.linalg.eigh(gram / size[:, :, None] / size[:, None, :])
    good = (w > GONE) & (np.max(np.einsum("gkk->gk", gram), axis=1)[:, None] > 1e-20)
    inverse = (v * np.where(good, 1 / np.maximum(w, GONE), 0.0)[:, None, :]) @ v.transpose(0, 2, 1)
    return np.asarray(inverse / size[:, :, None] / size[:, None, :])


def total(parts: Sequence[Reduced]) -> Reduced:
    """Several runs together."""
    out = parts[0]
    for part in parts[1:]:
        out = out + part
    return out
