"""The commands that change what a study is: keys of its file, its runs, which model is current; and undo, redo.

A key is written into the study file only when the file is still sound with it, comments kept. Every change stands in
the log with what was there before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from frictrack.errors import FrictrackError
from frictrack.files import replace_text
from frictrack.flow.opening import checked
from frictrack.study import edited, parse, with_effect, with_runs, without_run

if TYPE_CHECKING:
    from frictrack.flow.session import Session


def edit(session: Session, table: str, key: str, value: Any, which: str | None = None) -> dict[str, Any]:
    """Set one key of the study file, in the run or effect that is called `which`; None takes the key away."""

    def how(text: str) -> str:
        after = edited(text, table, key, value, which)
        if table == "effect" and session.tried.head is not None:  # what its model does not hold would fail in the fit
            session.tried.spec(session.tried.head).model(parse(session.study.path, after, bare=True).effects)
        return after

    with session.ledger.turn("edit", table=table, which=which, key=key, value=value) as change:
        change.before, change.after = _rewritten(session.study.path, how)
    return {"table": table, "which": which, "key": key, "value": value}


def take_in(session: Session, recordings: Sequence[str]) -> dict[str, Any]:
    """Add recordings to the study as runs."""
    folder = session.study.folder
    paths = [folder / name for name in recordings]
    if missing := [str(path) for path in paths if not path.exists()]:
        raise FrictrackError(f"expected a recording {', '.join(missing)} but there is no such file", usage=True)
    with session.ledger.turn("take_in", recordings=list(recordings)) as change:
        change.before, change.after = _rewritten(session.study.path, lambda text: with_runs(text, folder, paths))
    return {"recordings": list(recordings)}


def leave_out(session: Session, run: str) -> dict[str, Any]:
    """Take a run out of the study; its recording and what was measured of it stay where they are."""
    with session.ledger.turn("leave_out", run=run) as change:
        change.before, change.after = _rewritten(session.study.path, lambda text: without_run(text, run))
    return {"run": run}


def define(session: Session, effect: Mapping[str, Any]) -> dict[str, Any]:
    """An effect of one's own in the study file: the keys of its ``[[effect]]``, in the place of one of that name."""
    told = dict(effect)
    with session.ledger.turn("define", effect=told) as change:
        change.before, change.after = _rewritten(session.study.path, lambda text: with_effect(text, told))
    return {"effect": told}


def use(session: Session, model: str) -> dict[str, Any]:
    """Make a model current that was tried before, by its name in the history."""
    if model not in session.tried.groups:
        known = ", ".join(session.tried.groups) or "none"
        raise FrictrackError(f'expected a model that was tried but got "{model}"; there are {known}', usage=True)
    with session.ledger.turn("use", model=model) as change:
        change.before, change.after = {"current": session.tried.head}, {"current": model}
        session.tried.use(model)
    return {"model": model}


def undo(session: Session) -> dict[str, Any]:
    """Take the last change back; the models tried stay in the history."""
    return _moved(session, "undo")


def redo(session: Session) -> dict[str, Any]:
    """Do again what was undone last."""
    return _moved(session, "redo")


def _moved(session: Session, do: str) -> dict[str, Any]:
    """From one side of a change to the other."""
    with session.ledger.turn(do) as moved:
        done, undone = session.ledger.stacks()
        stack = done if do == "undo" else undone
        if not stack:
            raise FrictrackError(f"there is nothing to {do}")
        change = stack[-1]
        here, there = (change.after, change.before) if do == "undo" else (change.before, change.after)
        if "toml" in there:
            _rewritten(session.study.path, lambda text: _swapped(text, here["toml"], there["toml"]))
        else:
            session.tried.use(there["current"])
        moved.told = {"of": change.rev}
    return {"change": change.do, **change.told}


def _swapped(text: str, here: str, there: str) -> str:
    if text != here:
        raise FrictrackError("the study file was changed by hand since; undo it there")
    return there


def _rewritten(path: Path, how: Callable[[str], str]) -> tuple[dict[str, str], dict[str, str]]:
    """The study file with its text changed, replaced whole: what it was, what it is.

    Raises `FrictrackError` where the file would no longer be sound, and leaves it.
    """
    before = path.read_bytes().decode()
    after = how(before)
    checked(parse(path, after, bare=True))
    replace_text(path, after)
    return {"toml": before}, {"toml": after}
