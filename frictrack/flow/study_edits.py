"""Change a study: keys of its file, its runs, its own effects, the current model; undo and redo.

A key is written into the study file only if the file stays valid, perhaps still incomplete; comments are kept. The
command history records every change with the state before it.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from frictrack import study
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.files import replace_text
from frictrack.flow.command_history import CommandHistory
from frictrack.flow.opening import check_study
from frictrack.flow.tried_models import TriedModels
from frictrack.study import Study, parse

FORMULA = re.compile(r"formula:(\d+)")


@dataclass(frozen=True)
class OpenStudy:
    """The three parts of an open study that an edit may change."""

    study: Study
    history: CommandHistory
    models: TriedModels


def _edit(opened: OpenStudy, command: str, rewrite: Callable[[str], str], **arguments: Any) -> dict[str, Any]:
    """Rewrite the study file and record the command; return its arguments."""
    with opened.history.record(command, **arguments) as change:
        change.before, change.after = _rewrite(opened.study.path, rewrite)
    return arguments


def set_key(opened: OpenStudy, table: str, key: str, value: Any, which: str | None = None) -> dict[str, Any]:
    """Set one key of the study file."""

    def rewrite(text: str) -> str:
        after = study.with_key(text, table, key, value, which)
        if table == "effect" and opened.models.current_group is not None:  # else only the next fit would fail
            request = opened.models.request(opened.models.current_group)
            request.model(parse(opened.study.path, after, allow_incomplete=True).effects)
        return after

    return _edit(opened, "edit", rewrite, table=table, which=which, key=key, value=value)


def add_recordings(opened: OpenStudy, recordings: Sequence[str]) -> dict[str, Any]:
    """Add a run for each recording."""
    folder = opened.study.folder
    paths = [folder / name for name in recordings]
    if missing := [str(path) for path in paths if not path.exists()]:
        raise UsageError(f"expected a recording {', '.join(missing)} but there is no such file")
    return _edit(opened, "take_in", lambda text: study.writing.with_runs(text, folder, paths), recordings=recordings)


def remove_run(opened: OpenStudy, run: str) -> dict[str, Any]:
    """Remove a run from the study file; its recording and its results stay where they are."""
    return _edit(opened, "leave_out", lambda text: study.writing.without_run(text, run), run=run)


def define_effect(opened: OpenStudy, effect: Mapping[str, Any]) -> dict[str, Any]:
    """Write an ``[[effect]]`` into the study file; it replaces one of the same name."""
    keys = dict(effect)
    return _edit(opened, "define", lambda text: study.writing.with_effect(text, keys), effect=keys)


def select_model(opened: OpenStudy, model: str) -> dict[str, Any]:
    """Make a model current that was tried before."""
    if model not in opened.models.groups:
        known = ", ".join(opened.models.groups) or "none"
        raise UsageError(f'expected a model that was tried but got "{model}"; there are {known}')
    with opened.history.record("use", model=model) as change:
        change.before, change.after = {"current": opened.models.current_group}, {"current": model}
        opened.models.select(model)
    return {"model": model}


def _undo_or_redo(opened: OpenStudy, command: str) -> dict[str, Any]:
    """Undo the last change, or redo the change that was undone last; the models tried stay in the history."""
    with opened.history.record(command) as record:
        done, undone = opened.history.undo_stacks()
        stack = done if command == "undo" else undone
        if not stack:
            raise FrictrackError(f"there is nothing to {command}")
        change = stack[-1]
        old, new = (change.after, change.before) if command == "undo" else (change.before, change.after)
        if "toml" in new:
            _rewrite(opened.study.path, lambda text: _swap(text, old["toml"], new["toml"]))
        else:
            opened.models.select(new["current"])
        record.arguments = {"of": change.revision}
    return {"change": change.command, **change.arguments}


EDITS: dict[str, Callable[..., dict[str, Any]]] = {  # command -> function that changes the study
    "edit": set_key,
    "take_in": add_recordings,
    "leave_out": remove_run,
    "define": define_effect,
    "use": select_model,
    "undo": partial(_undo_or_redo, command="undo"),
    "redo": partial(_undo_or_redo, command="redo"),
}


def _swap(text: str, old: str, new: str) -> str:
    if text != old:
        raise FrictrackError("the study file was edited by hand since; undo the change there")
    return new


def _rewrite(path: Path, rewrite: Callable[[str], str]) -> tuple[dict[str, str], dict[str, str]]:
    """Replace the text of the study file; return the states before and after, as the history has them.

    Raises `FrictrackError` if the file would not be valid, and leaves it unchanged.
    """
    before = path.read_bytes().decode()
    after = rewrite(before)
    check_study(parse(path, after, allow_incomplete=True))
    replace_text(path, after)
    return {"toml": before}, {"toml": after}


def formula_number(effect: str) -> int | None:
    """Return n of "formula:n"; None for the name of an effect.

    Examples
    --------
    >>> formula_number("formula:2"), formula_number("texture")
    (2, None)

    """
    named = FORMULA.fullmatch(effect)
    return int(named[1]) if named else None


def effect_of_formula(found: Mapping[str, Any], taken: Iterable[str]) -> dict[str, Any]:
    """Return the keys of the ``[[effect]]`` table of one formula.

    Parameters
    ----------
    found
        An entry of "formulas" of the JSON of `frictrack diagnose`.
    taken
        Names of the effects that the study has; another name is chosen.

    Returns
    -------
    dict
        The keys, with "effect" for the name; empty if the formula has no table.

    """
    table: dict[str, Any] = tomllib.loads(found["toml"])["effect"][0] if found.get("toml") else {}
    if not table:
        return {}
    known = set(taken)
    names = (f"{table['effect']}{mark}" for mark in ("", *(f"_{k}" for k in range(2, len(known) + 3))))
    return table | {"effect": next(one for one in names if one not in known)}


def choose_formula(
    number: int, diagnosis: Mapping[str, Any] | None, taken: Iterable[str], model: Sequence[str]
) -> dict[str, Any]:
    """Return the keys of the ``[[effect]]`` table of formula `number` of a diagnosis, counted from 1."""
    if diagnosis is None:
        raise UsageError(
            f"expected a diagnosis for formula:{number} but the current model has none; run frictrack diagnose first"
        )
    formulas = (diagnosis.get("unexplained") or {}).get("formulas") or []
    if not 1 <= number <= len(formulas):
        known = f"formula:1 to formula:{len(formulas)}" if formulas else "no formula, because none was needed or found"
        raise UsageError(f"expected a formula of the last diagnosis but got formula:{number}; it has {known}")
    one = formulas[number - 1]
    if absent := [name for name in one.get("beside") or [] if name not in model]:
        names = ", ".join(absent)
        raise UsageError(f"formula:{number} was found beside {names}; add {names} first")
    return effect_of_formula(one, taken)
