"""Open a study, check it before any computation, bring its runs up to date, and change its file and current model.

A key is written into the study file only if the file stays valid, perhaps still incomplete; comments are kept. The
command history records every change with the state before it.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from frictrack import measure
from frictrack import study as study_files
from frictrack.base.errors import FrictrackError, UsageError
from frictrack.base.files import replace_text
from frictrack.base.workers import WorkerPool
from frictrack.flow import stages, stored_results
from frictrack.flow.pipeline import Progress, RunPipeline
from frictrack.flow.plausibility_checks import Findings
from frictrack.flow.tried_models import FitRequest, TriedModels
from frictrack.study import COLUMNS, RunTable, Study, load, parse

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


FORMULA = re.compile(r"formula:(\d+)")


Edit = Callable[..., dict[str, Any]]
"""Function ``edit(models, **arguments)`` that changes a study, records the command and returns what it did."""


def _edit(command: str, rewrite: Callable[..., str]) -> Edit:
    """Return an edit that rewrites the study file by ``rewrite(models, text, **arguments)`` and returns these."""

    def edit(models: TriedModels, /, **arguments: Any) -> dict[str, Any]:
        with models.commands.record(command, **arguments) as change:
            change.before, change.after = _rewrite(models.study.path, partial(rewrite, models, **arguments))
        return arguments

    return edit


def _set_key(models: TriedModels, table: str, key: str, value: Any, which: str | None = None) -> dict[str, Any]:
    """Set one key of the study file."""
    return _edit("edit", _with_key)(models, table=table, which=which, key=key, value=value)


def _with_key(models: TriedModels, text: str, table: str, which: str | None, key: str, value: Any) -> str:
    after = study_files.with_key(text, table, key, value, which)
    if table == "effect" and models.current_group is not None:  # else only the next fit would fail
        request = models.request(models.current_group)
        request.model(parse(models.study.path, after, allow_incomplete=True).effects)
    return after


def _with_recordings(models: TriedModels, text: str, recordings: Sequence[str]) -> str:
    """Add a run for each recording."""
    paths = [models.study.folder / name for name in recordings]
    if missing := [str(path) for path in paths if not path.exists()]:
        raise UsageError(f"expected a recording {', '.join(missing)} but there is no such file")
    return study_files.writing.with_runs(text, models.study.folder, paths)


def _select_model(models: TriedModels, model: str) -> dict[str, Any]:
    """Make a model current that was tried before."""
    if model not in models.groups:
        known = ", ".join(models.groups) or "none"
        raise UsageError(f'expected a model that was tried but got "{model}"; there are {known}')
    with models.commands.record("use", model=model) as change:
        change.before, change.after = {"current": models.current_group}, {"current": model}
        models.select(model)
    return {"model": model}


def _undo_or_redo(models: TriedModels, command: str) -> dict[str, Any]:
    """Undo the last change, or redo the change that was undone last; the models tried stay in the history."""
    with models.commands.record(command) as record:
        done, undone = models.commands.undo_stacks()
        stack = done if command == "undo" else undone
        if not stack:
            raise FrictrackError(f"there is nothing to {command}")
        change = stack[-1]
        old, new = (change.after, change.before) if command == "undo" else (change.before, change.after)
        if "toml" in new:
            _rewrite(models.study.path, lambda text: _swap(text, old["toml"], new["toml"]))
        else:
            models.select(new["current"])
        record.arguments = {"of": change.revision}
    return {"change": change.command, **change.arguments}


EDITS: dict[str, Edit] = {
    "edit": _set_key,
    "take_in": _edit("take_in", _with_recordings),
    "leave_out": _edit("leave_out", lambda _, text, run: study_files.writing.without_run(text, run)),
    "define": _edit("define", lambda _, text, effect: study_files.writing.with_effect(text, effect)),
    "use": _select_model,
    "undo": partial(_undo_or_redo, command="undo"),
    "redo": partial(_undo_or_redo, command="redo"),
}


def _swap(text: str, old: str, new: str) -> str:
    if text != old:
        raise FrictrackError("the study file was edited by hand since; undo the change there")
    return new


def _rewrite(path: Path, rewrite: Callable[[str], str]) -> tuple[dict[str, str], dict[str, str]]:
    """Replace the text of the study file; return the states before and after, as the history has them.

    Raises `FrictrackError` if the file would not be valid, and leaves it unchanged.
    """
    before = path.read_bytes().decode()
    after = rewrite(before)
    check_study(parse(path, after, allow_incomplete=True))
    replace_text(path, after)
    return {"toml": before}, {"toml": after}


def formula_number(effect: str) -> int | None:
    """Return n of "formula:n"; None for the name of an effect.

    Examples
    --------
    >>> formula_number("formula:2"), formula_number("texture")
    (2, None)

    """
    named = FORMULA.fullmatch(effect)
    return int(named[1]) if named else None


def effect_of_formula(found: Mapping[str, Any], taken: Iterable[str]) -> dict[str, Any]:
    """Return the keys of the ``[[effect]]`` table of one formula.

    Parameters
    ----------
    found
        An entry of "formulas" of the JSON of `frictrack diagnose`.
    taken
        Names of the effects that the study has; another name is chosen.

    Returns
    -------
    dict
        The keys, with "effect" for the name; empty if the formula has no table.

    """
    table: dict[str, Any] = tomllib.loads(found["toml"])["effect"][0] if found.get("toml") else {}
    if not table:
        return {}
    known = set(taken)
    names = (f"{table['effect']}{mark}" for mark in ("", *(f"_{k}" for k in range(2, len(known) + 3))))
    return table | {"effect": next(one for one in names if one not in known)}


def choose_formula(
    number: int, diagnosis: Mapping[str, Any] | None, taken: Iterable[str], model: Sequence[str]
) -> dict[str, Any]:
    """Return the keys of the ``[[effect]]`` table of formula `number` of a diagnosis, counted from 1."""
    if diagnosis is None:
        raise UsageError(
            f"expected a diagnosis for formula:{number} but the current model has none; run frictrack diagnose first"
        )
    formulas = (diagnosis.get("unexplained") or {}).get("formulas") or []
    if not 1 <= number <= len(formulas):
        known = f"formula:1 to formula:{len(formulas)}" if formulas else "no formula, because none was needed or found"
        raise UsageError(f"expected a formula of the last diagnosis but got formula:{number}; it has {known}")
    one = formulas[number - 1]
    if absent := [name for name in one.get("beside") or [] if name not in model]:
        names = ", ".join(absent)
        raise UsageError(f"formula:{number} was found beside {names}; add {names} first")
    return effect_of_formula(one, taken)
