"""Say what is missing before the analysis can run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict

from frictrack.workbench.summaries.fields import KEYS, NAMES, Field, missing_fields, study_fields
from frictrack.workbench.summaries.runs import RunSummary
from frictrack.workbench.summaries.snapshot import Snapshot


class Readiness(TypedDict):
    """Whether Run can be pressed; the missing fields by name; and what to do, as a sentence."""

    can_run: bool
    missing: list[str]
    words: str


def readiness(snapshot: Snapshot, runs: Sequence[RunSummary]) -> Readiness:
    """Say what is missing before Run.

    Parameters
    ----------
    snapshot
        The study as its files are.
    runs
        Its runs.

    """
    if snapshot.error:
        return Readiness(can_run=False, missing=[], words="Correct the study file to run.")
    if snapshot.study is None:
        some = any(not seen.problem for seen in snapshot.recordings)
        words = "Use the recordings of this folder to run." if some else "Drop recordings here to run."
        return Readiness(can_run=False, missing=[], words=words)
    if not runs:
        return Readiness(can_run=False, missing=["Recordings"], words="Add a recording to run.")
    missing = missing_fields(snapshot)
    wrong = [NAMES[key] for key in KEYS if _is_wrong(key, study_fields(snapshot), runs) and NAMES[key] not in missing]
    if missing:
        return Readiness(can_run=False, missing=missing, words=f"Enter {_listed(missing)} to run.")
    if wrong:
        return Readiness(can_run=False, missing=wrong, words=f"Correct {_listed(wrong)} to run.")
    return Readiness(can_run=True, missing=[], words="Run measures the films, fits the model and names what it lacks.")


def _is_wrong(key: str, common: dict[str, Field], runs: Sequence[RunSummary]) -> bool:
    return any(fields[key]["error"] for fields in (common, *(run["fields"] for run in runs)))


def _listed(names: Sequence[str]) -> str:
    """Write names of fields as in a sentence.

    Examples
    --------
    >>> _listed(["Mass", "Frame rate", "Scale"])
    'the mass, the frame rate and the scale'

    """
    words = [f"the {name[:1].lower()}{name[1:]}" for name in names]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
