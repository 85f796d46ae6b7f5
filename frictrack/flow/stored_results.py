"""Read the results of a study from its HDF5 files alone: nothing is measured, fitted or checked again.

    results = read_results(open_study("study.toml"))

A run that was not measured completely is left out; a model that was not diagnosed has no diagnosis.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.base.number_format import format_number, format_plus_minus
from frictrack.base.version import __version__
from frictrack.flow import store
from frictrack.flow.command_history import CommandHistory
from frictrack.flow.film_stages import BACKWARD, REFERENCE, contact_sheet_path, min_shake_px, overlay_path
from frictrack.flow.pipeline import RunPipeline, digest, no_progress
from frictrack.flow.plausibility_checks import duplicate_notes, find_duplicate_runs, stored_findings
from frictrack.flow.sensor_stage import fused_acceleration, sensor_summary
from frictrack.flow.stages import run_pipeline
from frictrack.flow.store import Provenance
from frictrack.flow.summaries import CutoffSummary, Events
from frictrack.flow.track_quality import residual_shake, track_quality
from frictrack.flow.tried_models import FitRequest, TriedModels, model_results
from frictrack.measure.error_budget import budget
from frictrack.measure.motion import derivatives, low_pass
from frictrack.records import Array, CutoffTradeOff, Displacement, Friction, Motion, RunEvents
from frictrack.results import ModelResults, OutdatedPart, Results, RunResults, to_builtins
from frictrack.settings.filters import STRUCTURAL, FilterChoice
from frictrack.study import Study

if TYPE_CHECKING:
    from frictrack.flow.pipeline import RunPipeline


def run_budget(pipeline: RunPipeline, known: dict[str, Any] | None = None) -> dict[str, Any]:
    """Compute the error budget of the friction force of one run."""
    run = pipeline.to_run()
    if run.mass is None and run.friction_N is None:
        return {}
    film = pipeline.get("recording") if pipeline.run.video else None
    if film is not None:
        known = (known or film_quality(pipeline)) | _residual_shake(pipeline)
    found = budget(run, pipeline.get("filtered"), known, film, pipeline.get("sensors").clocks)
    made: dict[str, Any] = to_builtins(found.summary())
    return made


def film_quality(pipeline: RunPipeline) -> dict[str, Any]:
    """Return `track_quality` of a film as JSON; empty for a table of positions."""
    if not pipeline.run.video:
        return {}
    pitch = pipeline.get("displacement").pixel_pitch
    found = track_quality(pipeline.get("recording"), pipeline.final_track, pipeline.get("tracks"), pitch)
    return dict(to_builtins(found))


def _residual_shake(pipeline: RunPipeline) -> dict[str, Any]:
    """Return the camera shake that may be left in the displacement, px rms along x."""
    left = residual_shake(pipeline.get("tracks").get(REFERENCE), min_shake_px(pipeline.run))
    return {} if left is None else dict(zip(("shake_Hz", "shake_left_px", "shake_left_told"), left, strict=True))


def run_summaries(pipelines: list[RunPipeline], stage: str) -> list[dict[str, Any]]:
    """Return the rows of all runs for one stage.

    Parameters
    ----------
    pipelines
        The runs, brought up to date up to the stage.
    stage
        ``"track"``, ``"motion"`` or ``"friction"``.

    Returns
    -------
    list of dict
        One row per run, as JSON; a table of positions has no row for ``"track"``.

    """
    describe = {"track": _track_summary, "motion": _motion_summary, "friction": _friction_summary}[stage]
    made: list[dict[str, Any]] = to_builtins(
        [{"run": pipeline.run.name, **describe(pipeline)} for pipeline in pipelines if stage in pipeline.stages]
    )
    if stage == "track":  # a track that cannot be calibrated has no displacement to compare
        return made
    twice = find_duplicate_runs(pipelines)
    return [{**row, "notes": [*row["notes"], *filter(None, [twice.get(row["run"])])]} for row in made]


def _track_summary(pipeline: RunPipeline) -> dict[str, Any]:
    """Describe how well a film was measured, and where its pictures are."""
    from frictrack.measure.repairing import suspect_spans  # noqa: PLC0415 - loads OpenCV; tables do without
    from frictrack.tracking import target_line  # noqa: PLC0415

    displacement, notes = _displacement_and_notes(pipeline)
    pitch = displacement.pixel_pitch if displacement else None
    track, tracks = pipeline.final_track, pipeline.get("tracks")
    return {
        **track_quality(pipeline.get("recording"), track, tracks, pitch),
        "suspects": [vars(span) for span in suspect_spans(track, tracks.get(BACKWARD))],
        "target": target_line(track),
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
        **_events_summary(pipeline),
        **_sensor_notes(pipeline),
    }


def _cutoff_summary(pipeline: RunPipeline) -> CutoffSummary:
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


def _events_summary(pipeline: RunPipeline) -> Events:
    """List release, impacts, stops, starts and reversals, and the noise while the mass rests."""
    found: RunEvents = pipeline.get("events")
    noise = found.noise_at_rest
    return {
        "events": [{"kind": kind, "from_s": begins, "to_s": ends} for kind, begins, ends in found.events],
        "noise_at_rest_um": 1e6 * noise if np.isfinite(noise) else None,
    }


def _friction_summary(pipeline: RunPipeline) -> dict[str, Any]:
    """Describe the friction force and the free section."""
    friction: Friction = pipeline.get("friction")
    motion: Motion = pipeline.get("motion")
    free = friction.free
    judged = friction.t[free]
    resisting = friction.F * np.sign(motion.v)
    return {
        "free_from_s": float(judged[0]) if len(judged) else None,
        "free_to_s": float(judged[-1]) if len(judged) else None,
        "mean_F_N": float(np.mean(resisting[free])) if len(judged) else None,
        "sigma_F_N": float(np.median(friction.sigma_F[free])) if len(judged) else None,
        "reason": friction.reason,
        **_budget_summary(pipeline),
        **_sensor_notes(pipeline),
    }


def _budget_summary(pipeline: RunPipeline) -> dict[str, Any]:
    """Return the error budget of the friction force, the total last, and what would make it smaller."""
    found = run_budget(pipeline)
    return {"budget": found["rows"], "budget_says": found["says"]} if found else {}


def _sensor_notes(pipeline: RunPipeline) -> dict[str, Any]:
    """Return the summaries of sensors and impact, and all notes; empty summaries are left out."""
    rows: dict[str, Any] = {**sensor_summary(pipeline)}
    notes = [*pipeline.get("displacement").notes, *rows.pop("notes")]
    return {key: row for key, row in rows.items() if row} | {"notes": notes}


PICTURE_STAGES = ("recording", "track", "tracks")  # whose results are the positions in the picture
HEAD_BYTES = 2000  # of a report, in which its key stands
REPORT_KEY = re.compile(r"[0-9a-f]{64} ([0-9a-f]{64}) ([^\"<>]+)")  # all inputs, the results, the current model
MAX_NAMES = 3  # runs named in a reason
OPTIONAL_STAGES = ("cutoff", "friction", "events", "repaired")  # not needed by a fit, or not for what is shown


def report_key(inputs: str, results: str, group: str) -> str:
    """Return the key in the head of a report: hash of all inputs, hash of the results, name of the current model."""
    return f"{inputs} {results} {group}"


def stored_report_key(path: Path) -> re.Match[str] | None:
    """Return the key in the head of a report, its parts as groups 1 (results) and 2 (current model)."""
    if not path.exists():
        return None
    with path.open("rb") as file:
        return REPORT_KEY.search(file.read(HEAD_BYTES).decode(errors="replace"))


def results_key(models: TriedModels, pipelines: Iterable[RunPipeline]) -> str:
    """Return the hash of the results that a report shows, as they are stored: runs, current model, its diagnosis."""
    group = models.current_group
    made = [(p.run.name, p.provenance("motion"), p.provenance("friction")) for p in pipelines]
    runs = [[name, *(stage.key if stage else "" for stage in stages)] for name, *stages in made]
    return digest([group, store.checksum(models.path, f"models/{group}"), runs])


def find_outdated(pipelines: Sequence[RunPipeline], models: TriedModels) -> tuple[OutdatedPart, ...]:
    """Find outdated results: runs, models with their diagnosis, the report.

    The recordings are not opened: a change of their content is noticed when the work is done again.
    """
    runs = list(_outdated_runs(pipelines))
    current = list(_outdated_models(pipelines, models, runs))
    return (*runs, *current, *_outdated_report(pipelines, models, current))


# --- runs


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


# --- models


def _outdated_models(
    pipelines: Sequence[RunPipeline], models: TriedModels, runs: Sequence[OutdatedPart]
) -> Iterator[OutdatedPart]:
    current = models.current_group
    for group in models.groups:
        reason = _why_outdated(pipelines, models, group, runs, is_current=group == current)
        if not reason:
            continue
        yield OutdatedPart("model", group, reason, "run")
        if store.provenance(models.path, f"models/{group}/diagnosis") is not None:
            yield OutdatedPart("diagnosis", group, reason, "run")


def _why_outdated(
    pipelines: Sequence[RunPipeline],
    models: TriedModels,
    group: str,
    runs: Sequence[OutdatedPart],
    *,
    is_current: bool,
) -> str:
    """Return why a model is outdated; "" if it is not."""
    made = store.provenance(models.path, f"models/{group}") or Provenance()
    reasons = list(_changed_inputs(pipelines, json.loads(made.inputs or "[]")))
    if runs:
        reasons.append(_run_changes(runs))
    if not reasons and models.is_outdated(group):
        same_runs = made.input_hash == models.input_hash
        reasons.append(
            "the settings of effects in the study file were changed"
            if same_runs
            else "masses, roles or groups of runs were changed"
        )
    if is_current and not reasons and models.is_current_outdated():
        reasons.append("the study file names another model")
    return "; ".join(reasons)


def _changed_inputs(pipelines: Sequence[RunPipeline], inputs: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield how the runs of a model differ from the runs of the study."""
    then = {str(name): str(key) for name, key in inputs}
    fitted = {name.rpartition(".h5:/")[0] for name in then}
    now = {pipeline.path.name.removesuffix(".h5"): pipeline for pipeline in pipelines}
    added, removed = [name for name in now if name not in fitted], sorted(fitted - now.keys())
    if added:
        yield f"it was fitted without {_names(added)}"
    if removed:
        yield f"it was fitted with {_names(removed)}, which the study no longer has"
    again = [name for name in now if name in fitted and _was_measured_again(now[name], then)]
    if again:
        yield f"{_names(again)} {'was' if len(again) == 1 else 'were'} measured again since it was fitted"


def _was_measured_again(pipeline: RunPipeline, then: Mapping[str, str]) -> bool:
    return any(then.get(f"{pipeline.path.name}:/{stage}") != pipeline.key(stage) for stage in ("friction", "motion"))


def _run_changes(runs: Sequence[OutdatedPart]) -> str:
    """Describe the changed keys of the runs, each clause once with the names of its runs."""
    by_reason: dict[str, list[str]] = {}
    for run in runs:
        by_reason.setdefault(run.reason, []).append(run.name)
    return "; ".join(f"{reason} ({_names(names)})" for reason, names in by_reason.items())


def _names(names: Sequence[str]) -> str:
    more = len(names) - MAX_NAMES
    return ", ".join(names[:MAX_NAMES]) + (f" and {more} more" if more > 0 else "")


# --- the report


def _outdated_report(
    pipelines: Sequence[RunPipeline], models: TriedModels, outdated: Sequence[OutdatedPart]
) -> Iterator[OutdatedPart]:
    path = models.study.output / "report.html"
    group = models.current_group
    if group is None or not path.exists():
        return
    reason = _report_reason(path, results_key(models, pipelines), group)
    if not reason and any(one.name == group for one in outdated):
        reason = next(one.reason for one in outdated if one.name == group)
    if reason:
        yield OutdatedPart("report", "", reason, "report")


def _report_reason(path: Path, results: str, group: str) -> str:
    """Return why a report does not show the results of now; "" if it does."""
    found = stored_report_key(path)
    if found is None:
        return "an earlier version of frictrack wrote it"
    if found[2] != group:
        from frictrack.present.plots import plain_name  # noqa: PLC0415 - loads matplotlib

        return f"it was written for {plain_name(found[2])}, but {plain_name(group)} is the current model"
    return "" if found[1] == results else "results were computed again since it was written"


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
    quality = film_quality(pipeline)
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
