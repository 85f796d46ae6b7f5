"""The missing force against time, place, velocity, acceleration and phase: all runs, and what they have in common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.axes import AXES
from frictrack.compare import DeconvolvedForce, SpectralLine, deconvolve_force
from frictrack.diagnose.repeatability.common_curves import Repeatability, assess_repeatability
from frictrack.fit.least_squares import Solution
from frictrack.fit.measured_friction import keep_compared_frames
from frictrack.records import Array

N_POINTS = 161  # of a common curve
SMOOTHING_WIDTH = 1 / 80  # of an axis: width of the smoothing
MIN_WEIGHT_SHARE = 0.2  # of the usual number of frames round a place for a run to have a say there


@dataclass(frozen=True)
class FailurePattern:
    """Whether the failure repeats, and the curves that show it: see `residual_figures`."""

    repeats: Repeatability
    figures: dict[str, dict[str, Array]]


def find_failure_pattern(solution: Solution, rng: np.random.Generator) -> FailurePattern:
    """What the failure of a fitted law has in common from run to run, in words, numbers and curves."""
    solution = keep_compared_frames(solution)
    pieces, line = deconvolve_force(solution)
    return FailurePattern(assess_repeatability(solution, rng), residual_figures(pieces, line))


def residual_figures(pieces: list[DeconvolvedForce], line: SpectralLine | None) -> dict[str, dict[str, Array]]:
    """Curves for plots and files.

    `residual_force`: run (its number among the fitted ones), t, x, phase (cycles), v and a (along the motion, so v is
    the speed), F and sigma_F (N, positive against the motion), all (n,); `common_x` and so on: the mean curve of all
    runs over an axis, `at`, F, sigma_F (k,).
    """
    frames = [_along(p, line) for p in pieces]
    whole = {name: np.concatenate([f[name] for f in frames]) for name in frames[0]}
    if line is not None:
        whole["frequency"] = np.array([line.frequency])
    out = {"residual_force": whole}
    for axis in AXES:
        if axis in whole:
            out[f"common_{axis}"] = mean_curve(whole["run"], whole[axis], whole["F"], whole["sigma_F"])
    return out


def _along(piece: DeconvolvedForce, line: SpectralLine | None) -> dict[str, Array]:
    against = np.where(piece.v < 0, -1.0, 1.0)
    out = {"run": np.full(len(piece.t), float(piece.run)), "t": piece.t, "x": piece.x}
    out |= {"v": against * piece.v, "a": against * piece.a}
    if line is not None:
        out["phase"] = (line.phase(piece.run, piece.t) + np.where(against < 0, 0.5, 0.0)) % 1.0
    return out | {"F": against * piece.F, "sigma_F": piece.sigma_F}


def mean_curve(run: Array, axis: Array, force: Array, sigma: Array) -> dict[str, Array]:
    """The mean of all runs over an axis (n,): places `at`, F and sigma_F (k,), NaN where no run has been.

    Every run is smoothed by itself; runs differ by their noise and by a scatter that is estimated at every place
    (DerSimonian & Laird 1986, Control. Clin. Trials 7), so the band says how far they agree.
    """
    low, high = float(axis.min()), float(axis.max())
    at = np.linspace(low, high, N_POINTS)
    width = max(high - low, 1e-12) * SMOOTHING_WIDTH
    means, variances = [], []
    for r in np.unique(run):
        mine = run == r
        kernel = np.exp(-(((axis[mine] - at[:, None]) / width) ** 2) / 2)
        weight = kernel.sum(axis=1)
        here = weight > MIN_WEIGHT_SHARE * np.median(weight[weight > 0])
        share = kernel / np.maximum(weight, 1e-300)[:, None]
        means.append(np.where(here, share @ force[mine], np.nan))
        variances.append(np.where(here, share @ sigma[mine] ** 2, np.nan))
    force, deviation = _pooled(np.array(means), np.maximum(np.array(variances), 1e-30))
    return {"at": at, "F": force, "sigma_F": deviation}


def _pooled(means: Array, variances: Array) -> tuple[Array, Array]:
    """Mean over runs (R, k) whose variances are known and which scatter beside; NaN where none is known."""
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
    return np.where(count > 0, mean, np.nan), np.where(count > 0, 1 / np.sqrt(total), np.nan)
