"""Read the results of a study from its HDF5 files alone: nothing is measured, fitted or checked again.

    results = read_results(open_study("study.toml"))

A run that was not measured completely is left out; a model that was not diagnosed has no diagnosis.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from frictrack import measure, tracking
from frictrack.base import __version__
from frictrack.base.errors import FrictrackError, result_or_none
from frictrack.base.number_format import first_words, format_number, format_plus_minus
from frictrack.flow import store
from frictrack.flow.command_history import CommandHistory
from frictrack.flow.pipeline import RunPipeline, digest
from frictrack.flow.plausibility_checks import duplicate_notes, find_duplicate_runs, stored_findings
from frictrack.flow.sensor_stage import fused_acceleration, sensor_summary
from frictrack.flow.stages import BACKWARD, REFERENCE, contact_sheet_path, min_shake_px, overlay_path
from frictrack.flow.store import Provenance
from frictrack.flow.track_quality import residual_shake, track_quality
from frictrack.flow.tried_models import TriedModels, model_results, stored_models
from frictrack.records import Array, CutoffTradeOff, Displacement, Friction, Motion, RunEvents
from frictrack.results import ModelResults, OutdatedPart, Results, RunResults, to_builtins
from frictrack.results.candidates import plain_name
from frictrack.settings.filters import STRUCTURAL, FilterChoice
from frictrack.study import Study

PICTURE_STAGES = ("recording", "track", "tracks")  # whose results are the positions in the picture
HEAD_BYTES = 2000  # of a report, in which its key stands
REPORT_KEY = re.compile(r"[0-9a-f]{64} ([0-9a-f]{64}) ([^\"<>]+)")  # all inputs, the results, the current model
OPTIONAL_STAGES = {"cutoff", "friction", "events", "repaired"}  # not needed by a fit, or not for what is shown


# --- the numbers of a run


def run_budget(pipeline: RunPipeline, known: dict[str, Any] | None = None) -> dict[str, Any]:
    """Compute the error budget of the friction force of one run."""
    run = pipeline.to_run()
    if run.mass is None and run.friction_N is None:
        return {}
    film = pipeline.get("recording") if pipeline.run.video else None
    if film is not None:
        left = residual_shake(pipeline.get("tracks").get(REFERENCE), min_shake_px(pipeline.run))
        shake = {} if left is None else dict(zip(("shake_Hz", "shake_left_px", "shake_left_told"), left, strict=True))
        known = (known or film_quality(pipeline)) | shake
    found = measure.error_budget.budget(run, pipeline.get("filtered"), known, film, pipeline.get("sensors").clocks)
    return dict(to_builtins(found.summary()))


def film_quality(pipeline: RunPipeline) -> dict[str, Any]:
    """Return `track_quality` of a film as JSON; empty for a table of positions."""
    if not pipeline.run.video:
        return {}
    pitch = pipeline.get("displacement").pixel_pitch
    found = track_quality(pipeline.get("recording"), pipeline.final_track, pipeline.get("tracks"), pitch)
    return dict(to_builtins(found))


def run_summaries(pipelines: list[RunPipeline], stage: str) -> list[dict[str, Any]]:
    """Return the rows of all runs for one stage."""
    describe = {"track": _track_summary, "motion": _motion_summary, "friction": _friction_summary}[stage]
    rows = [{"run": pipeline.run.name, **describe(pipeline)} for pipeline in pipelines if stage in pipeline.stages]
    made: list[dict[str, Any]] = to_builtins(rows)
    if stage == "track":  # a track that cannot be calibrated has no displacement to compare
        return made
    twice = find_duplicate_runs(pipelines)
    return [{**row, "notes": [*row["notes"], *filter(None, [twice.get(row["run"])])]} for row in made]


def _track_summary(pipeline: RunPipeline) -> dict[str, Any]:
    """Describe how well a film was measured, and where its pictures are."""
    displacement, notes = _displacement_and_notes(pipeline)
    pitch = displacement.pixel_pitch if displacement else None
    track, tracks = pipeline.final_track, pipeline.get("tracks")
    return {
        **track_quality(pipeline.get("recording"), track, tracks, pitch),
        "suspects": [vars(span) for span in measure.repairing.suspect_spans(track, tracks.get(BACKWARD))],
        "target": tracking.target_line(track),
        "contact_sheet": str(contact_sheet_path(pipeline.study, pipeline.run.name)),
        "overlay": str(overlay_path(pipeline)) if overlay_path(pipeline).exists() else None,
        "notes": notes,
    }


def _displacement_and_notes(pipeline: RunPipeline) -> tuple[Displacement | None, list[str]]:
    """Return the displacement and its notes; a track that cannot be calibrated is described without displacement."""
    try:
        displacement: Displacement = pipeline.get("displacement")
    except FrictrackError as e:
        return None, [*pipeline.final_track.notes, f"not calibrated: {e}"]
    return displacement, list(displacement.notes)


def _motion_summary(pipeline: RunPipeline) -> dict[str, Any]:
    """Describe the motion: noise, cut-off, largest speed, vibrations, events."""
    motion: Motion = pipeline.get("motion")
    displacement: Displacement = pipeline.get("displacement")
    happened: RunEvents = pipeline.get("events")
    return {
        "frames": len(motion),
        "cutoff_Hz": motion.cutoff,
        "noise_um": 1e6 * float(np.nanmedian(displacement.sigma_x)),
        "sigma_x_um": 1e6 * float(np.median(motion.sigma_x)),
        "v_max": float(motion.v[np.argmax(np.abs(motion.v))]),
        "sigma_v": float(np.median(motion.sigma_v)),
        "sigma_a": float(np.median(motion.sigma_a)),
        "smoothing": pipeline.get("filtered").reason,
        "lines_Hz": list(motion.lines),
        "guard_frames": motion.guard,
        "cutoff": _cutoff_summary(pipeline) if "cutoff" in pipeline.stages else None,
        "events": [{"kind": kind, "from_s": begins, "to_s": ends} for kind, begins, ends in happened.events],
        "noise_at_rest_um": 1e6 * happened.noise_at_rest if np.isfinite(happened.noise_at_rest) else None,
        **_sensor_notes(pipeline),
    }


def _cutoff_summary(pipeline: RunPipeline) -> dict[str, Any]:
    """Describe what a plain low-pass would cost, in N if the mass is known, else in m/s^2."""
    found: CutoffTradeOff = pipeline.get("cutoff")
    mass = pipeline.run.mass[0] if isinstance(pipeline.run.mass, tuple) else None
    unit, factor = ("m/s^2", 1.0) if mass is None else ("N", mass)
    noise, lost = found.at(found.chosen)
    return {
        "chosen_Hz": found.chosen,
        "least_Hz": found.least,
        "unit": unit,
        "noise": noise * factor,
        "lost": lost * factor,
        "followed_apart": found.structural * factor,
        "warnings": list(found.warnings),
    }


def _friction_summary(pipeline: RunPipeline) -> dict[str, Any]:
    """Describe the friction force and the free section."""
    friction: Friction = pipeline.get("friction")
    motion: Motion = pipeline.get("motion")
    free = friction.free
    judged = friction.t[free]
    resisting = friction.F * np.sign(motion.v)
    found = run_budget(pipeline)
    return {
        "free_from_s": float(judged[0]) if len(judged) else None,
        "free_to_s": float(judged[-1]) if len(judged) else None,
        "mean_F_N": float(np.mean(resisting[free])) if len(judged) else None,
        "sigma_F_N": float(np.median(friction.sigma_F[free])) if len(judged) else None,
        "reason": friction.reason,
        **({"budget": found["rows"], "budget_says": found["says"]} if found else {}),
        **_sensor_notes(pipeline),
    }


def _sensor_notes(pipeline: RunPipeline) -> dict[str, Any]:
    """Return the summaries of sensors and impact, and all notes; empty summaries are left out."""
    rows = sensor_summary(pipeline)
    notes = [*pipeline.get("displacement").notes, *rows.pop("notes")]
    return {key: row for key, row in rows.items() if row} | {"notes": notes}


# --- what is outdated


def stored_report_key(path: Path) -> re.Match[str] | None:
    """Return the key in the head of a report: hash of all inputs, hash of the results (group 1), current model (2)."""
    if not path.exists():
        return None
    with path.open("rb") as file:
        return REPORT_KEY.search(file.read(HEAD_BYTES).decode(errors="replace"))


def results_key(models: TriedModels) -> str:
    """Return the hash of the results that a report shows, as they are stored: runs, current model, its diagnosis."""
    group = models.current_group
    made = [(p.run.name, p.provenance("motion"), p.provenance("friction")) for p in models.pipelines]
    runs = [[name, *(stage.key if stage else "" for stage in stages)] for name, *stages in made]
    return digest([group, models.content_key(f"models/{group}"), runs])


def find_outdated(models: TriedModels) -> tuple[OutdatedPart, ...]:
    """Find outdated results: runs, models with their diagnosis, the report.

    The recordings are not opened: a change of their content is noticed when the work is done again.
    """
    runs = list(_outdated_runs(models.pipelines))
    current = list(_outdated_models(models, runs))
    return (*runs, *current, *_outdated_report(models, current))


def _outdated_runs(pipelines: Sequence[RunPipeline]) -> Iterator[OutdatedPart]:
    for pipeline in pipelines:
        by_stage = {stage: pipeline.changed_settings(stage) for stage in pipeline.stages}
        first = {key: stage for stage, changed in reversed(by_stage.items()) for key in changed}
        clauses = {key: _change(key, *values) for changed in by_stage.values() for key, values in changed.items()}
        if clauses:
            picture = any(stage in PICTURE_STAGES for stage in first.values())
            yield OutdatedPart("track" if picture else "motion", pipeline.run.name, "; ".join(clauses.values()), "run")


def _change(key: str, then: Any, now: Any) -> str:
    """Describe a changed key: with both values where they are short."""
    before, after = _value(key, then), _value(key, now)
    if before and after:
        return f"{key} was changed from {before} to {after}"
    name = "a repair" if key == "repair" else key
    return f"{name} was {'removed' if now is None else 'added' if then is None else 'changed'}"


def _value(key: str, value: Any) -> str:
    """Write a mass, a frame rate or a scale as it is read; "" for everything else."""
    if key == "mass" and isinstance(value, list):
        return f"{format_plus_minus(*value) if value[1] else format_number(value[0])} kg"
    if key == "fps" and isinstance(value, int | float):
        return f"{value:g} /s"
    return value if key == "scale" and isinstance(value, str) else ""


def _outdated_models(models: TriedModels, runs: Sequence[OutdatedPart]) -> Iterator[OutdatedPart]:
    by_reason: dict[str, list[str]] = {}  # each changed key once, with the names of its runs
    for run in runs:
        by_reason.setdefault(run.reason, []).append(run.name)
    changed_keys = [f"{reason} ({first_words(names)})" for reason, names in by_reason.items()]
    current = models.current_group
    for group in models.groups:
        made = store.provenance(models.path, f"models/{group}") or Provenance()
        reasons = [*_changed_inputs(models.pipelines, json.loads(made.inputs or "[]")), *changed_keys]
        if not reasons and models.is_outdated(group):
            same_runs = made.input_hash == models.input_hash
            what = "the settings of effects in the study file" if same_runs else "masses, roles or groups of runs"
            reasons.append(f"{what} were changed")
        if not reasons and group == current and models.is_current_outdated():
            reasons.append("the study file names another model")
        if reasons:
            yield OutdatedPart("model", group, "; ".join(reasons), "run")
            if store.provenance(models.path, f"models/{group}/diagnosis") is not None:
                yield OutdatedPart("diagnosis", group, "; ".join(reasons), "run")


def _changed_inputs(pipelines: Sequence[RunPipeline], inputs: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield how the runs of a model differ from the runs of the study."""
    then = {str(name): str(key) for name, key in inputs}
    fitted = {name.rpartition(".h5:/")[0] for name in then}
    now = {pipeline.path.name.removesuffix(".h5"): pipeline for pipeline in pipelines}
    added, removed = [name for name in now if name not in fitted], sorted(fitted - now.keys())
    if added:
        yield f"it was fitted without {first_words(added)}"
    if removed:
        yield f"it was fitted with {first_words(removed)}, which the study no longer has"
    pairs = [(name, stage) for name in now if name in fitted for stage in ("friction", "motion")]
    different = [name for name, stage in pairs if then.get(f"{name}.h5:/{stage}") != now[name].key(stage)]
    if again := list(dict.fromkeys(different)):
        yield f"{first_words(again)} {'was' if len(again) == 1 else 'were'} measured again since it was fitted"


def _outdated_report(models: TriedModels, outdated: Sequence[OutdatedPart]) -> Iterator[OutdatedPart]:
    """Yield the report if it does not show the results of now."""
    path, group = models.study.output / "report.html", models.current_group
    if group is None or not path.exists():
        return
    found = stored_report_key(path)
    reason = next((one.reason for one in outdated if one.name == group), "")
    if found is None:
        reason = "an earlier version of frictrack wrote it"
    elif found[2] != group:
        reason = f"it was written for {plain_name(found[2])}, but {plain_name(group)} is the current model"
    elif found[1] != results_key(models):
        reason = "results were computed again since it was written"
    if reason:
        yield OutdatedPart("report", "", reason, "report")


# --- all results


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
    """Read the results of a study again and again; what has not changed in the files is read once."""

    def __init__(self, *, with_budgets: bool = True) -> None:
        self.with_budgets = with_budgets
        self._kept: dict[Any, tuple[Any, Any]] = {}  # by what it is: what it depends on, and the object itself

    def _keep(self, what: Any, key: Any, make: Callable[[], Any]) -> Any:
        """Return the same object as the last time, unless its key is another one."""
        if what not in self._kept or self._kept[what][0] != key:
            self._kept[what] = (key, make())
        return self._kept[what][1]

    def read(self, study: Study) -> Results:
        """Read the results of a study as they are stored; see `read_results`."""
        models = stored_models(study)
        pipelines = models.pipelines
        # before the files are opened: one that is replaced in between is then read again the next time
        states = {p.run.name: (p.run, str(p.path), store.file_state(p.path)) for p in pipelines if p.path.exists()}
        with store.snapshot(models.path, *(pipeline.path for pipeline in pipelines)):
            results = tuple(self._model(models, group) for group in models.groups)
            current = next((model for model in results if model.current), None)
            has_papers = "papers" in store.names(models.path)
            outdated = find_outdated(models)
            # implausible numbers are old once a number of a run was changed, until it is measured
            is_changed = any(part.what in ("track", "motion") for part in outdated)
            return Results(
                name=study.name,
                path=study.path,
                output=study.output,
                version=__version__,
                runs=self._runs(models, states),
                models=results,
                comparison=models.stored_summary("comparison"),
                diagnosis=current.diagnosis if current else None,
                figures=current.figures if current else {},
                papers=self._model(models, "papers") if has_papers else None,
                implausible=() if is_changed else tuple(stored_findings(models.path, pipelines) or ()),
                outdated_parts=outdated,
            )

    def _model(self, models: TriedModels, group: str) -> ModelResults:
        """Read a model, unless its stored content is that of the last time."""
        key = models.content_key(group if group == "papers" else f"models/{group}")
        return self._keep(("model", group), key, lambda: model_results(models.path, group))

    def _runs(self, models: TriedModels, states: Mapping[str, Any]) -> tuple[RunResults, ...]:
        """Read all measured runs; one that repeats another one gets a note, one with repairs says by whom."""
        stored = [pipeline for pipeline in models.pipelines if pipeline.run.name in states]
        measured = [p for p in stored if all(map(p.is_current, p.stages.keys() - OPTIONAL_STAGES))]
        runs: dict[str, RunResults] = {}
        for p in measured:
            make = partial(run_results, p, with_budget=self.with_budgets)
            runs[p.run.name] = self._keep(("run", p.run.name), states[p.run.name], make)
        contents = {name: run.film.hash for name, run in runs.items() if run.film is not None}
        displacements = {name: run.displacement for name, run in runs.items()}
        read = {name: states[name] for name in runs}
        frictions = {k: None if run.sensors is None else run.sensors.friction_N for k, run in runs.items()}
        twice = self._keep("twice", read, lambda: duplicate_notes(displacements, contents, frictions))
        authors = _repair_authors(models.commands) if any(p.run.repair for p in measured) else {}
        found = []
        for name, run in runs.items():
            notes = [said[name] for said in (twice, authors) if name in said]
            noted = partial(replace, run, notes=(*run.notes, *notes))
            found.append(self._keep(("noted", name), (states[name], notes), noted) if notes else run)
        return tuple(found)

    def attempts(self, study: Study, names: Iterable[str]) -> dict[str, ModelResults]:
        """Return the fits of the current model with one more effect that `Session.attempt` stored, by effect."""
        models = stored_models(study)
        found: dict[str, ModelResults] = {}
        with store.snapshot(models.path, *(pipeline.path for pipeline in models.pipelines)):
            group = models.current_group
            for name in names if group is not None else ():
                # the name of its file is the hash of all that its content depends on
                if stored := models.stored_attempt(models.request(str(group)).edited(f"+{name}")):
                    found[name] = self._keep(("attempt", name), stored, partial(model_results, *stored))
        return found


def _repair_authors(history: CommandHistory) -> dict[str, str]:
    """Return by run who changed its repairs last, and when; a change by hand in the study file is not recorded."""
    done, _ = result_or_none(history.undo_stacks) or ([], [])  # a damaged log must not hide the results
    edits = [change for change in done if change.command == "edit" and change.arguments.get("key") == "repair"]
    last = {str(change.arguments["which"]): change for change in edits if change.arguments.get("value")}
    return {run: f"repairs set from {change.author} at {change.time}" for run, change in last.items()}


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
    return measure.motion.derivatives(measure.motion.low_pass(course, method=choice, acceleration=acceleration))


def run_results(pipeline: RunPipeline, *, with_budget: bool = True) -> RunResults:
    """Read all stored stages of one run, with its notes, quality and, if asked for, error budget."""
    done = {name: pipeline.get(name) for name in pipeline.stages if pipeline.is_current(name)}
    hashed = tuple(done)
    if "repaired" in pipeline.stages:
        done["track"] = done.pop("repaired", done.get("track"))  # a repair that was not computed yet
    quality = film_quality(pipeline)
    notes = [note for name in ("recording", "track", "displacement") for note in getattr(done.get(name), "notes", ())]
    notes += sensor_summary(pipeline)["notes"]
    return RunResults(
        name=pipeline.run.name,
        source=pipeline.as_written(pipeline.run.source),
        film=done.pop("recording", None),
        **done,
        quality=quality,
        budget=run_budget(pipeline, quality) if with_budget else {},
        role=pipeline.run.role,
        group=pipeline.run.group,
        settings={k: pipeline.as_written(v) for k, v in pipeline.run if v not in (None, "", {}, [])},
        hashes={name: pipeline.key(name) for name in hashed},
        notes=tuple(dict.fromkeys(notes)),
    )
