"""Find stored results that do not belong to the study file or the current model of now, with the reason in words."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from frictrack import store
from frictrack.flow.pipeline import RunPipeline, digest
from frictrack.flow.tried_models import TriedModels
from frictrack.number_format import format_number, format_plus_minus
from frictrack.results import OutdatedPart
from frictrack.store import Provenance

PICTURE_STAGES = ("recording", "track", "tracks")  # whose results are the positions in the picture
HEAD_BYTES = 2000  # of a report, in which its key stands
REPORT_KEY = re.compile(r"[0-9a-f]{64} ([0-9a-f]{64}) ([^\"<>]+)")  # all inputs, the results, the current model
MAX_NAMES = 3  # runs named in a reason


def report_key(inputs: str, results: str, group: str) -> str:
    """Return the key in the head of a report: hash of all inputs, hash of the results, name of the current model.

    Parameters
    ----------
    inputs, results
        Hash of everything that the report depends on, and `results_key`.
    group
        Group of the current model.

    """
    return f"{inputs} {results} {group}"


def stored_report_key(path: Path) -> re.Match[str] | None:
    """Return the key in the head of a report, its parts as groups 1 (results) and 2 (current model).

    Parameters
    ----------
    path
        The report; None is returned if it does not exist, or has no key.

    """
    if not path.exists():
        return None
    with path.open("rb") as file:
        return REPORT_KEY.search(file.read(HEAD_BYTES).decode(errors="replace"))


def results_key(models: TriedModels, pipelines: Iterable[RunPipeline]) -> str:
    """Return the hash of the results that a report shows, as they are stored: runs, current model, its diagnosis.

    Parameters
    ----------
    models, pipelines
        The models tried, and the runs.

    """
    group = models.current_group
    runs = [[p.run.name, *(_stored_key(p.path, name) for name in ("motion", "friction"))] for p in pipelines]
    return digest([group, store.checksum(models.path, f"models/{group}"), runs])


def _stored_key(path: Path, stage: str) -> str:
    found = store.provenance(path, stage)
    return found.key if found else ""


def find_outdated(pipelines: Sequence[RunPipeline], models: TriedModels) -> tuple[OutdatedPart, ...]:
    """Find outdated results: runs, models with their diagnosis, the report.

    The recordings are not opened: a change of their content is noticed when the work is done again.

    Parameters
    ----------
    pipelines
        The runs, with `stored_only`.
    models
        The models tried on them.

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
        from frictrack.plots import plain_name  # noqa: PLC0415 - loads matplotlib

        return f"it was written for {plain_name(found[2])}, but {plain_name(group)} is the current model"
    return "" if found[1] == results else "results were computed again since it was written"
