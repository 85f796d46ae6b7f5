"""Whether a failure repeats: at the same place, the same time since release, the same speed, or the same phase.

Of every axis it is asked how much of the misfit of a run is foretold by one common curve over this axis that only the
other runs have drawn: a smooth one, over the place also a wave. The curve is a force, its trace in the displacement is
compared (where the noise is white), beside all that the law could take up of it. A failure that repeats at a place
belongs to the course, at a time to what happens since release, at a velocity to the law of friction, at a phase to
something that vibrates.

Chance: signs of every run's residual in a cosine basis are drawn anew, which leaves each run its own misfit and noise
but nothing common; for the phase, every run is given another frequency.

Which axis it is, and whether any, is decided by the likelihood: of a smooth force over the axis (a wave over the place
too), against that of a smooth force of its own in every run. Other runs foretell little where few of them show the
failure, and the likelihood knows of all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.fft import dct, idct

from frictrack.compare import NodeMotion, course_ends, motion_at_nodes, wave_traces
from frictrack.diagnose.compressed import compress_residual
from frictrack.diagnose.repeatability.axis_result import AxisRepeatability, describe_axes, sort_axes
from frictrack.diagnose.repeatability.common_frequency import (
    MIN_PREDICTED_SHARE,
    assess_common_frequency,
    restricted_likelihood_gain,
)
from frictrack.diagnose.smooth_forces import gain_of_separate_curves, smooth_forces
from frictrack.effects import spatial_periods
from frictrack.fit.least_squares import ModelProjection, Solution, displacement_response, model_projection
from frictrack.fit.smooth_functions import linear_interpolation_matrix, matern_covariance
from frictrack.records import Array

N_DRAWS = 199
N_KNOTS = {"x": 120, "t": 80, "v": 40}
CORRELATION_LENGTHS_KNOTS = (2.0, 6.0, 20.0)  # of a curve, in knots
PRIOR_SIZES = (0.3, 3.0, 30.0)  # of a curve, over what its runs just show
MIN_LAW_WEIGHT = 0.03  # of what all runs tell of the law that stays when a run is foretold by the others


@dataclass(frozen=True)
class Repeatability:
    """The axes, best first, what is to be said, and the common curve over every axis: (k,) each."""

    axes: list[AxisRepeatability] = field(default_factory=list)
    words: str = ""
    curves: dict[str, dict[str, Array]] = field(default_factory=dict)

    @property
    def best(self) -> AxisRepeatability | None:
        """The axis along which the failure repeats, if it does along any."""
        return next((a for a in self.axes if a.holds), None)

    def summary(self) -> list[dict[str, Any]]:
        """JSON `repeats`."""
        return [a.summary() for a in self.axes]


@dataclass(frozen=True)
class _Fold:
    """What the runs see of a curve through K knots and of the S columns of the law that they share.

    Gram matrices (R, K + S, K + S) and data (R, K + S, D), D = 1 + draws.
    """

    knots: Array
    gram: Array
    data: Array


@dataclass(frozen=True)
class _Waved:
    """What runs see of G waves: Gram matrices (..., G, 2, 2) and with the law (..., G, 2, S), data (..., G, 2, D)."""

    pairs: Array
    cross: Array
    data: Array


@dataclass(frozen=True)
class _Runs:
    """Residuals and shared law of every run, beside what belongs to the run alone (its level, its own phases).

    `series` (n_i, D) and `shared` (n_i, S) of every piece; `own` (n_i, k) orthonormal; `run` its place among the runs.
    """

    law: ModelProjection
    at: list[NodeMotion]
    run: list[int]
    own: list[Array]
    shared: list[Array]
    series: list[Array]

    @property
    def count(self) -> int:
        return max(self.run) + 1

    def normal_equations(self, columns: Sequence[Array]) -> tuple[Array, Array]:
        """Gram matrices and data of columns (n_i, k) with the shared law beside them, run by run."""
        k = columns[0].shape[1] + self.shared[0].shape[1]
        gram, data = np.zeros((self.count, k, k)), np.zeros((self.count, k, self.series[0].shape[1]))
        for i, run in enumerate(self.run):
            clean = columns[i] - self.own[i] @ (self.own[i].T @ columns[i])
            both = np.hstack([clean, self.shared[i]])
            gram[run] += both.T @ both
            data[run] += both.T @ self.series[i]
        return gram, data

    def waved(self, columns: Sequence[Array]) -> _Waved:
        """The same of columns (n_i, 2 G) of which only pairs stand beside each other."""
        g, s, d = columns[0].shape[1] // 2, self.shared[0].shape[1], self.series[0].shape[1]
        out = _Waved(*(np.zeros((self.count, g, 2, k)) for k in (2, s, d)))
        for i, run in enumerate(self.run):
            clean = columns[i] - self.own[i] @ (self.own[i].T @ columns[i])
            cube = clean.reshape(-1, g, 2)
            for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
                out.pairs[run, :, a, b] += np.einsum("nf,nf->f", cube[:, :, a], cube[:, :, b])
            out.cross[run] += (clean.T @ self.shared[i]).reshape(g, 2, s)
            out.data[run] += (clean.T @ self.series[i]).reshape(g, 2, d)
        return out


def assess_repeatability(solution: Solution, rng: np.random.Generator, draws: int = N_DRAWS) -> Repeatability:
    """Along which axis the failure of a fitted law repeats from run to run."""
    law = model_projection(solution)
    runs = sorted({r.piece.run for r in law.responses})
    if len(runs) < 2:
        return Repeatability(
            words="One run cannot tell whether a failure repeats: film another one, best at another speed."
        )
    apart = _apart(law, runs, _drawn(law, rng, draws))
    found, curves, excess = [], {}, _excess(apart)
    likely, own = _likelihoods(solution)
    for axis in N_KNOTS:
        made, curves[axis] = _smooth([_fold(apart, axis, dry) for dry in (True, False)])
        if axis == "x":
            wave, rise = _wave(apart)
            made, likely[axis] = _better(made, wave), max(likely[axis], rise)
        found.append(replace(_judged(axis, made, excess), evidence=likely[axis] - own))
    phase = assess_common_frequency(law, runs, rng, draws)
    found.append(
        AxisRepeatability("phase", phase.share, phase.p, phase.runs, len(runs), phase.frequency, phase.evidence - own)
    )
    found = sort_axes(found)
    return Repeatability(found, describe_axes(found), curves)


def _likelihoods(solution: Solution) -> tuple[dict[str, float], float]:
    """Evidence for a smooth force over every axis, and for one of every run, over none at all."""
    left = compress_residual(solution)
    likely = dict.fromkeys(N_KNOTS, 0.0)
    for smooth in smooth_forces(left):
        name = smooth.axis.name
        likely[name] = max(likely.get(name, 0.0), smooth.gain)
    return likely, max(gain_of_separate_curves(left), 0.0)


def _apart(law: ModelProjection, runs: Sequence[int], series: Array) -> _Runs:
    """Every run beside what belongs to it alone."""
    layout = law.solution.problem.layout
    own, shared, left = [], [], []
    for rows, response in zip(law.rows, law.responses, strict=True):
        slots = [layout.slots[i] for i in response.active]
        mine = np.array([s.run is not None for s in slots], dtype=bool)
        q, upper = np.linalg.qr(response.jac[:, mine])
        q = q[:, np.abs(np.diag(upper)) > 1e-9 * max(float(np.linalg.norm(upper)), 1e-300)]
        own.append(q)
        shared.append(response.jac[:, ~mine] - q @ (q.T @ response.jac[:, ~mine]))
        left.append(series[rows] - q @ (q.T @ series[rows]))
    norm = np.sqrt(np.sum([np.sum(c**2, axis=0) for c in shared], axis=0))
    shared = [c / np.where(norm > 0, norm, 1.0) for c in shared]
    at = [motion_at_nodes(law.solution, r) for r in law.responses]
    return _Runs(law, at, [runs.index(r.piece.run) for r in law.responses], own, shared, left)


def _excess(apart: _Runs) -> Array:
    """Misfit of every run beyond its noise under the law of the other runs, at least its uncertainty, (R, D)."""
    gram, data = apart.normal_equations([np.zeros((len(c), 0)) for c in apart.shared])
    fold = _Fold(np.empty(0), gram, data)
    left, frames = np.zeros((apart.count, data.shape[2])), np.zeros((apart.count, 1))
    for run, series, own in zip(apart.run, apart.series, apart.own, strict=True):
        left[run] += np.einsum("nd,nd->d", series, series)
        frames[run] += len(series) - own.shape[1]
    left -= _gains(fold, _held(fold), 0)
    return np.asarray(np.maximum(left - frames, np.sqrt(2 * frames)))


def _drawn(law: ModelProjection, rng: np.random.Generator, draws: int) -> Array:
    """The residual, and draws in which every run keeps its misfit but nothing is common, (N + m, 1 + draws)."""
    out = np.zeros((len(law.r), 1 + draws))
    out[:, 0] = law.r
    for rows in law.rows:
        wave = dct(law.r[rows], norm="ortho")[:, None] * rng.choice([-1.0, 1.0], (rows.stop - rows.start, draws))
        out[rows, 1:] = idct(wave, axis=0, norm="ortho")
    out[:, 1:] -= law.u @ (law.u.T @ out[:, 1:])
    for rows in law.rows:
        left = np.linalg.norm(out[rows, 1:], axis=0)
        out[rows, 1:] *= np.linalg.norm(law.r[rows]) / np.maximum(left, 1e-300)
    return out


def _knots(apart: _Runs, axis: str) -> Array:
    if axis == "x":
        low, high = course_ends(apart.law.responses)
    elif axis == "t":
        low, high = min(float(n.t[0]) for n in apart.at), max(float(n.t[-1]) for n in apart.at)
    else:
        speeds = [np.abs(n.v) for n in apart.at]
        low, high = min(float(s.min()) for s in speeds), max(float(s.max()) for s in speeds)
    return np.linspace(low, high, N_KNOTS[axis])


def _fold(apart: _Runs, axis: str, dry: bool) -> _Fold:
    """A curve over an axis as every run sees it; a dry force goes with load, level and direction."""
    knots = _knots(apart, axis)
    made = []
    for response, n in zip(apart.law.responses, apart.at, strict=True):
        along = {"x": n.x, "t": n.t, "v": np.abs(n.v)}[axis]
        carried = n.dry_factor if dry else np.sign(n.dry_factor) if axis == "v" else np.ones_like(n.dry_factor)
        made.append(displacement_response(response, linear_interpolation_matrix(along, knots) * carried[:, None]))
    return _Fold(knots, *apart.normal_equations(made))


def _held(fold: _Fold) -> Array:
    """What holds the law of the other runs where they do not tell it: the law of all, (K + S, K + S)."""
    k = len(fold.knots)
    out = np.zeros(fold.gram.shape[1:])
    out[k:, k:] = MIN_LAW_WEIGHT * fold.gram.sum(axis=0)[k:, k:]
    out += 1e-12 * np.trace(out) * np.eye(len(out))
    return out


def _smooth(tried: Sequence[_Fold]) -> tuple[Array, dict[str, Array]]:
    """Fall of every run's chi-squared at the best of all smooth curves, (R, D), and that curve for the data."""
    best: Array | None = None
    curve: dict[str, Array] = {}
    for fold in tried:
        k = len(fold.knots)
        scale = float(np.trace(fold.gram.sum(axis=0)[:k, :k]) / k)
        for reach in CORRELATION_LENGTHS_KNOTS:
            prior = np.linalg.inv(matern_covariance(np.arange(float(k)), reach) + 1e-8 * np.eye(k))
            for size in PRIOR_SIZES:
                held = _held(fold)
                held[:k, :k] += prior * (scale / size**2)
                gains = _gains(fold, held, k)
                if best is None or gains[:, 0].sum() > best[:, 0].sum():
                    curve = _curve(fold, held)
                best = gains if best is None else _better(best, gains)
    return np.asarray(best), curve


def _better(one: Array, other: Array) -> Array:
    """The gains (R, D) of whichever gains more, for the data and for every draw."""
    return np.where(other.sum(axis=0) > one.sum(axis=0), other, one)


def _judged(axis: str, gains: Array, excess: Array) -> AxisRepeatability:
    """Share of the misfit that is foretold, its p among the draws, and in how many runs."""
    share = gains.sum(axis=0) / excess.sum(axis=0)
    p = float((1 + np.sum(share[1:] >= share[0])) / len(share))
    runs = int(np.sum(gains[:, 0] > MIN_PREDICTED_SHARE * excess[:, 0]))
    return AxisRepeatability(axis, float(np.clip(share[0], 0.0, 1.0)), p, runs, len(excess))


def _wave(apart: _Runs) -> tuple[Array, float]:
    """Fall of every run's chi-squared (R, D) with a dry force that waves over the place, all told by the other runs.

    And the evidence for such a wave in all of them.
    """
    f = 1 / spatial_periods(apart.law.solution.problem.layout.span)
    made = [wave_traces(r, n.x, f, n.dry_factor) for r, n in zip(apart.law.responses, apart.at, strict=True)]
    runs = apart.waved(made)
    gram, data = apart.normal_equations([np.zeros((len(c), 0)) for c in apart.shared])
    whole = _Waved(runs.pairs.sum(axis=0), runs.cross.sum(axis=0), runs.data.sum(axis=0))
    held, out = _held(_Fold(np.empty(0), gram, data)), np.zeros((apart.count, data.shape[2]))
    for run in range(apart.count):
        law, normal_equations = gram.sum(axis=0) - gram[run] + held, data.sum(axis=0) - data[run]
        cross = whole.cross - runs.cross[run]
        inverse = np.linalg.pinv(law, rcond=1e-10, hermitian=True)
        bent = np.einsum("st,git->sgi", inverse, cross)  # what the law takes up of every column, (S, G, 2)
        pairs = whole.pairs - runs.pairs[run] - np.einsum("gis,sgj->gij", cross, bent)
        left = whole.data - runs.data[run] - np.einsum("sgi,sd->gid", bent, normal_equations)
        size = np.linalg.pinv(pairs, rcond=1e-6, hermitian=True) @ left
        best = np.argmax(np.sum(size * left, axis=1), axis=0)
        mine = _Waved(runs.pairs[run], runs.cross[run], runs.data[run])
        out[run] = _told_by(mine, (gram[run], data[run]), (inverse @ normal_equations, bent), size, best)
    return out, restricted_likelihood_gain(_best_wave(whole, gram.sum(axis=0) + held, data.sum(axis=0)), 2, len(f))


def _best_wave(whole: _Waved, law: Array, normal_equations: Array) -> float:
    """Fall of chi-squared with the best of all waves beside the law (S, S), for the data alone."""
    bent = np.einsum("st,git->sgi", np.linalg.pinv(law, rcond=1e-10, hermitian=True), whole.cross)
    pairs = whole.pairs - np.einsum("gis,sgj->gij", whole.cross, bent)
    left = whole.data[:, :, 0] - np.einsum("sgi,s->gi", bent, normal_equations[:, 0])
    return float(np.max(np.einsum("gi,gij,gj->g", left, np.linalg.pinv(pairs, rcond=1e-6, hermitian=True), left)))


def _told_by(mine: _Waved, own: tuple[Array, Array], law: tuple[Array, Array], size: Array, best: Array) -> Array:
    """Fall of one run's chi-squared (D,) with the wave that is best for the other runs, each draw its own.

    `own` are the Gram matrix and data of its law, `law` the coefficients of the other runs' and what it takes up.
    """
    (gram, data), (before, bent) = own, law
    each = np.arange(data.shape[1])
    c = size[best, :, each]  # (D, 2)
    moved = before - np.einsum("sdi,di->sd", bent[:, best], c)
    fall = _fall(gram, data, moved) - _fall(gram, data, before)
    fall += 2 * np.einsum("di,di->d", c, mine.data[best, :, each])
    fall -= np.einsum("di,dij,dj->d", c, mine.pairs[best], c)
    return np.asarray(fall - 2 * np.einsum("di,dis,sd->d", c, mine.cross[best], moved))


def _gains(fold: _Fold, held: Array, knots: int) -> Array:
    """Fall of every run's chi-squared with curve and law of the other runs, over that with their law alone, (R, D).

    Without knots, over the law of all runs.
    """
    gram, data = fold.gram.sum(axis=0) + held, fold.data.sum(axis=0)
    out = np.zeros((len(fold.gram), data.shape[1]))
    law = slice(knots, None)
    for run, (g, b) in enumerate(zip(fold.gram, fold.data, strict=True)):
        c = np.linalg.solve(gram - g, data - b)
        out[run] = _fall(g, b, c)
        if knots and c.shape[0] > knots:
            bare = np.linalg.solve((gram - g)[law, law], (data - b)[law])
            out[run] -= _fall(g[law, law], b[law], bare)
    return out


def _fall(gram: Array, data: Array, c: Array) -> Array:
    """Fall of chi-squared with coefficients c (K, D), (D,)."""
    return np.asarray(2 * np.einsum("kd,kd->d", c, data) - np.einsum("kd,kd->d", c, gram @ c))


def _curve(fold: _Fold, held: Array) -> dict[str, Array]:
    """The common curve of all runs, N, with its standard deviation."""
    inverse = np.linalg.inv(fold.gram.sum(axis=0) + held)
    force, k = inverse @ fold.data.sum(axis=0)[:, 0], len(fold.knots)
    return {"at": fold.knots, "F": force[:k], "sigma_F": np.sqrt(np.maximum(np.diag(inverse)[:k], 0.0))}
