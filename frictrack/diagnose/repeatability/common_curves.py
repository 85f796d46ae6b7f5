"""Test whether a misfit repeats at the same place, time since release or speed, or with the same frequency.

For every axis, a common curve is fitted to the other runs, and the share of a run's misfit that it predicts is
computed. The curve is a smooth force; over the place also a wave. It is compared through its trace in the displacement,
where the noise is white, with everything projected out that the model could absorb.

Null distribution: the signs of every run's residual are drawn at random in a cosine basis, which keeps its misfit and
noise but nothing common; for the phase, every run is given another frequency.

The axis is chosen by likelihood: of a smooth force over the axis (over the place also a wave) against a smooth force of
its own in every run. Other runs predict little if few of them show the misfit; the likelihood uses all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.fft import dct, idct

from frictrack.compare import ForceTraces, WaveScan, WaveTraces, course_ends, pair_products
from frictrack.diagnose.repeatability.axis_result import AxisRepeatability, describe_axes, sort_axes
from frictrack.diagnose.repeatability.common_frequency import (
    MIN_PREDICTED_SHARE,
    assess_common_frequency,
    restricted_likelihood_gain,
)
from frictrack.diagnose.smooth_forces import ResidualForces, gain_of_separate_curves
from frictrack.fit.least_squares import ModelProjection, Solution, model_projection
from frictrack.fit.smooth_functions import linear_interpolation_matrix, matern_covariance
from frictrack.records import Array

N_DRAWS = 199
N_KNOTS = {"x": 120, "t": 80, "v": 40}
CORRELATION_LENGTHS_KNOTS = (2.0, 6.0, 20.0)  # in knots
PRIOR_SIZES = (0.3, 3.0, 30.0)  # amplitudes over the smallest that the runs show
MIN_SHARED_NORM = 1e-9  # of a column of the model, below which it lies within what each run has of its own
MIN_MODEL_WEIGHT = 0.03  # weight of all runs' information on the model in predictions from other runs


@dataclass(frozen=True)
class Repeatability:
    """Result over all axes, best first, as sentences, and the common curve over every axis, (k,) each."""

    axes: list[AxisRepeatability] = field(default_factory=list)
    words: str = ""
    curves: dict[str, dict[str, Array]] = field(default_factory=dict)

    @property
    def best(self) -> AxisRepeatability | None:
        """The axis over which the misfit repeats; None if it does not."""
        return next((a for a in self.axes if a.holds), None)

    def summary(self) -> list[dict[str, Any]]:
        """Return the JSON `repeats`."""
        return [a.summary() for a in self.axes]


@dataclass(frozen=True)
class _CurveProducts:
    """Products of a curve through K knots and of the S shared columns of the model, by run.

    Gram matrices (R, K + S, K + S) and data (R, K + S, D), D = 1 + draws.
    """

    knots: Array
    gram: Array
    data: Array

    def model_alone(self) -> _CurveProducts:
        """The products of the shared columns of the model, without a curve."""
        k = len(self.knots)
        return _CurveProducts(np.empty(0), self.gram[:, k:, k:], self.data[:, k:])


@dataclass(frozen=True)
class _WaveProducts:
    """Gram matrices of G waves (..., G, 2, 2), products with the model (..., G, 2, S) and with data (..., G, 2, D)."""

    pairs: Array
    cross: Array
    data: Array


@dataclass(frozen=True)
class _Runs:
    """Residuals and shared columns of every run, with what belongs to the run alone projected out (level, phases).

    `series` (n_i, D) and `shared` (n_i, S) by piece; `own` (n_i, k) orthonormal; `run` is the index of the run.
    """

    law: ModelProjection
    maps: list[ForceTraces]
    run: list[int]
    own: list[Array]
    shared: list[Array]
    series: list[Array]

    @property
    def count(self) -> int:
        return max(self.run) + 1

    def normal_equations(self, columns: Sequence[Array]) -> tuple[Array, Array]:
        """Gram matrices and data by run of columns (n_i, k) and the shared columns."""
        k = columns[0].shape[1] + self.shared[0].shape[1]
        gram, data = np.zeros((self.count, k, k)), np.zeros((self.count, k, self.series[0].shape[1]))
        for i, run in enumerate(self.run):
            clean = columns[i] - self.own[i] @ (self.own[i].T @ columns[i])
            both = np.hstack([clean, self.shared[i]])
            gram[run] += both.T @ both
            data[run] += both.T @ self.series[i]
        return gram, data

    def wave_products(self, waves: WaveTraces) -> _WaveProducts:
        """The same for waves, of which only sine and cosine of one frequency are combined."""
        g, s, d = len(waves.f), self.shared[0].shape[1], self.series[0].shape[1]
        out = _WaveProducts(*(np.zeros((self.count, g, 2, k)) for k in (2, s, d)))
        for i, run in enumerate(self.run):
            own = self.own[i].astype(np.float32)
            clean = waves.of_pieces[i] - (waves.of_pieces[i] @ own) @ own.T
            out.pairs[run] += pair_products(clean)
            both = np.hstack([self.shared[i], self.series[i]]).astype(np.float32)
            products = (clean.reshape(2 * g, -1) @ both).reshape(2, g, s + d).transpose(1, 0, 2)
            out.cross[run] += products[:, :, :s]
            out.data[run] += products[:, :, s:]
        return out


def assess_repeatability(
    solution: Solution,
    rng: np.random.Generator,
    draws: int = N_DRAWS,
    waves: WaveScan | None = None,
    forces: ResidualForces | None = None,
) -> Repeatability:
    """Test over which axis the misfit of a fit repeats from run to run.

    Parameters
    ----------
    solution
        The fit.
    rng
        Random generator.
    draws
        Number of draws of the null distribution.
    waves
        Traces of the waves that are scanned for, if they were computed before.
    forces
        Smooth forces in the residual, if they were computed before.

    Returns
    -------
    Repeatability

    """
    waves = waves or WaveScan(solution)
    law = model_projection(solution)
    runs = sorted({r.piece.run for r in law.responses})
    if len(runs) < 2:
        return Repeatability(
            words="One run cannot show whether the misfit repeats: film another one, best at another speed."
        )
    projected = _project_own_columns(law, waves.traces, _draw_sign_flips(law, rng, draws))
    found, curves, excess = [], {}, _excess_chi2(projected)
    evidence, separate_evidence = _axis_evidence(forces or ResidualForces(solution))
    for axis in N_KNOTS:
        gains, curves[axis] = _best_smooth_curve([_curve_products(projected, axis, dry) for dry in (True, False)])
        if axis == "x":
            wave, wave_evidence = _best_wave_gains(projected, waves.in_place)
            gains, evidence[axis] = _larger_gains(gains, wave), max(evidence[axis], wave_evidence)
        explained = evidence[axis] / separate_evidence if separate_evidence > 0 else 0.0
        result = _axis_result(axis, gains, excess)
        found.append(replace(result, evidence=evidence[axis] - separate_evidence, explained=explained))
    phase = assess_common_frequency(law, waves.in_time, rng, draws)
    found.append(
        AxisRepeatability(
            "phase", phase.share, phase.p, phase.runs, len(runs), phase.frequency, phase.evidence - separate_evidence
        )
    )
    found = sort_axes(found)
    return Repeatability(found, describe_axes(found), curves)


def _axis_evidence(forces: ResidualForces) -> tuple[dict[str, float], float]:
    """Evidence for a smooth force over every axis, and for one per run, against none."""
    evidence = dict.fromkeys(N_KNOTS, 0.0)
    for smooth in forces.smooth:
        name = smooth.axis.name
        evidence[name] = max(evidence.get(name, 0.0), smooth.gain)
    return evidence, max(gain_of_separate_curves(forces.compressed), 0.0)


def _project_own_columns(law: ModelProjection, maps: list[ForceTraces], series: Array) -> _Runs:
    """Project out of every run what belongs to it alone."""
    layout, runs = law.solution.problem.layout, sorted({r.piece.run for r in law.responses})
    own_columns, shared, residuals, norms = [], [], [], []
    for rows, response in zip(law.rows, law.responses, strict=True):
        slots = [layout.slots[i] for i in response.active]
        per_run = np.array([s.run is not None for s in slots], dtype=bool)
        q, upper = np.linalg.qr(response.jac[:, per_run])
        q = q[:, np.abs(np.diag(upper)) > 1e-9 * max(float(np.linalg.norm(upper)), 1e-300)]
        own_columns.append(q)
        shared.append(response.jac[:, ~per_run] - q @ (q.T @ response.jac[:, ~per_run]))
        residuals.append(series[rows] - q @ (q.T @ series[rows]))
        norms.append([np.linalg.norm(c, axis=0) for c in (response.jac[:, ~per_run], shared[-1])])
    whole, norm = np.linalg.norm(norms, axis=0)
    kept = norm > MIN_SHARED_NORM * whole  # the others are rounding errors, such as a coefficient beside its levels
    shared = [c[:, kept] / norm[kept] for c in shared]
    return _Runs(law, maps, [runs.index(r.piece.run) for r in law.responses], own_columns, shared, residuals)


def _excess_chi2(projected: _Runs) -> Array:
    """Misfit of every run above its noise under the model of the other runs, at least its uncertainty, (R, D)."""
    gram, data = projected.normal_equations([np.zeros((len(c), 0)) for c in projected.shared])
    products = _CurveProducts(np.empty(0), gram, data)
    misfit, frames = np.zeros((projected.count, data.shape[2])), np.zeros((projected.count, 1))
    for run, series, own in zip(projected.run, projected.series, projected.own, strict=True):
        misfit[run] += np.einsum("nd,nd->d", series, series)
        frames[run] += len(series) - own.shape[1]
    misfit -= _falls(products, _model_prior(products))
    return np.asarray(np.maximum(misfit - frames, np.sqrt(2 * frames)))


def _draw_sign_flips(law: ModelProjection, rng: np.random.Generator, draws: int) -> Array:
    """The residual, and draws in which every run keeps its misfit but nothing is common, (N + m, 1 + draws)."""
    out = np.zeros((len(law.r), 1 + draws))
    out[:, 0] = law.r
    for rows in law.rows:
        wave = dct(law.r[rows], norm="ortho")[:, None] * rng.choice([-1.0, 1.0], (rows.stop - rows.start, draws))
        out[rows, 1:] = idct(wave, axis=0, norm="ortho")
    out[:, 1:] -= law.u @ (law.u.T @ out[:, 1:])
    for rows in law.rows:
        norms = np.linalg.norm(out[rows, 1:], axis=0)
        out[rows, 1:] *= np.linalg.norm(law.r[rows]) / np.maximum(norms, 1e-300)
    return out


def _knots(projected: _Runs, axis: str) -> Array:
    if axis == "x":
        low, high = course_ends(projected.law.responses)
    elif axis == "t":
        low, high = min(float(q.t[0]) for q in projected.maps), max(float(q.t[-1]) for q in projected.maps)
    else:
        speeds = [np.abs(q.v) for q in projected.maps]
        low, high = min(float(s.min()) for s in speeds), max(float(s.max()) for s in speeds)
    return np.linspace(low, high, N_KNOTS[axis])


def _curve_products(projected: _Runs, axis: str, dry: bool) -> _CurveProducts:
    """Products of a curve over an axis; a dry force goes with load, level and direction."""
    knots = _knots(projected, axis)
    columns = []
    for traces in projected.maps:
        values = {"x": traces.x, "t": traces.t, "v": np.abs(traces.v)}[axis]
        factor = traces.dry_factor if dry else np.sign(traces.dry_factor) if axis == "v" else 1.0
        columns.append(traces(linear_interpolation_matrix(values, knots).T * factor).T)
    return _CurveProducts(knots, *projected.normal_equations(columns))


def _model_prior(products: _CurveProducts) -> Array:
    """Prior that keeps the model of the other runs near that of all where they do not determine it, (K + S, K + S)."""
    k = len(products.knots)
    out = np.zeros(products.gram.shape[1:])
    out[k:, k:] = MIN_MODEL_WEIGHT * products.gram.sum(axis=0)[k:, k:]
    out += 1e-12 * np.trace(out) * np.eye(len(out))
    return out


def _best_smooth_curve(tried: Sequence[_CurveProducts]) -> tuple[Array, dict[str, Array]]:
    """Fall of every run's chi-squared with the best smooth curve, (R, D), and that curve for the data."""
    best: Array | None = None
    curve: dict[str, Array] = {}
    for products in tried:
        k = len(products.knots)
        bare = _falls(products.model_alone(), _model_prior(products)[k:, k:])
        scale = float(np.trace(products.gram.sum(axis=0)[:k, :k]) / k)
        for reach in CORRELATION_LENGTHS_KNOTS:
            precision = np.linalg.inv(matern_covariance(np.arange(float(k)), reach) + 1e-8 * np.eye(k))
            for size in PRIOR_SIZES:
                prior = _model_prior(products)
                prior[:k, :k] += precision * (scale / size**2)
                gains = _falls(products, prior) - bare
                if best is None or gains[:, 0].sum() > best[:, 0].sum():
                    curve = _curve(products, prior)
                best = gains if best is None else _larger_gains(best, gains)
    return np.asarray(best), curve


def _larger_gains(one: Array, other: Array) -> Array:
    """The larger of two gains (R, D), for the data and for every draw."""
    return np.where(other.sum(axis=0) > one.sum(axis=0), other, one)


def _axis_result(axis: str, gains: Array, excess: Array) -> AxisRepeatability:
    """Share of the misfit predicted, its p-value, and the number of runs."""
    share = gains.sum(axis=0) / excess.sum(axis=0)
    p = float((1 + np.sum(share[1:] >= share[0])) / len(share))
    runs = int(np.sum(gains[:, 0] > MIN_PREDICTED_SHARE * excess[:, 0]))
    return AxisRepeatability(axis, float(np.clip(share[0], 0.0, 1.0)), p, runs, len(excess))


def _best_wave_gains(projected: _Runs, waves: WaveTraces) -> tuple[Array, float]:
    """Fall of chi-squared (R, D) with a dry force periodic in place, fitted to the other runs; and its evidence."""
    runs = projected.wave_products(waves)
    gram, data = projected.normal_equations([np.zeros((len(c), 0)) for c in projected.shared])
    total = _WaveProducts(runs.pairs.sum(axis=0), runs.cross.sum(axis=0), runs.data.sum(axis=0))
    prior, out = _model_prior(_CurveProducts(np.empty(0), gram, data)), np.zeros((projected.count, data.shape[2]))
    for run in range(projected.count):
        law, data_of_others = gram.sum(axis=0) - gram[run] + prior, data.sum(axis=0) - data[run]
        cross = total.cross - runs.cross[run]
        inverse = np.linalg.pinv(law, rcond=1e-10, hermitian=True)
        absorbed = np.einsum("st,git->sgi", inverse, cross)  # what the law takes up of every column, (S, G, 2)
        pairs = total.pairs - runs.pairs[run] - np.einsum("gis,sgj->gij", cross, absorbed)
        right_side = total.data - runs.data[run] - np.einsum("sgi,sd->gid", absorbed, data_of_others)
        size = np.linalg.pinv(pairs, rcond=1e-6, hermitian=True) @ right_side
        best = np.argmax(np.sum(size * right_side, axis=1), axis=0)
        own_products = _WaveProducts(runs.pairs[run], runs.cross[run], runs.data[run])
        out[run] = _predicted_gain(
            own_products, (gram[run], data[run]), (inverse @ data_of_others, absorbed), size, best
        )
    return out, restricted_likelihood_gain(
        _best_wave(total, gram.sum(axis=0) + prior, data.sum(axis=0)), 2, len(waves.f)
    )


def _best_wave(total: _WaveProducts, law: Array, data: Array) -> float:
    """Fall of chi-squared of the data with the best of all waves, model included (S, S)."""
    absorbed = np.einsum("st,git->sgi", np.linalg.pinv(law, rcond=1e-10, hermitian=True), total.cross)
    pairs = total.pairs - np.einsum("gis,sgj->gij", total.cross, absorbed)
    right_side = total.data[:, :, 0] - np.einsum("sgi,s->gi", absorbed, data[:, 0])
    return float(
        np.max(np.einsum("gi,gij,gj->g", right_side, np.linalg.pinv(pairs, rcond=1e-6, hermitian=True), right_side))
    )


def _predicted_gain(
    own_products: _WaveProducts, own: tuple[Array, Array], law: tuple[Array, Array], size: Array, best: Array
) -> Array:
    """Fall of one run's chi-squared (D,) with the wave that is best for the other runs, for each draw.

    `own` are the Gram matrix and data of its model, `law` the coefficients of the other runs' model and what it
    absorbs.
    """
    (gram, data), (coefficients, absorbed) = own, law
    each = np.arange(data.shape[1])
    c = size[best, :, each]  # (D, 2)
    shifted = coefficients - np.einsum("sdi,di->sd", absorbed[:, best], c)
    fall = _chi2_fall(gram, data, shifted) - _chi2_fall(gram, data, coefficients)
    fall += 2 * np.einsum("di,di->d", c, own_products.data[best, :, each])
    fall -= np.einsum("di,dij,dj->d", c, own_products.pairs[best], c)
    return np.asarray(fall - 2 * np.einsum("di,dis,sd->d", c, own_products.cross[best], shifted))


def _falls(products: _CurveProducts, prior: Array) -> Array:
    """Fall of every run's chi-squared with curve and model of the other runs, (R, D)."""
    gram, data = products.gram, products.data
    c = np.linalg.solve(gram.sum(axis=0) + prior - gram, data.sum(axis=0) - data)
    return np.asarray(np.einsum("rkd,rkd->rd", c, 2 * data - gram @ c))


def _chi2_fall(gram: Array, data: Array, c: Array) -> Array:
    """Fall of chi-squared with coefficients c (K, D), (D,)."""
    return np.asarray(2 * np.einsum("kd,kd->d", c, data) - np.einsum("kd,kd->d", c, gram @ c))


def _curve(products: _CurveProducts, prior: Array) -> dict[str, Array]:
    """The common curve of all runs, N, with its standard deviation."""
    inverse = np.linalg.inv(products.gram.sum(axis=0) + prior)
    force, k = inverse @ products.data.sum(axis=0)[:, 0], len(products.knots)
    return {"at": products.knots, "F": force[:k], "sigma_F": np.sqrt(np.maximum(np.diag(inverse)[:k], 0.0))}
