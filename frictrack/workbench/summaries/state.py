"""Put all summaries of a study together into the state that the page shows."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from frictrack.base.number_format import upper_first
from frictrack.effects import models
from frictrack.flow import Change, undo_stacks
from frictrack.results import to_builtins
from frictrack.results.names import joined_name, numbered_name
from frictrack.results.verdicts import CHECK_FIRST, describe_tests
from frictrack.study import Study
from frictrack.workbench.summaries.diagnosis import summarise_diagnosis, verdict_of
from frictrack.workbench.summaries.fields import study_fields
from frictrack.workbench.summaries.models import current_model, list_models, list_outdated, report_state
from frictrack.workbench.summaries.runs import readiness, summarise_runs
from frictrack.workbench.summaries.snapshot import Snapshot, list_recordings

AUTHORS = {"cli": "command line", "page": "page", "python": "Python"}
KEY_NAMES = {
    "fps": "frame rate",
    "free": "free section",
    "cutoff": "cut-off",
    "causal": "forward only",
    "repair": "repairs",
    "fix": "fixed values",
}
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
    name = joined_name(models.names_in(model)) if isinstance(model, str) and model else "the model"
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
            "fields": study_fields(snapshot),
            "keys": _study_keys(snapshot.study),
            "ready": readiness(snapshot, runs),
            "runs": runs,
            "models": list_models(snapshot, verdict_of),
            "model": current_model(snapshot),
            "diagnosis": summarise_diagnosis(snapshot),
            "check_first": [f"{CHECK_FIRST} {words}." for words in implausible],
            "outdated": list_outdated(snapshot),
            "report": report_state(snapshot),
            "history": summarise_history(snapshot),
        }
    )
    return state
