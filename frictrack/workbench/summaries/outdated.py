"""List the results that do not belong to the study file or the model of now, with the command that updates each."""

from __future__ import annotations

from typing import Any, TypedDict

from frictrack.workbench.summaries.snapshot import Snapshot


class OutdatedEntry(TypedDict):
    """One outdated result.

    Attributes
    ----------
    what, name
        "track", "motion", "model", "diagnosis" or "report"; the name of the run or of the model's group.
    reason
        A sentence.
    update
        The job that brings it up to date: "do" and "arguments".

    """

    what: str
    name: str
    reason: str
    update: dict[str, Any]


def list_outdated(snapshot: Snapshot) -> list[OutdatedEntry]:
    """List everything that is outdated.

    Parameters
    ----------
    snapshot
        The study as its files are.

    """
    parts = snapshot.results.outdated_parts if snapshot.results else ()
    return [
        OutdatedEntry(
            what=part.what,
            name=part.name,
            reason=_sentence(part.what, part.name, part.reason),
            update={"do": part.command, "arguments": part.arguments},
        )
        for part in parts
    ]


def why_outdated(snapshot: Snapshot, what: str, name: str = "") -> str | None:
    """Return the sentence why one result is outdated; None if it is not.

    Parameters
    ----------
    snapshot
        The study as its files are.
    what, name
        As in `OutdatedEntry`.

    """
    return next((one["reason"] for one in list_outdated(snapshot) if (one["what"], one["name"]) == (what, name)), None)


def report_state(snapshot: Snapshot) -> dict[str, Any]:
    """Return whether the report exists, and why it is outdated (None if it is not).

    Parameters
    ----------
    snapshot
        The study as its files are.

    """
    exists = snapshot.results is not None and (snapshot.results.output / "report.html").exists()
    return {"exists": exists, "outdated": why_outdated(snapshot, "report") if exists else None}


def _sentence(what: str, name: str, reason: str) -> str:
    return f"{_SUBJECTS[what].format(name=name)}: {reason}."


_SUBJECTS = {
    "track": "The track of {name} is outdated",
    "motion": "The motion of {name} is outdated",
    "model": "The model {name} is outdated",
    "diagnosis": "The diagnosis of {name} is outdated",
    "report": "The report is outdated",
}
