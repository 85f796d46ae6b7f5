"""Check a study before any further computation: the numbers in its file, each run, and all runs together."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import chain, combinations
from pathlib import Path
from typing import Any

import numpy as np

from frictrack import effects, measure, sampling, study
from frictrack.base.errors import FrictrackError, raise_faults
from frictrack.base.remote import local_path
from frictrack.base.units import lacks_unit
from frictrack.effects import models
from frictrack.flow import store
from frictrack.flow.pipeline import RunPipeline, digest
from frictrack.flow.store import GroupContent, Provenance
from frictrack.records import Array, Displacement, Run
from frictrack.results import to_builtins
from frictrack.study import COLUMNS, Study, name_of_table, read_toml

LOG = logging.getLogger("frictrack")
FINDINGS = "findings"  # group of study.h5
# Keys that are checked, and the table of the study file that a run inherits each from.
CHECKED_KEYS = {"mass": "study", "scale": "camera", "fps": "camera", "incline": ""}


class Findings:
    """Collect the implausible numbers of a study; each is reported once.

    A finding is logged as a warning before the work that it concerns. One that cannot be right raises an error, unless
    the study file says `plausible = "checked"`.
    """

    def __init__(self, study: Study) -> None:
        self.study = study
        self._found: dict[str, measure.plausibility.Finding] = {}
        self._checked: set[str] = set()  # names of the checks that were made

    @property
    def summary(self) -> list[dict[str, Any]]:
        """The findings as JSON."""
        return [to_builtins(finding.to_dict()) for finding in self._found.values()]

    @property
    def messages(self) -> tuple[str, ...]:
        """The findings as sentences."""
        return tuple(self._found)

    @property
    def contradictions(self) -> tuple[measure.plausibility.Finding, ...]:
        """The findings in which measured data contradict the study file."""
        return tuple(finding for finding in self._found.values() if finding.contradicts)

    def save(self, pipelines: Sequence[RunPipeline]) -> None:
        """Store the findings beside the results, from which report and page read them."""
        path = self.study.output / "study.h5"
        is_empty = not self.summary and store.provenance(path, FINDINGS) is None
        if not is_empty and stored_findings(path, pipelines) != self.summary:
            store.write(path, {FINDINGS: GroupContent({"warnings": self.summary}, _provenance(pipelines))})

    def check_study_file(self) -> None:
        """Check the numbers in the study file; a number that several runs inherit is reported once."""
        self._check_once("study", lambda: _study_file_findings(self.study))

    def check_tables(self, pipelines: Sequence[RunPipeline]) -> None:
        """Check the motion of tables alone, before films are tracked: their columns may have other units."""
        self._check_once("tables", lambda: chain.from_iterable(map(slide_findings, pipelines)))

    def check_runs(self, pipelines: Sequence[RunPipeline]) -> None:
        """Check the motion of each run, and runs in opposite directions against each other."""
        if not _can_accelerate(self.study):
            runs = [pipeline.to_run() for pipeline in pipelines]
            self._check_once("inclines", lambda: measure.plausibility.implausible_inclines(runs))
            self._check_once("accelerations", lambda: chain.from_iterable(map(acceleration_findings, pipelines)))
        self._check_once("runs", lambda: chain.from_iterable(map(slide_findings, pipelines)))

    def check_all_runs(self, pipelines: Sequence[RunPipeline]) -> None:
        """Check masses, clocks and sensors of all runs against each other, also of runs that are marked as checked."""
        runs = {pipeline.run.name: pipeline.to_run() for pipeline in pipelines}
        # the clock of a film is checked with its header
        stated = {pipeline.run.name: pipeline.run.fps for pipeline in pipelines if pipeline.run.table}
        sensors = {w.run.name: w.get("sensors").clocks.get("a", {}) for w in pipelines if w.run.sensor is not None}
        twice = partial(measure.plausibility.Finding, "copy", check=("table",))
        copies = partial(find_duplicate_runs, pipelines)
        self._check_once("copies", lambda: [twice(f"it is {note}", run=name) for name, note in copies().items()])
        self._check_once("all", lambda: measure.plausibility.implausible_masses(list(runs.values())))
        if not any(one.effect == "spring" and "x_0" in one.per_run for one in self.study.effects):
            self._check_once("origins", lambda: measure.plausibility.different_origins(runs))
        clocked = {name: runs[name] for name in stated}
        self._check_once("clocks", lambda: measure.plausibility.implausible_clocks(clocked, stated))
        self._check_once("sensors", lambda: measure.plausibility.implausible_sensors(sensors))

    def _check_once(self, what: str, find: Callable[[], Iterable[measure.plausibility.Finding]]) -> None:
        """Make a check unless it was made before; raise `FrictrackError` if a number cannot be right."""
        if what not in self._checked:
            self._add(find())
            self._checked.add(what)

    def _add(self, findings: Iterable[measure.plausibility.Finding]) -> None:
        """Add findings on runs that the user has not marked as checked; raise one `FrictrackError` with all errors."""
        checked = {run.name for run in self.study.runs if run.plausible}
        checked |= {""} if len(checked) == len(self.study.runs) else set()  # "": findings that concern all runs
        new = [f for f in findings if f.run not in checked and not self._is_known(f)]
        for finding in new:
            if finding.grade != measure.plausibility.ERROR and not self._is_known(finding):
                self._found[str(finding)] = finding
                LOG.warning("%s: warning: %s", self.study.path.name, finding)
        raise_faults(_error_messages([f for f in new if f.grade == measure.plausibility.ERROR]), self.study.path.name)

    def _is_known(self, finding: measure.plausibility.Finding) -> bool:
        """Return whether the same was found before, for this run or for all, and from evidence at least as strong."""
        same = [one for one in self._found.values() if one.kind == finding.kind and one.run in (finding.run, "")]
        return any(one.contradicts or not finding.contradicts for one in same)


def _provenance(pipelines: Sequence[RunPipeline]) -> Provenance:
    """Return what the findings depend on: measured runs, and which of them are marked as checked."""
    inputs = [(f"{p.path.name}:/{name}", p.key(name)) for p in pipelines for name in ("friction", "motion")]
    key = digest([FINDINGS, inputs, [[p.run.name, p.run.plausible] for p in pipelines]])
    return Provenance(key, digest([found for _, found in inputs]), json.dumps(inputs))


def stored_findings(path: Path, pipelines: Sequence[RunPipeline]) -> list[dict[str, Any]] | None:
    """Return the stored findings as JSON; None if there are none of these runs as they were measured last."""
    provenance = store.provenance(path, FINDINGS)
    if provenance is None or provenance.key != _provenance(pipelines).key:
        return None
    return list(store.read(path, FINDINGS)["warnings"])


def _error_messages(errors: Sequence[measure.plausibility.Finding]) -> list[str]:
    """Return the messages of errors, one for all errors with the same correction, and how to accept the number."""
    groups: dict[tuple[str, str], list[measure.plausibility.Finding]] = {}
    for error in errors:
        groups.setdefault((error.kind, error.correction or str(error)), []).append(error)
    messages = []
    for first, *more in groups.values():
        names = ", ".join(f'"{error.run}"' for error in more)
        same = f"; the same in {names}" if more else ""
        # the message on an incline says itself how to accept it
        accept = "" if first.kind == "incline" else f" (if it is right, {measure.plausibility.ACCEPTED})"
        messages.append(f"{first}{same}{accept}")
    return messages


def slide_findings(pipeline: RunPipeline) -> tuple[measure.plausibility.Finding, ...]:
    """Return findings on the motion of one run, with the headers of its own table, which is read if there are any."""
    run = pipeline.run

    @cache
    def present() -> list[str]:
        return [] if run.table is None else list(map(str, study.open_table(local_path(run.table)).frame.columns))

    def header(key: str) -> str:
        written = run.columns.get(key, COLUMNS[key][0])
        return study.find_header(written.lstrip("-"), present()) or written

    record = pipeline.to_run()
    found = measure.plausibility.implausible_slide(record, film=bool(run.video), header=header)
    if run.drive is not None or run.sensor is not None or measure.friction.has_measured_force(record):
        return found
    force = study.unnamed_force(present(), {header(key) for key in run.columns})
    if force is None:
        return found
    words = (
        f'its table has a column "{force}" that is not used, so the mass is taken to move freely; if it is the drive, '
        f'add drive = "{force}" to columns; if the friction, friction = "{force}"'
    )
    return (*found, measure.plausibility.Finding("drive", words, run=run.name, check=("columns",)))


def acceleration_findings(pipeline: RunPipeline) -> list[measure.plausibility.Finding]:
    """Return findings on a run that speeds up, or slows down too little, for the incline of the study file."""
    record = pipeline.to_run()
    lacks = find_missing_incline(pipeline, record)
    if lacks is not None:
        try:
            measure.friction.free_section(record)
        except FrictrackError:
            words = f"{lacks.words}, or the part to be judged as free = [t0, t1]"
            lacks = replace(lacks, grade=measure.plausibility.ERROR, words=words)
    return [f for f in (lacks, measure.plausibility.wrong_incline(record)) if f]


def _can_accelerate(study: Study) -> bool:
    """Return whether the model of a study can accelerate the mass: by a spring, or by an effect of the user."""
    law = models.names_in(study.model) if isinstance(study.model, str) else study.model
    known = effects.known()
    own = {table.effect for table in study.effects if table.formula is not None}
    return any(name in own or (name in known and known[name].may_pull) for name in map(str.strip, law))


def find_missing_incline(pipeline: RunPipeline, record: Run) -> measure.plausibility.Finding | None:
    """Return a finding if the run needs an incline that the study file lacks, else None."""
    angle = measure.plausibility.path_angle(pipeline.final_track) if "track" in pipeline.stages else None
    return measure.plausibility.missing_incline(record, angle)


def _study_file_findings(study: Study) -> Iterator[measure.plausibility.Finding]:
    """Find implausible numbers in the study file; what runs inherit concerns all of them."""
    try:
        raw = read_toml(study.path.name, study.path.read_text(encoding="utf-8"))
    except (FrictrackError, OSError, UnicodeDecodeError):  # the file was changed meanwhile
        raw = {}
    tables = {name_of_table(table, "run"): table for table in raw.get("run", [])}
    for run in (run for run in study.runs if not run.plausible):
        own = {key: tables.get(run.name, {}).get(key) for key in CHECKED_KEYS}
        above = {key: raw.get(table, {}).get(key) for key, table in CHECKED_KEYS.items()}
        values = {key: above[key] if own[key] is None else own[key] for key in CHECKED_KEYS}
        entered = measure.plausibility.EnteredValues(
            run=run.name,
            mass=run.mass[0] if isinstance(run.mass, tuple) else None,
            pitch=known_pitch(run.scale),
            fps=run.fps,
            incline=run.incline and run.incline[0],
            bare=frozenset(key for key, value in values.items() if lacks_unit(value)),
        )
        for found in measure.plausibility.implausible_entries(entered):
            yield found if own[found.kind] is not None else replace(found, run="")


def known_pitch(scale: Any) -> float | None:
    """Return the size of a pixel that a scale states, m; None if there is no scale, or it needs a picture."""
    pitch = float("nan") if scale is None else measure.calibration.parse_scale(scale)[0]
    return pitch if np.isfinite(pitch) else None


def find_duplicate_runs(pipelines: Sequence[RunPipeline]) -> dict[str, str]:
    """Return a note for every run that is the same recording as an earlier one, by the name of the run."""
    displacements = {pipeline.run.name: pipeline.get("displacement") for pipeline in pipelines}
    films = {pipeline.run.name: pipeline.get("recording").hash for pipeline in pipelines if pipeline.run.video}
    frictions = {pipeline.run.name: pipeline.get("sensors").friction_N for pipeline in pipelines}
    return duplicate_notes(displacements, films, frictions)


def duplicate_notes(
    displacements: Mapping[str, Displacement], contents: Mapping[str, str], frictions: Mapping[str, Array | None]
) -> dict[str, str]:
    """Return a note for every run that repeats an earlier one; a stage repeats its path, but not the friction on it."""
    forces = {k: replace(displacements[k], x=force) for k, force in frictions.items() if force is not None}
    same = sampling.copies(displacements) - (set(combinations(forces, 2)) - sampling.copies(forces))
    same |= {(one, other) for one, other in combinations(contents, 2) if contents[one] == contents[other]}
    found: dict[str, str] = {}
    for one, other in (pair for pair in combinations(displacements, 2) if pair in same):
        found.setdefault(other, f'the same recording as run "{one}": it is left out, because it tells nothing more')
    return found


def withhold_verdict(diagnosis: Mapping[str, Any], findings: Iterable[measure.plausibility.Finding]) -> dict[str, Any]:
    """Return a diagnosis with the verdict "undetermined" if findings contradict the study file.

    Examples
    --------
    >>> from frictrack.measure.plausibility import Finding
    >>> diagnosis = {"verdict": "missing", "missing": ["collision"], "model": ["coulomb"], "undetermined": []}
    >>> finding = Finding("mass", "the mass is 10 times too large", run="a", contradicts=True)
    >>> withhold_verdict(diagnosis, [finding])["verdict"]
    'undetermined'

    """
    contradictions = [f for f in findings if f.contradicts]
    if not contradictions:
        return dict(diagnosis)
    # an effect of the same cause in the model, or found missing, has dealt with the contradiction
    explained = _causes(name for key in ("model", "missing") for name in diagnosis.get(key, ()))
    first = [_undetermined_entry(f) for f in contradictions if f.kind not in explained]
    if not first:
        return dict(diagnosis)
    if why := why_unsearched(contradictions, diagnosis.get("model", ())):
        first[0]["why"] = f"{why}; {first[0]['why']}"
    return {**diagnosis, "verdict": "undetermined", "missing": [], "undetermined": [*first, *diagnosis["undetermined"]]}


def why_unsearched(findings: Iterable[measure.plausibility.Finding], model: Iterable[str] = ()) -> str:
    """Return why a search is void: numbers that are contradicted, for which no effect stands; empty if there are none.

    Beside a wrong incline every force comes out wrong, so an effect stands for it only in the `model` itself.

    Examples
    --------
    >>> from frictrack.measure.plausibility import Finding
    >>> why_unsearched([Finding("fps", "the clock is wrong", contradicts=True)])  # clock_rate may say so
    ''
    >>> why_unsearched([Finding("incline", "it is 2 degrees", contradicts=True)])
    'nothing was searched before the incline of the study is right'

    """
    searched = _causes(effects.known()) - {"incline"} | _causes(model)
    wrong = [f for f in findings if f.contradicts and f.kind not in searched]
    whose = list(dict.fromkeys(f"the {f.kind} of {f.run or 'the study'}" for f in wrong))
    are = "is" if len(whose) == 1 else "are"
    return f"nothing was searched before {' and '.join(whose)} {are} right" if wrong else ""


def _causes(names: Iterable[str]) -> set[str]:
    """Return the keys of the study file for whose errors some effects stand."""
    known, kinds = effects.known(), {name.split(":")[0] for name in names}
    return {known[kind].same_cause_as for kind in kinds if kind in known}


def _undetermined_entry(finding: measure.plausibility.Finding) -> dict[str, Any]:
    """Return a contradiction as an entry of "undetermined"."""
    what = f"the {finding.kind} of {finding.run or 'the study'}"
    return {"what": what, "why": finding.words, "settled_by": finding.correction, "limit_over_friction": None}
