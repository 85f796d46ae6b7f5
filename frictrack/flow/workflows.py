"""Work on a whole study in one call: run it, change its model, plan the next films, run the demonstration, repeat it.

What a person waits for comes first: the verdict, then what is shown next, then the report. Everything is stored as soon
as it is known, so that the process may be ended at any moment after the verdict.

An analysis is repeated as a Python script of the commands in the history, which leads to the current model, or at once
from the models tried: `repeat_models` fits and diagnoses every model that is stored, in order, with its settings, seeds
and significance levels, so that the results can be compared group by group.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack import measure, samples
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.flow import store
from frictrack.flow.command_history import ALPHA_FIRST, CommandHistory
from frictrack.flow.opening import open_study
from frictrack.flow.pipeline import Progress, no_progress
from frictrack.flow.session import Session
from frictrack.flow.tried_models import FitRequest
from frictrack.results import to_builtins
from frictrack.results.candidates import candidate_rows
from frictrack.study import Study

if TYPE_CHECKING:
    from frictrack.diagnose.experiments import ExperimentSetup

OnVerdict = Callable[[dict[str, Any]], None]
MAX_CANDIDATES_FITTED = 6
MAX_EFFECTS_ADDED = 4  # effects that may be added before the demo gives up


def run_study(session: Session, on_verdict: OnVerdict, *, seed: int = 0) -> dict[str, Any]:
    """Measure, fit and diagnose; then `conclude`.

    Parameters
    ----------
    session
        The study.
    on_verdict
        Called once with "fit" and "diagnose" when fit and verdict are stored.
    seed
        Seed of the diagnosis.

    Returns
    -------
    dict
        "fit" and "diagnose", the JSON of those commands, and "warnings".

    """
    fit = session.fit()
    diagnosis = conclude(session, lambda found: on_verdict({"fit": fit, "diagnose": found}), seed=seed)
    return {"fit": fit, "diagnose": diagnosis, "warnings": session.findings.summary}


def change_and_diagnose(
    session: Session, command: str, on_verdict: OnVerdict, *, effect: str, seed: int | None = None
) -> dict[str, Any]:
    """Add or remove an effect, fit and diagnose the new model; then `conclude`.

    Parameters
    ----------
    session
        The study.
    command
        "add" or "remove".
    on_verdict
        Called once with the incomplete diagnosis when fit and verdict are stored.
    effect
        Name of the effect.
    seed
        Seed of the random numbers; None for that of the current model.

    Returns
    -------
    dict
        The change of the model, as `Session.add` returns it, with "diagnose".

    """
    change = session.apply(command, effect=effect, seed=seed)
    return {**change, "diagnose": conclude(session, on_verdict, seed=seed or 0)}


def conclude(session: Session, on_verdict: OnVerdict, *, seed: int = 0) -> dict[str, Any]:
    """Diagnose the current model; once the verdict is stored, fit its candidates and write the report.

    Parameters
    ----------
    session
        The study.
    on_verdict
        Called once with the diagnosis when the verdict is stored; what follows runs in the background.
    seed
        Seed of the diagnosis.

    Returns
    -------
    dict
        JSON of `frictrack diagnose`.

    """
    announced = False

    def announce(found: dict[str, Any]) -> None:
        nonlocal announced
        if not announced:
            announced = True
            on_verdict(found)
            fit_candidates(session, found, most=1)  # the one that is most likely to be added next

    diagnosis = session.diagnose(seed, on_verdict=announce)
    announce(diagnosis)
    fit_candidates(session, diagnosis)
    session.report(seed, anew=False)
    return diagnosis


def fit_candidates(session: Session, diagnosis: Mapping[str, Any], most: int = MAX_CANDIDATES_FITTED) -> list[str]:
    """Fit the current model with each of the best candidates, and store the fits."""
    fitted = []
    rows = candidate_rows(diagnosis)
    for effect in [row.effect for row in rows if row.kind != "implausible"][:most]:
        try:
            session.attempt(effect)
        except FrictrackError:
            continue  # it is said when the user tries that effect
        fitted.append(effect)
    return fitted


def plan(study: Study, progress: Progress = no_progress) -> dict[str, Any]:
    """Plan which runs to film so that the effects can be distinguished: JSON of `frictrack plan`.

    The page ``plan.html`` is written, too.

    Parameters
    ----------
    study
        A study; it may have no runs yet.
    progress
        Called as ``progress(done, total, what)``.

    Raises
    ------
    FrictrackError
        If mass, frame rate or scale are unknown, or the folder cannot be written.

    """
    from frictrack.diagnose.experiments import choose_runs, summarise_plan  # noqa: PLC0415
    from frictrack.present.report import write_plan  # noqa: PLC0415 - loads matplotlib

    named: dict[str, Any] = {"next": None, "next_reason": None}
    if study.runs:
        session = Session(study, progress)
        session.bring_up_to("friction")
        setup, named = _setup_of_fit(session), session.name_next_run()
    else:
        setup = replace(_setup_without_runs(study), costs=study.costs)
    run_plan = choose_runs(setup, progress)
    summary = to_builtins({**summarise_plan(run_plan), **named, "name": study.name})
    page = write_plan(summary, study.output / "plan.html")
    return {**summary, "page": str(page), "output": str(study.output)}


def _setup_without_runs(study: Study) -> ExperimentSetup:
    """Return the set-up of a study without films: mass and camera are given, the rest is assumed."""
    from frictrack.diagnose.experiments import default_setup  # noqa: PLC0415

    needed = (
        (study.mass, 'a mass in [study] but got none; give mass = "0.35 kg" (roughly is enough)'),
        (study.fps, "the frame rate in [camera] but got none; give fps = 4000"),
        (study.scale, 'a scale in [camera] but got none; give scale = "0.5 mm/px" (roughly is enough)'),
    )
    if study.mass is None or study.fps is None or study.scale is None:
        faults = (f"expected {words}" for value, words in needed if value is None)
        raise UsageError(f"{study.path.name}, plan: {'; '.join(faults)}")
    pitch = measure.calibration.parse_scale(study.scale)[0]
    if not np.isfinite(pitch):
        raise FrictrackError(
            "expected a scale that is known before filming but got one that needs a picture; give its rough value, "
            'scale = "0.5 mm/px"'
        )
    return default_setup(study.mass[0], study.fps, pitch)


def _setup_of_fit(session: Session) -> ExperimentSetup:
    """Return the set-up as the current fit describes it."""
    from frictrack.diagnose.experiments import fitted_setup  # noqa: PLC0415
    from frictrack.fit import Fit  # noqa: PLC0415

    fitted = session.models.fit(session.models.current()[0])
    if not isinstance(fitted, Fit):
        raise FrictrackError("expected one fit of all runs to plan with but got one per group; fit without --per first")
    return fitted_setup(fitted, session.study.costs)


def demo(folder: Path, seed: int = 0, progress: Progress = no_progress) -> dict[str, Any]:
    """Run the sample study in a folder; the films are copied there if it has no study.

    The best candidate is added until the diagnosis finds nothing more.

    Parameters
    ----------
    folder
        Folder of the study.
    seed
        Seed of the diagnoses.
    progress
        Called as ``progress(done, total, what)``.

    Returns
    -------
    dict
        JSON of `frictrack demo`.

    """
    path = folder / "study.toml"
    if not path.exists():
        samples.copy_films(folder)
    session = Session(open_study(path), progress)
    session.restart()
    first = found = session.diagnose(seed)
    added: list[dict[str, Any]] = []
    while found["missing"] and len(added) < MAX_EFFECTS_ADDED:
        added.append(session.add(found["missing"][0], seed))
        found = session.diagnose(seed)
    history = session.history()
    report = session.report(seed)
    return {"diagnose": first, "add": added[0] if added else None, "history": history, "report": str(report)}


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
    lines = ""
    for change in (one for one in (*first, *done) if one.command not in STUDY_FILE_COMMANDS):
        given = "".join(f", {key}={value!r}" for key, value in change.arguments.items() if value is not None)
        lines += f"session.apply({change.command!r}{given})\n"
    return HEAD.format(name=study.name, file=study.path.name) + lines + TAIL


@dataclass(frozen=True)
class RecordedModel:
    """How a stored model was made.

    `uncertainty` and `diagnosis` are the arguments of `Session.fit` and `Session.diagnose`; empty where neither
    profiles nor draws were computed, or the model was not diagnosed.
    """

    group: str
    request: FitRequest
    current: bool
    uncertainty: dict[str, Any]
    diagnosis: dict[str, Any]


def recorded_models(path: Path) -> list[RecordedModel]:
    """Read from a file ``study.h5`` how the models of a study were made, in the order in which they were tried."""
    with store.snapshot(path):  # whatever is wrong in it becomes one sentence
        groups = sorted(store.names(path, "models"), key=lambda name: int(name.split("_")[0]))
        return [_recorded_model(path, group) for group in groups]


def _recorded_model(path: Path, group: str) -> RecordedModel:
    inside = f"models/{group}"
    held, parts = store.attributes(path, inside), store.names(path, inside)
    uncertainty: dict[str, Any] = {}
    diagnosis: dict[str, Any] = {}
    if "certainty" in parts:
        more = json.loads(store.read(path, f"{inside}/certainty")["summary"])
        draws = more.get("bootstrap", {"draws": 0, "failed": 0})
        uncertainty = {"profiles": "profiles" in more, "draws": draws["draws"] + draws["failed"]}
    if "diagnosis" in parts:
        summary = json.loads(store.read(path, f"{inside}/diagnosis", without=("figures",))["summary"])
        seed = json.loads(store.attributes(path, f"{inside}/diagnosis")["settings"])["seed"]
        is_quick = not summary.get("complete", True)
        diagnosis = {"seed": seed, "alpha": summary.get("alpha", ALPHA_FIRST), "quick": is_quick}
    return RecordedModel(group, FitRequest.from_json(held["settings"]), bool(held["current"]), uncertainty, diagnosis)


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
        if any(model.uncertainty.values()):
            session.fit(**model.uncertainty)
        if model.diagnosis:
            session.diagnose(**model.diagnosis)
    current = next((model for model in models if model.current), None)
    if current is not None and current is not models[-1]:
        session.apply("use", model=current.group)
    session.results(None if current is None else current.diagnosis.get("seed"))
