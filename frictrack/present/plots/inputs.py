"""Convert runs, fits and diagnoses to what figures are drawn from: the results as a study stores them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from frictrack.base.errors import result_or_none
from frictrack.measure.friction import find_events, friction
from frictrack.records import Array, Filtered, Friction, Run
from frictrack.results import ModelResults, RunResults


class FitLike(Protocol):
    """What can be converted to the results of a model: a fit."""

    def to_results(self) -> ModelResults:
        """Return the results of the model."""
        ...


class Summarised(Protocol):
    """What has a JSON summary and curves: a diagnosis."""

    figures: dict[str, dict[str, Array]]

    def summary(self) -> dict[str, Any]:
        """Return the JSON."""
        ...


AnyRun = RunResults | Run
AnyModel = ModelResults | FitLike | Mapping[str, Any]
AnySummary = Mapping[str, Any] | Summarised


def as_run(run: AnyRun) -> RunResults:
    """Convert a run to the results of a run: its events are found, its friction force is computed.

    Parameters
    ----------
    run : RunResults or Run
        Stored results are returned as they are.

    """
    if isinstance(run, RunResults):
        return run
    weighed = None if run.mass is None else (run.mass, run.sigma_mass)
    more: dict[str, Any] = {"events": find_events(run), "friction": _friction_of(run)}
    more |= {"role": run.role, "group": run.group}
    more["settings"] = {"mass": weighed, "columns": {"v": "v"} if run.steady else {}}
    return RunResults(run.name, "", run.displacement, _smoothed(run), run.motion, **more)


def as_runs(runs: Sequence[AnyRun]) -> list[RunResults]:
    """Convert runs; see `as_run`."""
    return [as_run(run) for run in runs]


def as_model(model: AnyModel) -> ModelResults:
    """Convert a fit, or the errors of one in a comparison, to the results of a model."""
    if isinstance(model, Mapping):
        return ModelResults(model["name"], "+".join(model["model"]), dict(model), ())
    return model if isinstance(model, ModelResults) else model.to_results()


def as_summary(found: AnySummary) -> Mapping[str, Any]:
    """Convert a diagnosis to its JSON; JSON is returned as it is."""
    return found if isinstance(found, Mapping) else found.summary()


def _smoothed(run: Run) -> Filtered:
    """The smoothed displacement that the motion of a run was made from, as if a filter had been asked for."""
    measured, motion = run.displacement, run.motion
    sigma = np.where(measured.known, measured.sigma_x, np.inf)
    how = json.loads(motion.filter)["method"] if motion.filter else "smoothed as given"
    return Filtered(
        motion.t, motion.x, measured.y, sigma, measured.sigma_y, reason=how, asked=True, x_measured=measured.x
    )


def _friction_of(run: Run) -> Friction | None:
    """Friction force of a run; None without a mass, or if it has no free section."""
    if run.mass is None and run.friction_N is None:
        return None
    return result_or_none(friction, run)
