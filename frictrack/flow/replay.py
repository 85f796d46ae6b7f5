"""Repeat an analysis: as a Python script of the commands in the history, or at once from the models tried.

The script leads to the current model. `repeat_models` fits and diagnoses every model that is stored, in order, with
its settings, seeds and significance levels, so that the results can be compared group by group.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from frictrack.flow import store
from frictrack.flow.command_history import Change, CommandHistory
from frictrack.flow.diagnosis_records import ALPHA_FIRST
from frictrack.flow.fit_request import FitRequest
from frictrack.flow.session import Session
from frictrack.study import Study

HEAD = '''"""Repeat the analysis of {name}: every fit and every choice of the history, in order.

The study file {file} already contains the edits that were made in it.
"""

from frictrack.flow import Session, open_study

session = Session(open_study({file!r}))
session.restart()  # forget the models tried; measurements are kept
'''
TAIL = """
print(session.diagnose()["verdict"])
print(session.report())
"""
STUDY_FILE_COMMANDS = ("edit", "take_in", "leave_out", "define")  # their effect is already in the study file


def replay_script(study: Study) -> str:
    """Return a Python script that leads to the current model; commands that were undone are left out.

    Parameters
    ----------
    study
        The study.

    """
    history = CommandHistory(study.output)
    done, _ = history.undo_stacks()
    first = [change for change in history.changes if change.command == "fit" and not change.before][-1:]
    lines = [_command_line(change) for change in (*first, *done) if change.command not in STUDY_FILE_COMMANDS]
    return HEAD.format(name=study.name, file=study.path.name) + "".join(f"{line}\n" for line in lines) + TAIL


def _command_line(change: Change) -> str:
    arguments = "".join(f", {key}={value!r}" for key, value in change.arguments.items() if value is not None)
    return f"session.apply({change.command!r}{arguments})"


@dataclass(frozen=True)
class RecordedDiagnosis:
    """How a stored diagnosis was made: seed, significance level, and whether it ended with the verdict."""

    seed: int
    alpha: float
    quick: bool


@dataclass(frozen=True)
class RecordedModel:
    """How a stored model was made.

    Attributes
    ----------
    group
        Name of its group in ``study.h5``.
    request
        The model and how it was fitted.
    current
        Whether it is the current model.
    diagnosis
        How it was diagnosed; None if it was not.
    profiles
        Whether profiles were computed.
    draws
        Number of bootstrap draws; 0 for none.

    """

    group: str
    request: FitRequest
    current: bool = False
    diagnosis: RecordedDiagnosis | None = None
    profiles: bool = False
    draws: int = 0


def recorded_models(path: Path) -> list[RecordedModel]:
    """Read how the models of a study were made, in the order in which they were tried.

    Parameters
    ----------
    path
        The file ``study.h5``.

    Raises
    ------
    FrictrackError
        If the file is missing or damaged.

    """
    with store.snapshot(path):  # whatever is wrong in it becomes one sentence
        groups = sorted(store.names(path, "models"), key=lambda name: int(name.split("_")[0]))
        return [_recorded_model(path, group) for group in groups]


def _recorded_model(path: Path, group: str) -> RecordedModel:
    inside = f"models/{group}"
    held = store.attributes(path, inside)
    parts = store.names(path, inside)
    more = json.loads(store.read(path, f"{inside}/certainty")["summary"]) if "certainty" in parts else {}
    draws = more.get("bootstrap", {"draws": 0, "failed": 0})
    return RecordedModel(
        group,
        FitRequest.from_json(held["settings"]),
        current=bool(held["current"]),
        diagnosis=_recorded_diagnosis(path, f"{inside}/diagnosis") if "diagnosis" in parts else None,
        profiles="profiles" in more,
        draws=draws["draws"] + draws["failed"],
    )


def _recorded_diagnosis(path: Path, inside: str) -> RecordedDiagnosis:
    summary = json.loads(store.read(path, inside, without=("figures",))["summary"])
    seed = json.loads(store.attributes(path, inside)["settings"])["seed"]
    return RecordedDiagnosis(seed, summary.get("alpha", ALPHA_FIRST), not summary.get("complete", True))


def repeat_models(session: Session, models: Sequence[RecordedModel]) -> None:
    """Fit and diagnose the models of another copy of the study, in order; then update all other results.

    Parameters
    ----------
    session
        The study, without results.
    models
        The models, from `recorded_models`.

    Raises
    ------
    FrictrackError
        If a run cannot be measured, or a model cannot be fitted.

    """
    session.bring_up_to("friction")
    for model in models:
        session.models.append(model.request)
        if model.profiles or model.draws:
            session.fit(profiles=model.profiles, draws=model.draws)
        if (made := model.diagnosis) is not None:
            session.diagnose(made.seed, quick=made.quick, alpha=made.alpha)
    current = next((model for model in models if model.current), None)
    if current is not None and current is not models[-1]:
        session.apply("use", model=current.group)
    session.results(current.diagnosis.seed if current is not None and current.diagnosis is not None else None)
