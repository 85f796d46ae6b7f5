"""Check the numbers of a study before work is spent on them: what the study file shows alone, each run, all runs."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from frictrack.calibration import parse_scale
from frictrack.errors import FrictrackError, gather
from frictrack.flow.stages import RunWork
from frictrack.friction import free_section
from frictrack.plausibility import (
    ERROR,
    Finding,
    Typed,
    implausible,
    implausible_masses,
    implausible_slide,
    missing_incline,
    path_angle,
    wrong_incline,
)
from frictrack.records import Run, Track
from frictrack.study import RunTable, Study, written

LOG = logging.getLogger("frictrack")
BARE = re.compile(r"\s*[+-]?[\d.]+(?:[eE][+-]?\d+)?\s*(?:(?:\+/-|±)\s*[\d.eE+-]+\s*%?)?\s*")  # a text without a unit
KEYS = ("mass", "scale", "fps", "incline")
HOMES = {"mass": "study", "scale": "camera", "fps": "camera"}  # table that a key of a run is inherited from


class Findings:
    """The findings of a study, in the order in which they were made; each is said once.

    They are logged as warnings when they are made, before the work that they concern. One that cannot be right ends
    the work, unless the study file says `plausible = "checked"`.
    """

    def __init__(self, study: Study) -> None:
        self.study = study
        self._found: dict[str, Finding] = {}

    @property
    def summary(self) -> list[dict[str, Any]]:
        """The JSON."""
        return [finding.to_dict() for finding in self._found.values()]

    @property
    def words(self) -> tuple[str, ...]:
        """The sentences."""
        return tuple(self._found)

    def of_study(self) -> None:
        """What the study file shows by itself; what several runs inherit is said once."""
        self._take(found for run in self.study.runs if not run.plausible for found in _of_file(self.study, run))

    def of_runs(self, works: Sequence[RunWork]) -> None:
        """What the motion of each run shows."""
        self._take(found for work in works for found in of_run(work))

    def of_all(self, works: Sequence[RunWork]) -> None:
        """What the runs show together, those that the user has checked among them."""
        self._take(implausible_masses([work.record() for work in works]))

    def _take(self, findings: Iterable[Finding]) -> None:
        """Note the new ones of runs that the user has not checked. Raises `FrictrackError` with all errors."""
        checked = {run.name for run in self.study.runs if run.plausible}
        new = [f for f in findings if f.run not in checked and not self._is_known(f)]
        for finding in new:
            if finding.grade != ERROR and not self._is_known(finding):
                self._found[str(finding)] = finding
                LOG.warning("%s: warning: %s", self.study.path.name, finding)
        gather([str(f) for f in new if f.grade == ERROR], self.study.path.name)

    def _is_known(self, finding: Finding) -> bool:
        """Whether the same was found before, of that run or of all."""
        return any(one.kind == finding.kind and one.run in (finding.run, "") for one in self._found.values())


def of_run(work: RunWork) -> list[Finding]:
    """Findings on one run whose motion is made."""
    record = work.record()
    lacks = missing(work, record)
    if lacks is not None and not _has_free_section(record):
        lacks = replace(lacks, grade=ERROR, words=f"{lacks.words}, or the part to be judged as free = [t0, t1]")
    return [f for f in (*implausible_slide(record, film=bool(work.run.video)), lacks, wrong_incline(record)) if f]


def missing(work: RunWork, record: Run) -> Finding | None:
    """The incline that a run lacks, None where it lacks none."""
    track: Track | None = work.get("track") if "track" in work.stages else None
    return missing_incline(record, None if track is None else path_angle(track))


def _has_free_section(record: Run) -> bool:
    """Whether there is something to be fitted as the run is described now."""
    try:
        free_section(record)
    except FrictrackError:
        return False
    return True


def _of_file(study: Study, run: RunTable) -> list[Finding]:
    """Findings on the numbers of a run in the study file; what it inherits concerns all runs."""
    own = {key: _raw(study, "run", key, run.name) for key in KEYS}
    held = {key: _raw(study, HOMES[key], key) if own[key] is None and key in HOMES else own[key] for key in KEYS}
    pitch = float("nan") if run.scale is None else parse_scale(run.scale)[0]
    typed = Typed(
        run=run.name,
        mass=run.mass[0] if isinstance(run.mass, tuple) else None,
        pitch=pitch if np.isfinite(pitch) else None,
        fps=run.fps,
        incline=run.incline,
        bare=frozenset(key for key, value in held.items() if _is_bare(value)),
    )
    return [found if own[found.kind] is not None else replace(found, run="") for found in implausible(typed)]


def _raw(study: Study, table: str, key: str, which: str | None = None) -> Any:
    """What stands in the study file under a key."""
    try:
        return written(study.path.read_text(encoding="utf-8"), table, key, which)
    except (FrictrackError, OSError):  # a study that is not in a file, or was changed meanwhile
        return None


def _is_bare(value: Any) -> bool:
    if isinstance(value, str):
        return BARE.fullmatch(value) is not None
    return isinstance(value, int | float) and not isinstance(value, bool)
