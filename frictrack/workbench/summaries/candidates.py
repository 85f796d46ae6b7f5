"""Compare the current model with the same model and one more effect: curves, errors, and where they differ most."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.flow import AttemptsReader
from frictrack.number_format import describe_change
from frictrack.plots.style import BAND_SIGMAS
from frictrack.records import Array
from frictrack.results import ModelResults, Results, to_builtins
from frictrack.workbench.plot_data import (
    FORCE_TITLES,
    RESIDUAL_TITLES,
    candidate_columns,
    compared_runs,
    comparison_plots,
)
from frictrack.workbench.plot_layers import PlotData
from frictrack.workbench.summaries.models import model_errors
from frictrack.workbench.summaries.snapshot import Snapshot

BINS = 40  # of the horizontal axis of a plot
MIN_COMMON_POWER = 0.05  # of the noise of a frame; a smaller change is hardly seen in any plot
AXES_OF_PLOTS = {
    **dict(zip(RESIDUAL_TITLES, ("t", "x", "v"), strict=True)),
    **dict(zip(FORCE_TITLES, ("t", "v"), strict=True)),
}  # title of a plot -> column of its horizontal axis


def candidate_curves(snapshot: Snapshot, effect: str) -> PlotData | None:
    """Prepare the curves of the current model with one more effect; nothing is fitted.

    Parameters
    ----------
    snapshot
        The study as its files are.
    effect
        Name of the effect.

    Returns
    -------
    PlotData or None
        The columns "with" (residual) and "F_with" (force, N) for the rows of `comparison_plots`, without plots; in
        `extra`: name, plot (title of the plot in which the curves differ most), errors and fitted. None if the job
        "attempt" has not fitted the current model with this effect.

    """
    results = snapshot.results
    if snapshot.study is None or results is None or results.current is None:
        return None
    tried = snapshot.attempted.get(effect)
    tried = tried or AttemptsReader().read(snapshot.study, [effect]).get(effect)  # any effect can be tried
    if tried is None:
        return None
    columns = candidate_columns(results.runs, results.current, tried)
    about = {
        "name": effect,
        "plot": most_changed_plot(results, results.current, columns),
        "errors": error_change(results.current, tried),
        "fitted": True,
    }
    return PlotData(len(columns["with"]), columns, [], [], to_builtins(about))


def error_change(now: ModelResults, tried: ModelResults) -> dict[str, Any]:
    """Compare the errors of two models: held out if both were predicted, else of the fit.

    Parameters
    ----------
    now, tried
        The current model, and the one with one more effect.

    Returns
    -------
    dict
        "now", "with", "unit" and "words", a sentence.

    """
    before, after = model_errors(now), model_errors(tried)
    predicted = None not in (before["heldout"], after["heldout"]) and before["heldout_unit"] == after["heldout_unit"]
    key, unit, name = ("heldout", "heldout_unit", "Held-out error") if predicted else ("rms", "rms_unit", "Residual")
    first, second = before[key], after[key]
    chi2 = describe_change(before["reduced_chi2"], after["reduced_chi2"])
    words = f"{name} {describe_change(first, second, before[unit])}; reduced chi-squared {chi2}."
    return {"now": first, "with": second, "unit": before[unit], "words": words}


def most_changed_plot(results: Results, model: ModelResults, columns: Mapping[str, Array]) -> str:
    """Find the plot in which a candidate changes the picture most.

    The change is averaged over bins of the plot's horizontal axis, run by run, in units of the noise of one frame. What
    counts is the part that the runs have in common: the mean product of the averages of two runs in the same bin. A
    change that belongs to places is common to all runs over the place, and cancels over the time. If no axis has such
    a part, or there is one run, the largest change of the averages counts.

    Parameters
    ----------
    results, model
        The study and its current model.
    columns
        "with" and "F_with"; see `candidate_curves`.

    Returns
    -------
    str
        Title of the plot.

    """
    now = comparison_plots(results, model).columns
    runs = compared_runs(results.runs, model)
    noise, force_noise = now["noise_high"] / BAND_SIGMAS, _force_noise(results, model)
    in_noise = {
        RESIDUAL_TITLES: (columns["with"] - now["left"]) / noise,
        FORCE_TITLES: (columns["F_with"] - now["F_model"]) / force_noise,
    }
    number = np.repeat(np.arange(len(runs)), [len(run.motion) for run in runs])
    changes = {
        title: _binned_change(now[AXES_OF_PLOTS[title]], change, number)
        for titles, change in in_noise.items()
        for title in titles
    }
    for measure in (lambda change: change.common, lambda change: change.power):
        best = max(changes, key=lambda title: measure(changes[title]))
        if measure(changes[best]) > MIN_COMMON_POWER:
            return best
    return RESIDUAL_TITLES[0]


def _force_noise(results: Results, model: ModelResults) -> Array:
    """Standard deviation of the measured force (rows,), N; NaN where no force is known."""
    parts = [
        np.full(len(run.motion), np.nan) if run.friction is None else run.friction.sigma_F
        for run in compared_runs(results.runs, model)
    ]
    return np.concatenate(parts) if parts else np.zeros(0)


@dataclass(frozen=True)
class _BinnedChange:
    """Mean square of a change in units of the noise, averaged over bins: of each run, and common to two runs."""

    power: float
    common: float


def _binned_change(axis: Array, change: Array, run: NDArray[np.int64]) -> _BinnedChange:
    """Average a change over bins of an axis and runs.

    Parameters
    ----------
    axis, change
        Place on the axis and change in units of the noise (rows,).
    run
        Number of the run (rows,).

    """
    known = np.isfinite(axis) & np.isfinite(change)
    if not known.any():
        return _BinnedChange(0.0, 0.0)
    axis, change, run = axis[known], change[known], run[known]
    span = float(np.ptp(axis)) or 1.0
    bins = np.minimum((BINS * (axis - axis.min()) / span).astype(np.int64), BINS - 1)
    shape = (int(run.max()) + 1, BINS)
    count, total = np.zeros(shape), np.zeros(shape)
    np.add.at(count, (run, bins), 1.0)
    np.add.at(total, (run, bins), change)
    mean = total / np.maximum(count, 1.0)
    power = float(np.sum(count * mean**2) / len(change))
    # products of two runs, weighted by the smaller number of their rows in that bin
    pairs = combinations(range(shape[0]), 2)
    common = 2 * sum(float(np.sum(np.minimum(count[i], count[j]) * mean[i] * mean[j])) for i, j in pairs)
    return _BinnedChange(power, common / len(change))
