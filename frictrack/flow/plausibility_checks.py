"""Check the numbers of a study before work is spent on them: what the study file shows alone, each run, all runs."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from frictrack.calibration import parse_scale
from frictrack.errors import FrictrackError, raise_faults
from frictrack.flow.pipeline import RunPipeline
from frictrack.friction import free_section
from frictrack.plausibility import (
    ERROR,
    Finding,
    Typed,
    implausible,
    implausible_clocks,
    implausible_inclines,
    implausible_masses,
    implausible_slide,
    missing_incline,
    path_angle,
    wrong_incline,
)
from frictrack.records import Run, Track
from frictrack.study import RunTable, Study, read_toml

LOG = logging.getLogger("frictrack")
NUMBER_WITHOUT_UNIT = re.compile(
    r"\s*[+-]?[\d.]+(?:[eE][+-]?\d+)?\s*(?:(?:\+/-|±)\s*[\d.eE+-]+\s*%?)?\s*"
)  # a text without a unit
ENERGY_STORING_EFFECTS = ("spring", "bouc_wen")  # effects of the library that give back what they took
CHECKED_KEYS = ("mass", "scale", "fps", "incline")
ACCEPTING_KEY = 'plausible = "checked"'  # what a study file says to end a finding
# Table of the study file that a run inherits a key from.
TABLE_OF_INHERITED_KEY = {
    "mass": "study",
    "scale": "camera",
    "fps": "camera",
}


class Findings:
    """The findings of a study, in the order in which they were made; each is said once.

    They are logged as warnings when they are made, before the work that they concern. One that cannot be right ends
    the work, unless the study file says `plausible = "checked"`.
    """

    def __init__(self, study: Study) -> None:
        self.study = study
        self._found: dict[str, Finding] = {}
        self._checked: set[str] = set()  # what was checked already

    @property
    def summary(self) -> list[dict[str, Any]]:
        """The JSON."""
        return [finding.to_dict() for finding in self._found.values()]

    @property
    def messages(self) -> tuple[str, ...]:
        """The sentences."""
        return tuple(self._found)

    @property
    def contradictions(self) -> tuple[Finding, ...]:
        """Those in which the measured data contradict what was typed."""
        return tuple(finding for finding in self._found.values() if finding.contradicts)

    def check_study_file(self) -> None:
        """What the study file shows by itself; what several runs inherit is said once."""
        self._check_once("study", lambda: _study_file_findings(self.study))

    def check_runs(self, pipelines: Sequence[RunPipeline]) -> None:
        """What the motion of each run shows, and of runs in both directions together."""
        if not _can_accelerate(self.study):
            self._check_once("inclines", lambda: implausible_inclines([pipeline.to_run() for pipeline in pipelines]))
            self._check_once(
                "accelerations", lambda: (found for pipeline in pipelines for found in acceleration_findings(pipeline))
            )
        self._check_once("runs", lambda: (found for pipeline in pipelines for found in slide_findings(pipeline)))

    def check_all_runs(self, pipelines: Sequence[RunPipeline]) -> None:
        """What the runs show together, those that the user has checked among them."""
        tables = [
            pipeline for pipeline in pipelines if pipeline.run.table
        ]  # the clock of a film is judged with its header
        stated = {pipeline.run.name: pipeline.run.fps for pipeline in tables}
        self._check_once("all", lambda: implausible_masses([pipeline.to_run() for pipeline in pipelines]))
        self._check_once("clocks", lambda: implausible_clocks({w.run.name: w.to_run() for w in tables}, stated))

    def _check_once(self, what: str, find: Callable[[], Iterable[Finding]]) -> None:
        """Check one thing, once."""
        if what not in self._checked:
            self._add(find())
            self._checked.add(what)

    def _add(self, findings: Iterable[Finding]) -> None:
        """Note the new ones of runs that the user has not checked. Raises `FrictrackError` with all errors."""
        checked = {run.name for run in self.study.runs if run.plausible}
        checked |= {""} if len(checked) == len(self.study.runs) else set()  # what concerns all runs
        new = [f for f in findings if f.run not in checked and not self._is_known(f)]
        for finding in new:
            if finding.grade != ERROR and not self._is_known(finding):
                self._found[str(finding)] = finding
                LOG.warning("%s: warning: %s", self.study.path.name, finding)
        raise_faults(_error_messages([f for f in new if f.grade == ERROR]), self.study.path.name)

    def _is_known(self, finding: Finding) -> bool:
        """Whether the same was found before, of that run or of all, and on as good grounds."""
        same = [one for one in self._found.values() if one.kind == finding.kind and one.run in (finding.run, "")]
        return any(one.contradicts or not finding.contradicts for one in same)


def _error_messages(errors: Sequence[Finding]) -> list[str]:
    """Errors in words, those with the same correction in one sentence, and how to go on in spite of them.

    An incline says the latter itself.
    """
    alike: dict[tuple[str, str], list[Finding]] = {}
    for error in errors:
        alike.setdefault((error.kind, error.correction or str(error)), []).append(error)
    return [f"{first}{_same_in(more)}{_how_to_accept(first)}" for first, *more in alike.values()]


def _same_in(more: Sequence[Finding]) -> str:
    names = ", ".join(f'"{error.run}"' for error in more)
    return f"; likewise in {names}" if more else ""


def _how_to_accept(error: Finding) -> str:
    return "" if error.kind == "incline" else f" (if it is right, {ACCEPTING_KEY} goes on)"


def slide_findings(pipeline: RunPipeline) -> list[Finding]:
    """Findings on one run whose motion is made."""
    return list(implausible_slide(pipeline.to_run(), film=bool(pipeline.run.video)))


def acceleration_findings(pipeline: RunPipeline) -> list[Finding]:
    """What a mass that speeds up, or slows down too little, has against the incline of its run."""
    record = pipeline.to_run()
    lacks = find_missing_incline(pipeline, record)
    if lacks is not None and not _has_free_section(record):
        lacks = replace(lacks, grade=ERROR, words=f"{lacks.words}, or the part to be judged as free = [t0, t1]")
    return [f for f in (lacks, wrong_incline(record)) if f]


def _can_accelerate(study: Study) -> bool:
    """Whether the law of a study has a force that may speed the mass up: a spring, or one of the user's own."""
    law = study.model.split(",") if isinstance(study.model, str) else study.model
    own = {table.effect for table in study.effects if table.formula is not None}
    return any(name.strip() in own or name.strip() in ENERGY_STORING_EFFECTS for name in law)


def find_missing_incline(pipeline: RunPipeline, record: Run) -> Finding | None:
    """The incline that a run lacks, None where it lacks none."""
    track: Track | None = pipeline.get("track") if "track" in pipeline.stages else None
    return missing_incline(record, None if track is None else path_angle(track))


def _has_free_section(record: Run) -> bool:
    """Whether there is something to be fitted as the run is described now."""
    try:
        free_section(record)
    except FrictrackError:
        return False
    return True


def _study_file_findings(study: Study) -> Iterator[Finding]:
    """Findings on the numbers in the study file; what runs inherit concerns all of them."""
    raw = _raw_tables(study)
    tables = {_run_name(table): table for table in raw.get("run", [])}
    for run in (run for run in study.runs if not run.plausible):
        own = {key: tables.get(run.name, {}).get(key) for key in CHECKED_KEYS}
        held = {key: _inherited(raw, key) if own[key] is None else own[key] for key in CHECKED_KEYS}
        bare = frozenset(key for key, value in held.items() if _lacks_unit(value))
        for found in implausible(_entered_numbers(run, bare)):
            yield found if own[found.kind] is not None else replace(found, run="")


def _entered_numbers(run: RunTable, bare: frozenset[str]) -> Typed:
    """The numbers of a run."""
    pitch = float("nan") if run.scale is None else parse_scale(run.scale)[0]
    return Typed(
        run=run.name,
        mass=run.mass[0] if isinstance(run.mass, tuple) else None,
        pitch=pitch if np.isfinite(pitch) else None,
        fps=run.fps,
        incline=run.incline,
        bare=bare,
    )


def _raw_tables(study: Study) -> dict[str, Any]:
    """The tables of the study file as they were typed; none of a study that is not in a file."""
    try:
        return read_toml(study.path.name, study.path.read_text(encoding="utf-8"))
    except (FrictrackError, OSError, UnicodeDecodeError):  # it was changed meanwhile
        return {}


def _run_name(table: dict[str, Any]) -> str:
    """The name of a run; that of its recording where it has none."""
    return str(table.get("name") or Path(str(table.get("video") or table.get("table") or "")).stem)


def _inherited(raw: dict[str, Any], key: str) -> Any:
    return raw.get(TABLE_OF_INHERITED_KEY[key], {}).get(key) if key in TABLE_OF_INHERITED_KEY else None


def _lacks_unit(value: Any) -> bool:
    if isinstance(value, str):
        return NUMBER_WITHOUT_UNIT.fullmatch(value) is not None
    return isinstance(value, int | float) and not isinstance(value, bool)
