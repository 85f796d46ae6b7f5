"""Open a study, check it before any computation so that no work is lost, and bring its runs up to date."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from frictrack import measure
from frictrack import study as study_files
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.workers import WorkerPool
from frictrack.flow import stages, stored_results
from frictrack.flow.pipeline import Progress, RunPipeline
from frictrack.flow.plausibility_checks import Findings
from frictrack.flow.tried_models import FitRequest
from frictrack.study import COLUMNS, RunTable, Study, load

_OF_A_RUN = re.compile(r'run ("[^"]*")(?:, \w+)?: (?:[^ :]+\.\w+: )?(.*)', re.DOTALL)
STAGES_FROM_MOTION = ("motion", "events", "cutoff", "friction")


def open_study(path: str | Path, *, allow_incomplete: bool = False) -> Study:
    """Read a study file and check it: keys, scales, model, effects.

    Parameters
    ----------
    path
        The study file, or a folder with a ``study.toml``.
    allow_incomplete
        Allow a study without runs, and runs without mass or scale. It can be edited, not computed.

    Raises
    ------
    FrictrackError
        (usage) With all faults.

    """
    return check_study(load(path, allow_incomplete=allow_incomplete))


def check_study(study: Study) -> Study:
    """Check scales, model and effects of a study that was read; return the study."""
    scaled = [run for run in study.runs if run.scale is not None]
    parse_scale = measure.calibration.parse_scale
    checks: dict[str, Any] = {f'run "{run.name}"': partial(parse_scale, run.scale) for run in scaled}
    checks["model"] = partial(FitRequest(study.model).model, study.effects)
    faults = [f"{what}: {error}" for what, check in checks.items() for error in _errors(check)]
    if faults:
        raise UsageError(f"{study.path.name}: {'; '.join(faults)}")
    return study


def _errors(check: Callable[[], Any]) -> list[FrictrackError]:
    """Return the error of a check, if there is one."""
    try:
        check()
    except FrictrackError as e:
        return [e]
    return []


def _pass_all(checks: Iterable[Callable[[], Any]]) -> None:
    """Make several checks; raise one error with those of all."""
    errors = [error for check in checks for error in _errors(check)]
    if errors:
        raise FrictrackError("; ".join(_without_repeats(errors)), usage=all(error.usage for error in errors))


def _without_repeats(errors: Iterable[FrictrackError]) -> Iterator[str]:
    """Yield the errors of runs; what several have in common is told of the first, with the names of the others."""
    groups: dict[str, list[str]] = {}  # what is wrong -> the first error, and the names of all its runs
    for text in map(str, errors):
        found = _OF_A_RUN.match(text)
        groups.setdefault(found[2] if found else text, [text]).append(found[1] if found else "")
    for text, _, *others in groups.values():
        yield text + (f"; the same in {', '.join(others)}" if others else "")


def check_inputs(pipelines: Sequence[RunPipeline]) -> None:
    """Open every recording and read every table of the runs that are not measured yet.

    A recording at an address is not fetched before it is needed.
    """
    _pass_all(partial(check, pipeline) for check in (_check_mass, _check_files) for pipeline in pipelines)


def _table_needs_mass(run: RunTable) -> bool:
    """Return whether a run of a table has no mass, and nothing that makes it needless: friction, a sensor or points."""
    if not isinstance(run.table, Path) or run.mass is not None or run.sensor is not None or run.is_of_points:
        return False
    written = run.columns.get("friction", COLUMNS["friction"][0])
    table = study_files.open_table(run.table, [header for header, _ in COLUMNS.values()])
    headers = list(map(str, table.frame.columns))
    named = study_files.find_header(written.lstrip("-"), headers)
    return named is None and not study_files.guess_points(headers)


def _check_mass(pipeline: RunPipeline) -> None:
    """Raise an error if the run of a table needs a mass; films are checked when the study file is read."""
    if _table_needs_mass(pipeline.run):
        raise UsageError(
            f'run "{pipeline.run.name}": expected a mass but got none; give mass = "0.35 kg" in [study] or in its '
            "[[run]], or --mass 0.35kg; only runs with measured friction (columns = {friction = ...}), or with a "
            'measured drive and mass = "fit", do without'
        )


def _check_files(pipeline: RunPipeline) -> None:
    """Open the recording and read the tables of one run, unless it is measured."""
    if isinstance(pipeline.run.source, Path) and not pipeline.is_current("friction"):
        first = next(iter(pipeline.stages))
        sensors = [("drive", ("drive",)), ("sensor", ("a", "friction"))]
        _pass_all([partial(pipeline.get, first), *(partial(_check_sensor, pipeline.run, *one) for one in sensors)])


def _check_sensor(run: RunTable, key: str, wanted: tuple[str, ...]) -> None:
    """Read the table of a drive or a sensor, if there is one."""
    given = getattr(run, key)
    spec = {"table": given} if isinstance(given, Path) else given
    if not isinstance(spec, dict) or not isinstance(spec.get("table"), Path):
        return
    try:
        wanted = ("pressure",) if "area" in spec else wanted
        study_files.read_sensor_table(spec["table"], wanted, spec.get("columns", {}))
    except FrictrackError as e:
        raise FrictrackError(f'run "{run.name}", {key}: {e}', usage=e.usage) from e


class MeasuredRuns:
    """The runs of a study; they are brought up to date stage by stage, and their numbers are checked on the way."""

    def __init__(self, study: Study, progress: Progress, pool: WorkerPool | None) -> None:
        self._study, self._progress = study, progress
        self.pipelines = stages.run_pipelines(study, progress, pool)
        self.findings = Findings(study)  # implausible numbers of the study that were found so far
        self._inputs_checked = False

    def bring_up_to(self, stage: str) -> list[RunPipeline]:
        """Bring every run up to date; see `frictrack.flow.session.Session.bring_up_to`."""
        if self._study.incomplete:
            raise UsageError(f"{self._study.path.name}: {'; '.join(self._study.incomplete)}")
        self.findings.check_study_file()
        if not self._inputs_checked:
            check_inputs(self.pipelines)
            self._inputs_checked = True
        if stage in STAGES_FROM_MOTION:
            tables = [p for p in self.pipelines if p.run.table]
            if tables and len(tables) < len(self.pipelines):  # before films are tracked: columns may have other units
                self._update("motion", tables)
                self.findings.check_tables(tables)
            self._update("motion", self.pipelines)
            self.findings.check_runs(self.pipelines)
        self._update(stage, self.pipelines)
        if stage == "friction":
            self.findings.check_all_runs(self.pipelines)
            self.findings.save(self.pipelines)
        return self.pipelines

    def _update(self, stage: str, pipelines: list[RunPipeline]) -> None:
        missing = [p for p in pipelines if stage in p.stages and not p.is_current(stage)]
        if not missing:  # nothing is said of work that is not done
            return
        count = "1 run" if len(missing) == 1 else f"{len(missing)} runs"
        self._progress(0, 0, f"measuring {count} up to {stage}")
        for i, pipeline in enumerate(pipelines):
            self._progress(i, len(pipelines), "runs")
            if stage in pipeline.stages:
                pipeline.get(stage)
        self._progress(len(pipelines), len(pipelines), "runs")

    def update_all_stages(self) -> None:
        """Compute every stage of every run that is missing or outdated."""
        for pipeline in self.pipelines:
            with pipeline.saved_together():
                for stage in pipeline.stages:
                    pipeline.get(stage)

    def summaries(self, stage: str, *, overlay: bool = False) -> list[dict[str, Any]]:
        """Bring every run up to "track", "motion" or "friction", and return a row of numbers for each."""
        for pipeline in self.pipelines if overlay else ():
            if pipeline.run.video:
                stages.write_overlay(pipeline)
        pipelines = self.bring_up_to("tracks" if stage == "track" else stage)
        if stage != "track":
            self.bring_up_to("cutoff")
        return stored_results.run_summaries(pipelines, stage)

    def notes(self) -> list[dict[str, str]]:
        """Notes on the displacement of every run and on its impact; notes that nothing was found are left out."""
        notes = [(p.run.name, note) for p in self.pipelines for note in p.get("displacement").notes]
        found = [(run, note) for run, note in notes if not note.startswith(("no ", "nothing "))]
        found += [(p.run.name, words) for p in self.pipelines if (words := measure.friction.impact(p.to_run()))]
        return [{"run": run, "words": words} for run, words in found]
