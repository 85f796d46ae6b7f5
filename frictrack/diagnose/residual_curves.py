"""Curves of a residual for figures and files: along every run, and the missing force with its mean over each axis.

Of the missing force, local forces (Gaussian bumps), one wave over the place, or one sinusoid in time describe what they
can; what they leave of the residual is a smooth force of its own in every run (see `smooth_forces`). The part of a slow
force that the model can absorb is not determined by any run, and not in the band. Where neither a wave nor a sinusoid
describes the force, the curve is the one of least absolute value among those that differ by what the model can absorb:
a local force stays local, and a smooth one is centred.

References
----------
Bloomfield & Steiger (1983), Least Absolute Deviations.
DerSimonian & Laird (1986), Control. Clin. Trials 7, 177-188.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from frictrack.base.errors import result_or_none
from frictrack.diagnose.compare import LocalForces, continue_search, find_local_forces, start_search
from frictrack.diagnose.compressed import CompressedResidual, compress_residual, separate_curves
from frictrack.diagnose.effect_description import FittedEffect
from frictrack.diagnose.repeatability import (
    Repeatability,
    SpectralLine,
    WaveScan,
    assess_repeatability,
    place_wave,
    sine_cosine,
)
from frictrack.effects import Path
from frictrack.fit.least_squares import PieceResponse, Solution, position_and_velocity, refine
from frictrack.fit.linearised import linearise
from frictrack.fit.observations import MeasuredFrictionPiece, keep_compared_frames
from frictrack.records import Array
from frictrack.results.candidates import AXES

ALPHA = 0.01  # significance level of a wave
N_REWEIGHTED = 40  # steps of iteratively reweighted least squares
MIN_RELATIVE_FORCE = 1e-5  # of the largest force, below which all count alike
MIN_FREE_SCATTER = 2e-3  # relative scatter of the friction levels, above which the model may shift them

_Columns = Callable[[int, Path], Array]  # forces of known form along the path of piece i, N per unit of size, (m, k)
N_POINTS = 161  # of a common curve
SMOOTHING_WIDTH = 1 / 80  # of the axis
MIN_WEIGHT_SHARE = 0.2  # of the median number of frames near a point of a run's range, for the run to count there
MAX_SAMPLES_PER_RUN, MAX_SAMPLES = 300, 40_000  # of a figure; a panel of a page shows no more


@dataclass(frozen=True)
class DeconvolvedForce:
    """The missing force along one piece, all (n,).

    Parameters
    ----------
    run
        Index of the run among the fitted ones.
    t, x, v, a
        Time since release s, and the motion in m, m/s, m/s^2.
    F, sigma_F
        Force and its standard deviation, N.
    load
        Mean normal load over that of the reference run.

    """

    run: int
    t: Array
    x: Array
    v: Array
    a: Array
    F: Array
    sigma_F: Array
    load: float = 1.0


def deconvolve_force(
    found: LocalForces, waves: WaveScan, compressed: CompressedResidual
) -> tuple[list[DeconvolvedForce], SpectralLine | None]:
    """Deconvolve the force that a fitted model lacks.

    `found`: the local forces in the residual of the fit; `waves`: the scan for waves in that residual; `compressed`:
    that residual about the measured motion. Returns `pieces`, the missing force of every piece; `line`, the sinusoid
    that defines the phase: the model's own vibration, else the strongest in the residual.
    """
    known_frequency = _vibration(found.solution)
    line = waves.line(known_frequency)
    wave = _wave_columns(found, waves, line if known_frequency is None else None)
    columns = wave or _bump_columns(found)
    traces = compressed.traces_of(np.concatenate([columns(i, path) for i, path in enumerate(compressed.paths)]))
    precision = np.zeros(traces.shape[1])
    if wave is None:
        precision[2::3] = 1.0  # a width that the runs do not determine is known within a factor of e
    covariance = np.linalg.pinv(traces.T @ traces + np.diag(precision), hermitian=True)
    sizes, curves = covariance @ (traces.T @ compressed.residual), separate_curves(compressed, traces)
    means, variances = [], []
    for i, (response, along) in enumerate(zip(found.solution.responses, found.model.pieces, strict=True)):
        piece = response.piece
        form = columns(i, piece.at_frames(*position_and_velocity(response), along.path_level))
        mean, variance = curves.at(piece.run, piece.t)
        means.append(mean + form @ sizes)
        variances.append(variance + np.einsum("nk,kl,nl->n", form, covariance, form))
    if wave is None:
        means = _least_absolute(means, found.model.solution)
    pieces = zip(found.solution.responses, means, variances, strict=True)
    return [_deconvolved_piece(response, mean, variance) for response, mean, variance in pieces], line


def _vibration(solution: Solution) -> float | None:
    """Frequency of the model's first vibration, Hz; None if it has none."""
    values, _ = solution.problem.layout.values(solution.p, solution.problem.pieces[0].run)
    return next((q["frequency"] for name, q in values.items() if name.startswith("vibration")), None)


def _wave_columns(found: LocalForces, waves: WaveScan, line: SpectralLine | None) -> _Columns | None:
    """The significant wave, over the place or in time, that explains more than the bumps do."""
    in_place, in_time = waves.in_place, None if line is None else waves.in_time
    gain_in_time = 0.0 if in_time is None else float(in_time.gains.max())
    if in_place is not None and in_place.p < ALPHA and in_place.gains.max() > max(found.explained, gain_in_time):
        frequency = float(in_place.f[in_place.best])
        return lambda _, path: place_wave(path, frequency)
    if line is not None and in_time is not None and in_time.p < ALPHA and gain_in_time > found.explained:
        runs, of = list(line.amplitudes), [r.piece.run for r in found.solution.responses]
        return lambda i, path: np.kron(np.eye(len(runs))[runs.index(of[i])], sine_cosine(line.frequency * path.t))
    return None


def _bump_columns(found: LocalForces) -> _Columns:
    """The bumps found: by size, relative to it by centre and by log width."""

    def columns(i: int, path: Path) -> Array:
        out = np.zeros((len(found.bumps), 3, len(path.t)))
        for k, bump in enumerate(found.bumps):
            if bump.acts_in(found.solution.responses[i].piece.run):
                out[k] = bump.derivatives(path) * np.array([[1.0], [bump.size], [bump.size]])
        return out.reshape(-1, len(path.t)).T

    return columns


def _least_absolute(forces: list[Array], solution: Solution) -> list[Array]:
    """Subtract from forces (n,) per piece what the model can absorb, so that the sum of absolute values is least."""
    free = [slot.run is None or solution.tau > MIN_FREE_SCATTER for slot in solution.problem.layout.slots]
    columns = np.vstack([_force_sensitivities(solution, response)[:, free] for response in solution.responses])
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 0] / size[size > 0]
    force = np.concatenate(forces)
    left, floor = force, MIN_RELATIVE_FORCE * float(np.max(np.abs(force), initial=1e-12))
    for _ in range(N_REWEIGHTED):
        weighted = columns / np.sqrt(np.abs(left) + floor)[:, None]
        right = weighted.T @ (force / np.sqrt(np.abs(left) + floor))
        left = force - columns @ np.linalg.lstsq(weighted.T @ weighted, right, rcond=1e-8)[0]
    return np.split(left, np.cumsum([len(f) for f in forces])[:-1])


def _force_sensitivities(solution: Solution, response: PieceResponse) -> Array:
    """Friction force at the frames of a piece per unit of every unknown, N, (n, P)."""
    piece = response.piece
    at_nodes = -piece.mass * solution.problem.acceleration_sensitivities(piece, solution.p, response.motion)
    out = np.zeros((len(piece.t), len(solution.p)))
    out[:, response.active] = np.column_stack([np.interp(piece.t, piece.panels.t, column) for column in at_nodes.T])
    return out


def _deconvolved_piece(response: PieceResponse, mean: Array, variance: Array) -> DeconvolvedForce:
    piece = response.piece
    x, v = position_and_velocity(response)
    measured = isinstance(piece, MeasuredFrictionPiece)
    a = np.gradient(v, piece.t) if measured else np.interp(piece.t, piece.panels.t, response.motion.a)
    return DeconvolvedForce(piece.run, piece.t, x, v, a, mean, np.sqrt(variance), float(np.mean(piece.path.load)))


@dataclass(frozen=True, eq=False)
class FailurePattern:
    """Whether the misfit of a fit repeats, and the curves that show it; each is computed when it is first asked for.

    Parameters
    ----------
    fit
        The fit, with the frames that are compared.
    rng
        Random generator.
    explained
        The fit with effects that explain everything; None if there are none.

    """

    fit: Solution
    rng: np.random.Generator
    explained: Solution | None = None

    @cached_property
    def local(self) -> LocalForces:
        """The local forces in the residual of the fit, or of the model with the parameters of `explained`."""
        known = None if self.explained is None else _with_parameters_of(self.explained, self.fit)
        return find_local_forces(self.fit) if known is None else continue_search(start_search(linearise(known)))

    @cached_property
    def repeats(self) -> Repeatability:
        """Whether the misfit repeats from run to run, and over which axis."""
        return assess_repeatability(self._compressed, self._waves, self.rng)

    @cached_property
    def figures(self) -> dict[str, dict[str, Array]]:
        """Curves of the missing force; see `residual_figures`."""
        best = self.repeats.best
        pieces, line = deconvolve_force(self.local, self._waves, self._compressed)
        return residual_figures(pieces, line, "x" if best is None else best.axis)

    @cached_property
    def _compressed(self) -> CompressedResidual:
        """The residual in which the local forces were found."""
        return compress_residual(self.local.solution, about_measurement=True)

    @cached_property
    def _waves(self) -> WaveScan:
        return WaveScan(self.local.model)


def find_failure_pattern(
    solution: Solution, rng: np.random.Generator, explained: Solution | None = None
) -> FailurePattern:
    """Find what the misfit of a fit has in common from run to run; see `FailurePattern`."""
    fit = keep_compared_frames(solution)
    return FailurePattern(fit, rng, explained if fit is solution else None)


def _with_parameters_of(explained: Solution, solution: Solution) -> Solution | None:
    """The model of a fit with the parameters of a larger one, which no misfit moved; None where that lacks some."""
    names, values = solution.problem.layout.names, dict(zip(explained.problem.layout.names, explained.p, strict=True))
    if not set(names) <= values.keys() or len(explained.responses) != len(solution.responses):
        return None
    p, tau = np.array([values[name] for name in names]), explained.tau_of_other_runs
    # none if without these effects no motion can be integrated
    return result_or_none(refine, solution.problem, p, explained.starts, tau=tau, max_steps=0)


def residual_series(before: Solution, after: Solution | None, effects: Sequence[str]) -> dict[str, Array]:
    """Residual of a model and of the model with the effects found, for figures and files.

    `after`: the fit with the effects found; None if none was found. Returns one row per sample of all runs, all (n,):
    `run` (index), `t` since release (s), `x` (m) and `v` along the motion (m/s) of the model; `before`, the residual,
    and `sigma`, its noise (m, or N for measured friction). With effects found also `after`, the residual with them, and
    `F`, the force that they add against the motion (N).
    """
    sizes = [len(r.piece.t) for r in before.responses]
    wanted = min(len({r.piece.run for r in before.responses}) * MAX_SAMPLES_PER_RUN, MAX_SAMPLES)
    kept = slice(None, None, max(1, -(-sum(sizes) // wanted)))

    def joined(of: Callable[[PieceResponse], Array], solution: Solution) -> Array:
        return np.concatenate([np.broadcast_to(of(r), r.piece.t.shape)[kept] for r in solution.responses])

    out = {
        "run": joined(lambda r: np.array(float(r.piece.run)), before),
        "t": joined(lambda r: r.piece.t, before),
        "x": joined(lambda r: position_and_velocity(r)[0], before),
        "v": joined(lambda r: np.abs(position_and_velocity(r)[1]), before),
        "before": joined(lambda r: r.piece.y - r.model_y, before),
        "sigma": joined(lambda r: np.asarray(r.piece.noise), before),
    }
    if after is not None and sizes == [len(r.piece.t) for r in after.responses]:
        out["after"] = joined(lambda r: r.piece.y - r.model_y, after)
        direction = joined(lambda r: np.where(position_and_velocity(r)[1] < 0, -1.0, 1.0), after)
        fitted = [FittedEffect(name, after) for name in effects]
        forces = [np.concatenate([b[kept] for b in one.blocks]) for one in fitted if one.effect.acts_on == "force"]
        if not after.problem.simulates:  # of a load cell: an effect also takes over what others had imitated
            forces = [out["before"] - out["after"]]
        out["F"] = direction * np.sum(forces, axis=0) if forces else np.zeros_like(direction)
    return out


def residual_figures(
    pieces: list[DeconvolvedForce], line: SpectralLine | None, axis: str = "x"
) -> dict[str, dict[str, Array]]:
    """Curves of the missing force for plots and files.

    `pieces`: the deconvolved force of every piece; `line`: the sinusoid that defines the phase; None without; `axis`:
    the axis over which the misfit repeats: there runs are compared with and without their load. Returns
    `residual_force`: run (index), t, x, phase (cycles), v and a (along the motion, so v is the speed), F and sigma_F
    (N, positive against the motion), all (n,); `common_x` and so on: mean curve of all runs over an axis, `at`, F,
    sigma_F, (k,). If runs agree better in the force over the load, `residual_force` has the load (over that of the
    reference run), and the mean curves are forces at the reference load.
    """
    frames = [_run_series(p, line) for p in pieces]
    series = {name: np.concatenate([f[name] for f in frames]) for name in frames[0]}
    load = series.pop("load")
    plain, per_load = (_scatter(series, axis, factor) for factor in (np.ones_like(load), load))
    if per_load < plain:
        series["load"] = load
    divisor = series.get("load", np.ones_like(load))
    out = {"residual_force": series}
    for name in AXES:
        if name in series:
            mean = mean_curve(series["run"], series[name], series["F"] / divisor, series["sigma_F"] / divisor)
            out[f"common_{name}"] = mean
    if line is not None:
        series["frequency"] = np.array([line.frequency])
    return out


def _scatter(series: dict[str, Array], axis: str, divisor: Array) -> float:
    """Mean chi-squared between the runs over an axis of the force over a divisor."""
    if axis not in series:
        return 0.0
    return _pooled_curve(series["run"], series[axis], series["F"] / divisor, series["sigma_F"] / divisor)[1]


def _run_series(piece: DeconvolvedForce, line: SpectralLine | None) -> dict[str, Array]:
    """Series of one piece, with signs along the motion."""
    direction = np.where(piece.v < 0, -1.0, 1.0)
    out = {"run": np.full(len(piece.t), float(piece.run)), "t": piece.t, "x": piece.x}
    out |= {"v": direction * piece.v, "a": direction * piece.a}
    if line is not None:
        out["phase"] = (line.phase(piece.run, piece.t) + np.where(direction < 0, 0.5, 0.0)) % 1.0
    return out | {"F": direction * piece.F, "sigma_F": piece.sigma_F, "load": np.full(len(piece.t), piece.load)}


def mean_curve(run: Array, axis: Array, force: Array, sigma: Array) -> dict[str, Array]:
    """Mean curve of all runs over an axis.

    Each run is smoothed by itself. Runs differ by their noise and by a scatter that is estimated at every place, so the
    band shows how well they agree.

    `run`: index of the run of every frame, (n,); `axis`: values of the axis, (n,); `force`, `sigma`: force and its
    standard deviation, N, (n,). Returns `at`, F and sigma_F, (k,); NaN where no run has been.

    References
    ----------
    DerSimonian & Laird (1986), Control. Clin. Trials 7, 177-188.

    """
    return _pooled_curve(run, axis, force, sigma)[0]


def _pooled_curve(run: Array, axis: Array, force: Array, sigma: Array) -> tuple[dict[str, Array], float]:
    """The mean curve, and the mean chi-squared between the runs."""
    low, high = float(axis.min()), float(axis.max())
    at = np.linspace(low, high, N_POINTS)
    width = max(high - low, 1e-12) * SMOOTHING_WIDTH
    means, variances = [], []
    for r in np.unique(run):
        rows = run == r
        kernel = np.exp(-(((axis[rows] - at[:, None]) / width) ** 2) / 2)
        weight = kernel.sum(axis=1)
        within = (at >= axis[rows].min()) & (at <= axis[rows].max())
        covered = weight > MIN_WEIGHT_SHARE * np.median(weight[within] if within.any() else weight.max())
        share = kernel / np.maximum(weight, 1e-300)[:, None]
        means.append(np.where(covered, share @ force[rows], np.nan))
        variances.append(np.where(covered, share @ sigma[rows] ** 2, np.nan))
    force, deviation, q = _pool_runs(np.array(means), np.maximum(np.array(variances), 1e-30))
    return {"at": at, "F": force, "sigma_F": deviation}, q


def _pool_runs(means: Array, variances: Array) -> tuple[Array, Array, float]:
    """Random-effects mean over runs (R, k) with known variances, NaN where none is known; mean chi-squared of runs."""
    weight = np.nan_to_num(1 / variances)
    count = np.sum(weight > 0, axis=0)
    total = np.maximum(weight.sum(axis=0), 1e-300)
    value = np.nan_to_num(means)
    mean = np.sum(weight * value, axis=0) / total
    q = np.sum(weight * (value - mean) ** 2, axis=0)
    spare = total - np.sum(weight**2, axis=0) / total
    scatter = np.maximum((q - (count - 1)) / np.maximum(spare, 1e-300), 0.0) * (count > 1)
    weight = np.where(weight > 0, 1 / (variances + scatter), 0.0)
    weight = np.nan_to_num(weight)
    total = np.maximum(weight.sum(axis=0), 1e-300)
    mean = np.sum(weight * value, axis=0) / total
    between = float(np.sum(q) / max(np.sum(count > 1), 1))
    return np.where(count > 0, mean, np.nan), np.where(count > 0, 1 / np.sqrt(total), np.nan), between
