"""Curves of a residual for figures and files: along every run, and the missing force with its mean over each axis.

References
----------
DerSimonian & Laird (1986), Control. Clin. Trials 7, 177-188.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from frictrack.compare import LocalForces, continue_search, find_local_forces, start_search
from frictrack.diagnose.effect_description import FittedEffect
from frictrack.diagnose.missing_force import DeconvolvedForce, deconvolve_force
from frictrack.diagnose.repeatability import Repeatability, assess_repeatability
from frictrack.diagnose.smooth_forces import ResidualForces
from frictrack.diagnose.waves import SpectralLine, WaveScan
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import PieceResponse, Solution, position_and_velocity, refine
from frictrack.fit.observations import keep_compared_frames
from frictrack.motion_axes import AXES
from frictrack.records import Array

N_POINTS = 161  # of a common curve
SMOOTHING_WIDTH = 1 / 80  # of the axis
MIN_WEIGHT_SHARE = 0.2  # of the median number of frames near a point of a run's range, for the run to count there
MAX_SAMPLES_PER_RUN, MAX_SAMPLES = 300, 40_000  # of a figure; a panel of a page shows no more


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
        return find_local_forces(self.fit) if known is None else continue_search(start_search(known))

    @cached_property
    def repeats(self) -> Repeatability:
        """Whether the misfit repeats from run to run, and over which axis."""
        return assess_repeatability(self.local.solution, self.rng, self._waves, self._about_measurement)

    @cached_property
    def figures(self) -> dict[str, dict[str, Array]]:
        """Curves of the missing force; see `residual_figures`."""
        best = self.repeats.best
        pieces, line = deconvolve_force(self.local, self._waves, self._about_measurement)
        return residual_figures(pieces, line, "x" if best is None else best.axis)

    @cached_property
    def forces(self) -> ResidualForces:
        """Smooth forces in the residual of the fit itself, with which effects and formulas are compared."""
        return ResidualForces(self.fit)

    @cached_property
    def _about_measurement(self) -> ResidualForces:
        """Smooth forces in the residual in which the local ones were found."""
        return ResidualForces(self.local.solution, about_measurement=True)

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
    try:
        return refine(solution.problem, p, explained.starts, tau=tau, max_steps=0)
    except FrictrackError:  # without these effects no motion can be integrated
        return None


def residual_series(before: Solution, after: Solution | None, effects: Sequence[str]) -> dict[str, Array]:
    """Residual of a model and of the model with the effects found, for figures and files.

    Parameters
    ----------
    before
        The fit that is diagnosed.
    after
        The fit with the effects found; None if none was found.
    effects
        Names of the effects found.

    Returns
    -------
    dict
        One row per sample of all runs, all (n,): `run` (index), `t` since release (s), `x` (m) and `v` along the motion
        (m/s) of the model; `before`, the residual, and `sigma`, its noise (m, or N for measured friction). With effects
        found also `after`, the residual with them, and `F`, the force that they add against the motion (N).

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
        out["F"] = direction * np.sum(forces, axis=0) if forces else np.zeros_like(direction)
    return out


def residual_figures(
    pieces: list[DeconvolvedForce], line: SpectralLine | None, axis: str = "x"
) -> dict[str, dict[str, Array]]:
    """Curves of the missing force for plots and files.

    Parameters
    ----------
    pieces
        The deconvolved force of every piece.
    line
        The sinusoid that defines the phase; None without.
    axis
        The axis over which the misfit repeats: there runs are compared with and without their load.

    Returns
    -------
    dict
        `residual_force`: run (index), t, x, phase (cycles), v and a (along the motion, so v is the speed), F and
        sigma_F (N, positive against the motion), all (n,); `common_x` and so on: mean curve of all runs over an axis,
        `at`, F, sigma_F, (k,). If runs agree better in the force over the load, `residual_force` has the load (over
        that of the reference run), and the mean curves are forces at the reference load.

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

    Parameters
    ----------
    run
        Index of the run of every frame, (n,).
    axis
        Values of the axis, (n,).
    force, sigma
        Force and its standard deviation, N, (n,).

    Returns
    -------
    dict
        `at`, F and sigma_F, (k,); NaN where no run has been.

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
