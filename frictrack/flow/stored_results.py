"""What a study has come to, read from its HDF5 files alone: nothing is measured, fitted or checked again.

    results = stored(open_study("study.toml"))

A run that was not measured to its end is left out, a model that was not diagnosed has no diagnosis.
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

OPTIONAL_STAGES = ("cutoff", "friction", "events")  # stages that a fit does not need


def read_results(study: Study) -> Results:
    """Runs, models, comparison and diagnosis as they lie in the results folder, however old."""
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
    """The runs, and which of them are the same recording."""
    twice = find_duplicate_runs(pipelines)
    runs = [run_results(pipeline) for pipeline in pipelines]
    return tuple(replace(r, notes=(*r.notes, twice[r.name])) if r.name in twice else r for r in runs)


def read_attempt(path: Path) -> ModelResults:
    """The model of an attempt."""
    return model_results(path, store.names(path, "models")[0])


def preview_motion(run: RunResults, cutoff: float) -> Array:
    """What x, v and a (3, n) of a run would be with a plain low-pass at a cut-off, Hz; nothing is stored."""
    along = replace(run.displacement, y=np.full(len(run.displacement), np.nan))  # across costs as much again
    beside = None if run.sensors is None else fused_acceleration(run.sensors)
    return derivatives(low_pass(along, cutoff, acceleration=beside))


def _is_measured(pipeline: RunPipeline) -> bool:
    """Whether all is there on which anything else rests."""
    return all(pipeline.is_current(name) for name in pipeline.stages if name not in OPTIONAL_STAGES)


def _outdated_items(pipelines: list[RunPipeline], models: TriedModels) -> Iterator[str]:
    """Keys of the runs that were made from others than the study file has now, and the model, where that holds for it.

    The files that they name are not opened: whether their content changed is only seen when the work is done again.
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
    """Every stage of one run that was made, all that is known of it."""
    done = {name: pipeline.get(name) for name in pipeline.stages if pipeline.is_current(name)}
    seen = _quality(done)
    notes = [note for name in ("recording", "track", "displacement") for note in getattr(done.get(name), "notes", ())]
    notes += sensor_summary(pipeline)["notes"]
    return RunResults(
        name=pipeline.run.name,
        source=pipeline.as_written(pipeline.run.source),
        displacement=done["displacement"],
        filtered=done["filtered"],
        motion=done["motion"],
        happenings=done.get("events", RunEvents()),
        cutoff=done.get("cutoff"),
        friction=done.get("friction"),
        film=done.get("recording"),
        track=done.get("track"),
        tracks=done.get("tracks", {}),
        sensors=done["sensors"],
        quality=seen,
        budget=run_budget(pipeline, seen),
        role=pipeline.run.role,
        group=pipeline.run.group,
        settings={k: pipeline.as_written(v) for k, v in pipeline.run if v not in (None, "", {}, [])},
        hashes={name: pipeline.key(name) for name in done},
        notes=tuple(dict.fromkeys(notes)),
    )


def _quality(done: dict[str, Any]) -> dict[str, Any]:
    """What a film says of its own measurement; nothing for a table."""
    if "track" not in done:
        return {}
    found: dict[str, Any] = to_builtins(
        track_quality(done["recording"], done["track"], done["tracks"], done["displacement"].pixel_pitch)
    )
    return found
