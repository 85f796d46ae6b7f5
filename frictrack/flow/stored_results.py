"""Read the results of a study from its HDF5 files alone: nothing is measured, fitted or checked again.

    results = read_results(open_study("study.toml"))

A run that was not measured completely is left out; a model that was not diagnosed has no diagnosis.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from frictrack import store
from frictrack.flow.command_history import CommandHistory
from frictrack.flow.duplicate_runs import find_duplicate_runs
from frictrack.flow.pipeline import RunPipeline, no_progress
from frictrack.flow.run_budget import run_budget
from frictrack.flow.sensor_stage import fused_acceleration, sensor_summary
from frictrack.flow.stages import run_pipeline
from frictrack.flow.track_quality import track_quality
from frictrack.flow.tried_models import TriedModels, model_results
from frictrack.motion import derivatives, low_pass
from frictrack.records import Array, RunEvents
from frictrack.results import ModelResults, Results, RunResults, to_builtins
from frictrack.study import Study
from frictrack.version import __version__

OPTIONAL_STAGES = ("cutoff", "friction", "events")  # not needed by a fit


def read_results(study: Study) -> Results:
    """Read runs, models, comparison and diagnosis of a study as they are stored, even if they are outdated.

    Parameters
    ----------
    study
        The study.

    Returns
    -------
    Results
        Its `outdated` lists what has changed in the study file since.

    """
    pipelines = [run_pipeline(study, run, stored_only=True) for run in study.runs]
    models = TriedModels(study, pipelines, no_progress, CommandHistory(study.output))
    with store.snapshot(models.path, *(pipeline.path for pipeline in pipelines)):
        results = tuple(models.results(group) for group in models.groups)
        current = next((model for model in results if model.current), None)
        has_papers = "papers" in store.names(models.path)
        return Results(
            name=study.name,
            path=study.path,
            output=study.output,
            version=__version__,
            runs=_all_run_results([pipeline for pipeline in pipelines if _is_measured(pipeline)]),
            models=results,
            comparison=_summary(models, "comparison"),
            diagnosis=current.diagnosis if current else None,
            figures=current.figures if current else {},
            papers=models.results("papers") if has_papers else None,
            outdated=tuple(_outdated_items(pipelines, models)),
        )


def _all_run_results(pipelines: list[RunPipeline]) -> tuple[RunResults, ...]:
    """Read all runs; a run that is the same recording as another one gets a note."""
    twice = find_duplicate_runs(pipelines)
    runs = [run_results(pipeline) for pipeline in pipelines]
    return tuple(replace(r, notes=(*r.notes, twice[r.name])) if r.name in twice else r for r in runs)


def read_attempt(path: Path) -> ModelResults:
    """Read the model that `Session.attempt` wrote.

    Parameters
    ----------
    path
        The file.

    """
    return model_results(path, store.names(path, "models")[0])


def preview_motion(run: RunResults, cutoff: float) -> Array:
    """Return x, v and a (3, n) of a run with a plain low-pass; nothing is stored.

    Parameters
    ----------
    run
        A run.
    cutoff
        Cut-off frequency, Hz.

    """
    course = replace(run.displacement, y=np.full(len(run.displacement), np.nan))  # y would double the time
    acceleration = None if run.sensors is None else fused_acceleration(run.sensors)
    return derivatives(low_pass(course, cutoff, acceleration=acceleration))


def _is_measured(pipeline: RunPipeline) -> bool:
    """Return whether all stages that a fit needs are stored."""
    return all(pipeline.is_current(name) for name in pipeline.stages if name not in OPTIONAL_STAGES)


def _outdated_items(pipelines: list[RunPipeline], models: TriedModels) -> Iterator[str]:
    """List keys of runs that have changed in the study file since the results were computed, and outdated models.

    The files that the keys name are not opened: a change of their content is noticed when the work is done again.
    """
    runs: dict[str, list[str]] = {}
    for pipeline in pipelines:
        for key in pipeline.changed_keys():
            runs.setdefault(key, []).append(pipeline.run.name)
    for key, names in runs.items():
        yield key if len(names) == len(pipelines) else f"{key} of {', '.join(names)}"
    if models.is_current_outdated():
        yield "what the model was fitted to"


def _summary(models: TriedModels, group: str) -> Any:
    there = group in store.names(models.path)
    return json.loads(store.read(models.path, group)["summary"]) if there else None


def run_results(pipeline: RunPipeline) -> RunResults:
    """Read all stored stages of one run, with its notes, quality and error budget."""
    done = {name: pipeline.get(name) for name in pipeline.stages if pipeline.is_current(name)}
    quality = _quality(done)
    notes = [note for name in ("recording", "track", "displacement") for note in getattr(done.get(name), "notes", ())]
    notes += sensor_summary(pipeline)["notes"]
    return RunResults(
        name=pipeline.run.name,
        source=pipeline.as_written(pipeline.run.source),
        displacement=done["displacement"],
        filtered=done["filtered"],
        motion=done["motion"],
        events=done.get("events", RunEvents()),
        cutoff=done.get("cutoff"),
        friction=done.get("friction"),
        film=done.get("recording"),
        track=done.get("track"),
        tracks=done.get("tracks", {}),
        sensors=done["sensors"],
        quality=quality,
        budget=run_budget(pipeline, quality),
        role=pipeline.run.role,
        group=pipeline.run.group,
        settings={k: pipeline.as_written(v) for k, v in pipeline.run if v not in (None, "", {}, [])},
        hashes={name: pipeline.key(name) for name in done},
        notes=tuple(dict.fromkeys(notes)),
    )


def _quality(done: dict[str, Any]) -> dict[str, Any]:
    """Return `track_quality` of a film; empty for a table of positions."""
    if "track" not in done:
        return {}
    found: dict[str, Any] = to_builtins(
        track_quality(done["recording"], done["track"], done["tracks"], done["displacement"].pixel_pitch)
    )
    return found
