"""Describe the repaired frames of a run, and whether a verdict rests on them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from frictrack.results import to_builtins
from frictrack.study import RunTable


def list_repairs(run: RunTable) -> list[dict[str, Any]]:
    """List the repairs of a run as they stand in the study file.

    Parameters
    ----------
    run
        The run of the study file.

    Returns
    -------
    list of dict
        "from", "to" (frames, both included), "how", and "target" and "frame" for one that was tracked again.

    """
    found: list[dict[str, Any]] = to_builtins([repair.to_dict() for repair in run.repair])
    return found


def rests_on_repairs(diagnosis: Mapping[str, Any]) -> str | None:
    """Return the sentence that says how far a verdict rests on repaired frames; None if it does not.

    Parameters
    ----------
    diagnosis
        The JSON of a diagnosis.

    """
    return diagnosis.get("rests_on_repairs") or None
