"""Read the results of a study from its HDF5 files alone: nothing is measured, fitted or checked again.

    results = read_results(open_study("study.toml"))

A run that was not measured completely is left out; a model that was not diagnosed has no diagnosis.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from frictrack import store
from frictrack.errors import FrictrackError
from frictrack.filters import STRUCTURAL, FilterChoice
from frictrack.flow.command_history import CommandHistory
from frictrack.flow.duplicate_runs import duplicate_notes
from frictrack.flow.fit_request import FitRequest
from frictrack.flow.outdated import find_outdated
from frictrack.flow.pipeline import RunPipeline, no_progress
from frictrack.flow.plausibility_checks import stored_findings
from frictrack.flow.run_budget import run_budget
from frictrack.flow.sensor_stage import fused_acceleration, sensor_summary
from frictrack.flow.stages import run_pipeline
from frictrack.flow.track_quality import track_quality
from frictrack.flow.tried_models import TriedModels, model_results
from frictrack.motion import derivatives, low_pass
from frictrack.records import Array, RunEvents
from frictrack.results import ModelResults, OutdatedPart, Results, RunResults, to_builtins
from frictrack.study import Study
from frictrack.version import __version__

OPTIONAL_STAGES = ("cutoff", "friction", "events", "repaired")  # not needed by a fit, or not for what is shown


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
    return ResultsReader().read(study)


class ResultsReader:
    """Read the results of a study again and again; runs and models whose files have not changed are read once.

    Parameters
    ----------
    with_budgets
        Compute the error budget of every run, which takes longer than reading it.

    """

    def __init__(self, *, with_budgets: bool = True) -> None:
        self.with_budgets = with_budgets
        self._runs: dict[str, tuple[Any, RunResults]] = {}
        self._models: dict[str, tuple[str, ModelResults]] = {}
        self._compared: list[RunResults] = []  # runs that were searched for duplicates, and the notes on them
        self._twice: dict[str, str] = {}
        self._noted: dict[str, tuple[int, list[str], RunResults]] = {}  # runs with notes that other files give

    def read(self, study: Study) -> Results:
        """Read the results of a study as they are stored; see `read_results`."""
        pipelines = [run_pipeline(study, run, stored_only=True) for run in study.runs]
        history = CommandHistory(study.output)
        models = TriedModels(study, pipelines, no_progress, history)
        with store.snapshot(models.path, *(pipeline.path for pipeline in pipelines)):
            results = tuple(self._model(models, group) for group in models.groups)
            current = next((model for model in results if model.current), None)
            has_papers = "papers" in store.names(models.path)
            outdated = find_outdated(pipelines, models)
            return Results(
                name=study.name,
                path=study.path,
                output=study.output,
                version=__version__,
                runs=self._all_runs([pipeline for pipeline in pipelines if _is_measured(pipeline)], history),
                models=results,
                comparison=models.stored_summary("comparison"),
                diagnosis=current.diagnosis if current else None,
                figures=current.figures if current else {},
                papers=self._model(models, "papers") if has_papers else None,
                implausible=_implausible(models, pipelines, outdated),
                outdated=tuple(_outdated_items(pipelines, models)),
                outdated_parts=outdated,
            )

    def _all_runs(self, pipelines: list[RunPipeline], history: CommandHistory) -> tuple[RunResults, ...]:
        """Read all runs; one that is the same recording as another one gets a note, one with repairs says by whom."""
        runs = [self._run(pipeline) for pipeline in pipelines]
        if [id(run) for run in runs] != [id(run) for run in self._compared]:  # every run with every other
            contents = {run.name: run.film.hash for run in runs if run.film is not None}
            self._twice = duplicate_notes({run.name: run.displacement for run in runs}, contents)
            self._compared = runs
        authors = _repair_authors(history) if any(pipeline.run.repair for pipeline in pipelines) else {}
        return tuple(
            self._with_notes(run, [n[run.name] for n in (self._twice, authors) if run.name in n]) for run in runs
        )

    def _with_notes(self, run: RunResults, notes: list[str]) -> RunResults:
        """Return a run with more notes; the same object as the last time if nothing has changed."""
        if not notes:
            return run
        if run.name not in self._noted or self._noted[run.name][:2] != (id(run), notes):
            self._noted[run.name] = (id(run), notes, replace(run, notes=(*run.notes, *notes)))
        return self._noted[run.name][2]

    def _run(self, pipeline: RunPipeline) -> RunResults:
        """Read a run, unless its file and its keys are those of the last time."""
        name, file = pipeline.run.name, pipeline.path.stat()
        key = (pipeline.run, str(pipeline.path), file.st_ino, file.st_mtime_ns, file.st_size)
        if name not in self._runs or self._runs[name][0] != key:
            self._runs[name] = (key, run_results(pipeline, with_budget=self.with_budgets))
        return self._runs[name][1]

    def _model(self, models: TriedModels, group: str) -> ModelResults:
        """Read a model, unless its stored content is that of the last time."""
        checksum = store.checksum(models.path, group if group == "papers" else f"models/{group}")
        if not checksum or self._models.get(group, ("",))[0] != checksum:
            self._models[group] = (checksum, models.results(group))
        return self._models[group][1]


def _repair_authors(history: CommandHistory) -> dict[str, str]:
    """Return by run who changed its repairs last, and when; a change by hand in the study file is not recorded."""
    try:
        changes = history.undo_stacks()[0]
    except FrictrackError:  # a damaged log must not hide the results
        return {}
    edits = [change for change in changes if change.command == "edit" and change.arguments.get("key") == "repair"]
    return {
        str(change.arguments["which"]): f"repairs set from {change.author} at {change.time}"
        for change in edits
        if change.arguments.get("value")
    }


class AttemptsReader:
    """Read the fits of the current model with one more effect again and again; each is read once."""

    def __init__(self) -> None:
        self._known: dict[Path, ModelResults] = {}

    def read(self, study: Study, names: Iterable[str]) -> dict[str, ModelResults]:
        """Return the fits that `Session.attempt` stored, by effect.

        Parameters
        ----------
        study
            The study.
        names
            Names of the effects in question.

        """
        pipelines = [run_pipeline(study, run, stored_only=True) for run in study.runs]
        models = TriedModels(study, pipelines, no_progress, CommandHistory(study.output))
        with store.snapshot(models.path, *(study.output / f"{run.name}.h5" for run in study.runs)):
            group = models.current_group
            if group is None:
                return {}
            request = models.request(group)
            paths = {name: models.attempt_path(request.edited(f"+{name}")) for name in names}
            found = {name: self._attempt(models, request.edited(f"+{name}"), path) for name, path in paths.items()}
        self._known = {path: fit for path, fit in self._known.items() if path in paths.values()}
        return {name: fit for name, fit in found.items() if fit is not None}

    def _attempt(self, models: TriedModels, request: FitRequest, path: Path) -> ModelResults | None:
        """Read one attempt; the name of its file is the hash of all that its content depends on."""
        if not path.exists():
            return None
        if path not in self._known:
            stored = models.stored_attempt(request)
            if stored is None:
                return None
            self._known[path] = model_results(*stored)
        return self._known[path]


def preview_motion(run: RunResults, cutoff: float) -> Array:
    """Return x, v and a (3, n) of a run with another cut-off of its filter, or of a plain low-pass; nothing is stored.

    Parameters
    ----------
    run
        A run.
    cutoff
        Cut-off frequency, Hz.

    """
    given = run.settings
    choice = FilterChoice(given.get("filter", STRUCTURAL), cutoff, given.get("order"), causal=bool(given.get("causal")))
    course = replace(run.displacement, y=np.full(len(run.displacement), np.nan))  # y would double the time
    acceleration = None if run.sensors is None else fused_acceleration(run.sensors)
    return derivatives(low_pass(course, method=choice, acceleration=acceleration))


def _is_measured(pipeline: RunPipeline) -> bool:
    """Return whether all stages that a fit needs are stored."""
    return all(pipeline.is_current(name) for name in pipeline.stages if name not in OPTIONAL_STAGES)


def _outdated_items(pipelines: list[RunPipeline], models: TriedModels) -> Iterator[str]:
    """List keys of runs that have changed in the study file since the results were computed, and outdated models.

    The files that the keys name are not opened: a change of their content is noticed when the work is done again.
    """
    runs: dict[str, list[str]] = {}
    for pipeline in pipelines:
        for key in {key: None for name in pipeline.stages for key in pipeline.changed_settings(name)}:
            runs.setdefault(key, []).append(pipeline.run.name)
    for key, names in runs.items():
        yield key if len(names) == len(pipelines) else f"{key} of {', '.join(names)}"
    if models.is_current_outdated():
        yield "what the model was fitted to"


def _implausible(
    models: TriedModels, pipelines: list[RunPipeline], outdated: Iterable[OutdatedPart]
) -> tuple[dict[str, Any], ...]:
    """Return the implausible numbers of the study; none once a number of a run was changed, until it is measured."""
    if any(part.what in ("track", "motion") for part in outdated):
        return ()
    return tuple(stored_findings(models.path, pipelines) or ())


def run_results(pipeline: RunPipeline, *, with_budget: bool = True) -> RunResults:
    """Read all stored stages of one run, with its notes, quality and, if asked for, error budget."""
    done = {name: pipeline.get(name) for name in pipeline.stages if pipeline.is_current(name)}
    hashed = tuple(done)
    if "repaired" in pipeline.stages:
        done["track"] = done.pop("repaired", done.get("track"))  # a repair that was not computed yet
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
        budget=run_budget(pipeline, quality) if with_budget else {},
        role=pipeline.run.role,
        group=pipeline.run.group,
        settings={k: pipeline.as_written(v) for k, v in pipeline.run if v not in (None, "", {}, [])},
        hashes={name: pipeline.key(name) for name in hashed},
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
