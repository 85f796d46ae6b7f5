"""Say everything that the page shows about a study, as plain JSON; no web framework, and nothing is computed.

state = state_of(SnapshotReader(Path("study.toml")).read())

snapshot   read study file, results, history and recordings as their files are; mass, frame rate and scale as read
models     models tried, outdated results; parameters, settings, verdict and candidates of the current model

Here all of it, with the runs, what is missing before the analysis can run, and the changes in plain words.
"""

# ruff: noqa: F401 - the imports are the interface

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from frictrack.base.number_format import format_number, join_words, lower_first, upper_first
from frictrack.effects.models import names_in
from frictrack.flow import Change, Surveyed, contact_sheet_path, undo_stacks
from frictrack.measure.repairing import suspect_spans
from frictrack.present.report import failed_checks, is_good
from frictrack.records import CutoffTradeOff
from frictrack.results import RunResults, to_builtins
from frictrack.results.candidates import joined_name, numbered_name
from frictrack.results.verdicts import CHECK_FIRST, describe_lost, describe_tests
from frictrack.settings.filters import FILTERS, STRUCTURAL
from frictrack.settings.filters import SETTINGS as FILTER_SETTINGS
from frictrack.study import FILMS, TABLES, RunTable, Study
from frictrack.workbench.summaries.models import (
    candidate_curves,
    current_model,
    effect_library,
    list_models,
    list_outdated,
    report_state,
    searches,
    summarise_diagnosis,
)
from frictrack.workbench.summaries.snapshot import (
    KEYS,
    NAMES,
    Snapshot,
    SnapshotReader,
    check_fields,
    list_recordings,
    missing_fields,
    new_study,
    refuse_implausible,
    source_version,
    study_fields,
    surveyed_source,
)

AUTHORS = {"cli": "command line", "page": "page", "python": "Python"}
KEY_NAMES = {"fps": "frame rate", "free": "free section", "cutoff": "cut-off", "causal": "forward only",
             "repair": "repairs", "fix": "fixed values"}  # fmt: skip
ALL_RUNS = ("study", "camera", "motion")  # tables whose keys hold for all runs
MAX_VALUE_TEXT = 60  # characters


def summarise_history(snapshot: Snapshot) -> dict[str, Any]:
    """Tell the history of a study: its changes, oldest first, sentences on the tests made, and what can be undone."""
    changes = snapshot.changes
    try:
        done, undone = undo_stacks(changes)
    except ValueError:  # a damaged log: Undo itself says so
        done, undone = [], []
    return {
        "entries": [_entry(change, changes) for change in changes],
        "tests": describe_tests(snapshot.tests),
        "can_undo": bool(done),
        "can_redo": bool(undone),
        "undo_words": f"Undo: {change_words(done[-1])}" if done else "",
        "redo_words": f"Redo: {change_words(undone[-1])}" if undone else "",
    }


def change_words(change: Change) -> str:
    """Describe one change of a study in plain words.

    Parameters
    ----------
    change
        The change.

    Examples
    --------
    >>> change_words(Change(1, "", "page", "add", {"effect": "texture", "seed": 0}))
    'add texture to the model'

    """
    describe = _WORDS.get(change.command)
    try:
        return describe(change.arguments) if describe else change.text
    except (KeyError, TypeError, AttributeError):  # arguments of another version
        return change.text


def _entry(change: Change, changes: Sequence[Change]) -> dict[str, Any]:
    words = change_words(change)
    if change.command in ("undo", "redo"):
        of = change.arguments.get("of")
        target = changes[of - 1] if isinstance(of, int) and 0 < of <= len(changes) else None
        words = f"{change.command}: {change_words(target)}" if target else change.command
    author = AUTHORS.get(change.author, change.author)
    return {"n": change.revision, "words": upper_first(words), "author": author, "at": change.time}


# --- words of each command


def _edit(arguments: Mapping[str, Any]) -> str:
    key, value, which, table = (arguments.get(name) for name in ("key", "value", "which", "table"))
    name = KEY_NAMES.get(str(key), str(key).replace("_", " "))
    whose = f"of {which}" if which else "of all runs" if table in ALL_RUNS and key in ("mass", "fps", "scale") else ""
    what = f"{name} {whose}".strip()
    if key == "repair" and value:
        spans = ", ".join(f"{one['from']} to {one['to']}" for one in value)
        return f"repair the frames {spans} of {which}"
    if not value and value != 0:
        return f"remove the {what}"
    is_short = not isinstance(value, dict) and len(str(value)) <= MAX_VALUE_TEXT
    return f"set the {what} to {_value(key, value)}" if is_short else f"set the {what}"


def _value(key: Any, value: Any) -> str:
    if isinstance(value, list):
        return " to ".join(map(str, value)) if key == "free" else f"[{', '.join(map(str, value))}]"
    units = {"mass": " kg", "fps": " /s", "scale": " m/px"}
    return f"{value:g}{units.get(str(key), '')}" if isinstance(value, int | float) else str(value)


def _fit(arguments: Mapping[str, Any]) -> str:
    model = arguments.get("model")
    name = joined_name(names_in(model)) if isinstance(model, str) and model else "the model"
    how = ", ".join(f"{key} {arguments[key]}" for key in ("domain", "search", "per") if arguments.get(key))
    return f"fit {name} ({how})" if how else f"fit {name}"


_WORDS: dict[str, Callable[[Mapping[str, Any]], str]] = {
    "edit": _edit,
    "take_in": lambda a: f"add the recordings {', '.join(a['recordings'])}",
    "leave_out": lambda a: f"remove the run {a['run']}",
    "define": lambda a: f"define the effect {a['effect']['effect']}",
    "use": lambda a: f"make {numbered_name(a['model'])} the current model",
    "fit": _fit,
    "add": lambda a: f"add {a['effect']} to the model",
    "remove": lambda a: f"remove {a['effect']} from the model",
    "restart": lambda a: "remove all models",
}


def _study_keys(study: Study | None) -> dict[str, str]:
    if study is None:
        return {}
    conditions = ", ".join(f"{name} = {value}" for name, value in study.conditions.items())
    prior = os.path.relpath(study.prior_file, study.path.parent) if study.prior_file else ""
    return {"prior": prior, "conditions": conditions, "functions": "; ".join(study.functions)}


def state_of(snapshot: Snapshot) -> dict[str, Any]:
    """Return everything that the page shows of a study; the server adds its own version, its id and the jobs.

    Parameters
    ----------
    snapshot
        The study as its files are.

    Returns
    -------
    dict
        JSON-serialisable. `error` says why the study file or the results cannot be read, `keys` has keys of the study
        file as they are typed on the page, `check_first` has sentences on implausible numbers: no verdict is better
        than they are. The other keys are described where their values are made.

    """
    runs = summarise_runs(snapshot)
    implausible = snapshot.results.warnings if snapshot.results else ()
    state: dict[str, Any] = to_builtins(
        {
            "revision": len(snapshot.changes),
            "path": str(snapshot.path),
            "folder": str(snapshot.path.parent),
            "exists": snapshot.path.exists(),
            "name": snapshot.study.name if snapshot.study else snapshot.path.resolve().parent.name,
            "error": snapshot.error,
            "recordings": list_recordings(snapshot),
            "suffixes": [*FILMS, ".cih", ".cihx", *TABLES],
            "fields": study_fields(snapshot),
            "keys": _study_keys(snapshot.study),
            "ready": readiness(snapshot, runs),
            "runs": runs,
            "models": list_models(snapshot),
            "model": current_model(snapshot),
            "diagnosis": summarise_diagnosis(snapshot),
            "check_first": [f"{CHECK_FIRST} {words}." for words in implausible],
            "outdated": list_outdated(snapshot),
            "report": report_state(snapshot),
            "history": summarise_history(snapshot),
        }
    )
    return state


MAX_CACHED_RUNS = 1000
MAX_SUSPECT_SPANS = 50
NOT_MEASURED: dict[str, Any] = {
    **{"n_frames_lost": 0, "lost_words": "", "motion": None},
    **{key: [] for key in ("suspect", "checks", "notes", "warnings")},
}


def summarise_runs(snapshot: Snapshot) -> list[dict[str, Any]]:
    """Describe every run of the study file."""
    if snapshot.study is None:
        return []
    measured = {run.name: run for run in snapshot.results.runs} if snapshot.results else {}
    study = snapshot.study
    return [_run(snapshot, study, i, run, measured.get(run.name)) for i, run in enumerate(study.runs)]


def _run(snapshot: Snapshot, study: Study, index: int, run: RunTable, results: RunResults | None) -> dict[str, Any]:
    sheet = contact_sheet_path(study, run.name)
    return {
        "name": run.name,
        "file": _file_name(run, study),
        "kind": "film" if run.video else "table",
        "index": index,
        "film": _film(run, results),
        "fields": study_fields(snapshot, run),
        "shapes": _shapes(run, results),
        "repairs": [repair.to_dict() for repair in run.repair],
        "state": "measured" if results else "tracked" if sheet.exists() else "new",
        "has_sheet": bool(run.video) and sheet.exists(),
        **(_measured_part(results) if results else NOT_MEASURED),
    }


def _file_name(run: RunTable, study: Study) -> str:
    source = run.source
    if isinstance(source, Path) and source.is_relative_to(study.folder):
        return source.relative_to(study.folder).as_posix()
    return str(source)


def _film(run: RunTable, results: RunResults | None) -> dict[str, Any] | None:
    """Return frames, size, frame rate and version of a film; None for a table."""
    if not run.video:
        return None
    stored = results.film if results else None
    seen = surveyed_source(run.video) or Surveyed(Path(), n_frames=stored.n_frames if stored else 0)
    fps = stored.fps if stored else run.fps or seen.fps
    size = dict(zip(("height", "width"), seen.shape, strict=True))
    return {"frames": seen.n_frames, "fps": fps, "version": source_version(run.video)} | size


def _shapes(run: RunTable, results: RunResults | None) -> dict[str, Any]:
    """Return the shapes of the study file, px: None where nothing was drawn; and the target that was found."""
    ruler = run.scale.get("points") if isinstance(run.scale, dict) and "length" in run.scale else None
    track = results.track if results else None
    return {
        "target": run.target if isinstance(run.target, tuple) else None,
        "reference": run.reference if isinstance(run.reference, tuple) else None,
        "ruler": ruler,
        "exclude": run.exclude,
        "obstacles": run.obstacles,
        "found": track.target if track else None,
        "template": run.template or 0,
    }


# --- what depends on stored results only


@lru_cache(maxsize=MAX_CACHED_RUNS)
def _measured_part(run: RunResults) -> dict[str, Any]:
    """Describe a measured run; `RunResults` are compared by identity, so that an unchanged run is described once."""
    checks, audit = failed_checks(run) if run.quality else [], run.film.audit if run.film else ()
    smeared = list(run.cutoff.warnings) if run.cutoff else []  # a warning only where a cut-off was asked for
    lost = 0 if run.track is None else int((~run.track.found).sum())
    return {
        "n_frames_lost": lost,
        "lost_words": "" if run.track is None else f"{upper_first(describe_lost(lost, len(run.track)))}.",
        "suspect": suspect_frames(run),
        "checks": [{"check": check, "value": value, "verdict": v, "ok": is_good(v)} for check, value, v in audit],
        "notes": [*run.notes, *([] if run.filtered.asked else smeared)],
        "warnings": [*checks, *(smeared if run.filtered.asked else [])],
        "motion": _motion(run),
    }


def suspect_frames(run: RunResults) -> list[dict[str, int | str]]:
    """List the spans of frames of a film that a person should look at.

    Parameters
    ----------
    run
        The run; one without a film has none.

    Returns
    -------
    list of dict
        "from" and "to", numbers of frames in the film, both included, and "words"; at most `MAX_SUSPECT_SPANS`.

    """
    spans = suspect_spans(run.track, run.tracks.get("backward"))[:MAX_SUSPECT_SPANS] if run.track else ()
    return [{"from": span.first, "to": span.last, "words": span.words} for span in spans]


def _motion(run: RunResults) -> dict[str, Any]:
    """Describe smoothing, free section (ms, and why it begins and ends there) and cut-off."""
    friction, free = run.friction, None
    if friction is not None:
        t = 1e3 * friction.t[friction.free]
        begin, end = (float(t[0]), float(t[-1])) if len(t) else (None, None)
        free = {"from_ms": begin, "to_ms": end, "reason": friction.reason}
    return {
        "smoothed_by": run.filtered.reason,
        "filters": {name: {"words": words, "takes": takes} for name, (words, takes) in FILTERS.items()},
        "filter": {"filter": STRUCTURAL} | {k: run.settings[k] for k in FILTER_SETTINGS if k in run.settings},
        "free": free,
        "cutoff": _cutoff(run, run.cutoff) if run.cutoff else None,
    }


def _cutoff(run: RunResults, trade: CutoffTradeOff) -> dict[str, Any]:
    """Return the cut-off frequencies to choose from, each with the noise that passes and the signal that is lost."""
    factor, unit = (run.mass, "N") if run.mass else (1.0, "m/s²")
    separated = format_number(factor * trade.structural)
    return {
        "asked": run.settings.get("cutoff"),
        "chosen": trade.chosen,
        "options": [round(float(f), 1) for f in trade.frequency],
        "noise": [float(f"{factor * v:.4g}") for v in trade.noise],
        "lost": [float(f"{factor * v:.4g}") for v in trade.lost],
        "unit": unit,
        "words": f"total error with trend, vibrations and events separated {separated} {unit}",
    }


def readiness(snapshot: Snapshot, runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Say whether Run can be pressed: can_run, the missing fields by name, and what to do, as a sentence (words)."""
    missing, words = _what_is_missing(snapshot, runs)
    done = "Run measures the films, fits the model and names what it lacks."
    return {"can_run": words is None, "missing": missing, "words": words or done}


def _what_is_missing(snapshot: Snapshot, runs: Sequence[Mapping[str, Any]]) -> tuple[list[str], str | None]:
    """Names of fields to fill in or to correct, and what to do; None if nothing is missing."""
    if snapshot.error:
        return [], "Correct the study file to run."
    if snapshot.study is None:
        some = any(not seen.problem for seen in snapshot.recordings)
        return [], "Use the recordings of this folder to run." if some else "Drop recordings here to run."
    if not runs:
        return ["Recordings"], "Add a recording to run."
    if missing := missing_fields(snapshot):
        return missing, f"Enter {_listed(missing)} to run."
    every = [study_fields(snapshot), *(run["fields"] for run in runs)]
    wrong = [NAMES[key] for key in KEYS if any(fields[key]["error"] for fields in every)]
    return wrong, f"Correct {_listed(wrong)} to run." if wrong else None


def _listed(names: Sequence[str]) -> str:
    return join_words([f"the {lower_first(name)}" for name in names])
