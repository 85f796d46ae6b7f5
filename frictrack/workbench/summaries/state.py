"""Put all summaries of a study together into the state that the page shows."""

from __future__ import annotations

from typing import Any, TypedDict

from frictrack.results import to_builtins
from frictrack.verdicts import CHECK_FIRST
from frictrack.workbench.summaries.diagnosis import DiagnosisSummary, summarise_diagnosis
from frictrack.workbench.summaries.fields import Field, study_fields
from frictrack.workbench.summaries.history import HistorySummary, summarise_history
from frictrack.workbench.summaries.models import ModelEntry, current_model, falling_error, list_models
from frictrack.workbench.summaries.outdated import OutdatedEntry, list_outdated, report_state
from frictrack.workbench.summaries.readiness import Readiness, readiness
from frictrack.workbench.summaries.recordings import RecordingEntry, list_recordings
from frictrack.workbench.summaries.runs import RunSummary, summarise_runs
from frictrack.workbench.summaries.snapshot import Snapshot


class StudyState(TypedDict):
    """Everything that the page shows of a study; the server adds its own version, its id and the jobs.

    Attributes
    ----------
    revision
        Number of changes of the study so far.
    path, folder, exists, name
        The study file, its folder, whether it exists, and the name of the study.
    error
        Why the study file or the results cannot be read; None if they can.
    check_first
        Implausible numbers, as sentences: no verdict is better than they are.

    Notes
    -----
    The other keys are described where their types are defined.

    """

    revision: int
    path: str
    folder: str
    exists: bool
    name: str
    error: str | None
    recordings: list[RecordingEntry]
    fields: dict[str, Field]
    ready: Readiness
    runs: list[RunSummary]
    models: list[ModelEntry]
    model: dict[str, Any] | None
    diagnosis: DiagnosisSummary | None
    check_first: list[str]
    falling: list[dict[str, Any]]
    outdated: list[OutdatedEntry]
    report: dict[str, Any]
    history: HistorySummary


def state_of(snapshot: Snapshot) -> StudyState:
    """Return the state of a study as JSON-serialisable dictionaries.

    Parameters
    ----------
    snapshot
        The study as its files are.

    """
    runs = summarise_runs(snapshot)
    implausible = snapshot.results.warnings if snapshot.results else ()
    state: StudyState = to_builtins(
        StudyState(
            revision=len(snapshot.changes),
            path=str(snapshot.path),
            folder=str(snapshot.path.parent),
            exists=snapshot.path.exists(),
            name=snapshot.study.name if snapshot.study else snapshot.path.resolve().parent.name,
            error=snapshot.error,
            recordings=list_recordings(snapshot),
            fields=study_fields(snapshot),
            ready=readiness(snapshot, runs),
            runs=runs,
            models=list_models(snapshot),
            model=current_model(snapshot),
            diagnosis=summarise_diagnosis(snapshot),
            check_first=[f"{CHECK_FIRST} {words}." for words in implausible],
            falling=falling_error(snapshot),
            outdated=list_outdated(snapshot),
            report=report_state(snapshot),
            history=summarise_history(snapshot),
        )
    )
    return state
