"""Open a study and check everything that can be checked before any computation, so that no work is lost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from frictrack.base.errors import FrictrackError, raise_faults
from frictrack.flow.fit_request import FitRequest
from frictrack.flow.pipeline import RunPipeline
from frictrack.measure.calibration import parse_scale
from frictrack.study import COLUMNS, RunTable, Study, load


def open_study(path: str | Path, *, allow_no_runs: bool = False, allow_incomplete: bool = False) -> Study:
    """Read a study file and check it: keys, scales, model, effects.

    Parameters
    ----------
    path
        The study file, or a folder with a ``study.toml``.
    allow_no_runs
        Allow a study without runs.
    allow_incomplete
        Allow a study without runs, and runs without mass or scale. It can be edited, not computed.

    Raises
    ------
    FrictrackError
        (usage) With all faults.

    """
    return check_study(load(path, allow_no_runs=allow_no_runs, allow_incomplete=allow_incomplete))


def check_study(study: Study) -> Study:
    """Check scales, model and effects of a study that was read; return the study."""
    faults = []
    for run in study.runs:
        if run.scale is not None:
            faults += _fault(lambda run=run: parse_scale(run.scale), f'run "{run.name}"')  # type: ignore[misc]
    faults += _fault(lambda: FitRequest(study.model).model(study.effects), "model")
    try:
        raise_faults(faults, study.path.name)
    except FrictrackError as e:
        raise FrictrackError(str(e), usage=True) from e
    return study


def _fault(check: Callable[[], Any], what: str) -> list[str]:
    try:
        check()
    except FrictrackError as e:
        return [f"{what}: {e}"]
    return []


def check_inputs(pipelines: Sequence[RunPipeline]) -> None:
    """Open every recording and read every table of the runs that are not measured yet.

    A recording at an address is not fetched before it is needed.
    """
    errors = [error for check in (_check_mass, _check_files) for p in pipelines for error in _errors(check, p)]
    if errors:
        raise FrictrackError("; ".join(map(str, errors)), usage=all(error.usage for error in errors))


def _errors(check: Callable[[RunPipeline], None], pipeline: RunPipeline) -> list[FrictrackError]:
    """Return the error of a check of one run, if there is one."""
    try:
        check(pipeline)
    except FrictrackError as e:
        return [e]
    return []


def table_needs_mass(run: RunTable) -> bool:
    """Return whether a run of a table has no mass, and nothing that makes it needless.

    Only the headers are read, so that this comes at once.

    Parameters
    ----------
    run
        The run.

    Raises
    ------
    FrictrackError
        If the table cannot be read.

    """
    from frictrack.study import find_header, guess_points, table_headers  # noqa: PLC0415 - not needed for stored results

    if not isinstance(run.table, Path) or run.mass is not None or run.sensor is not None or run.is_of_points:
        return False
    written = run.columns.get("friction", COLUMNS["friction"][0])
    headers = table_headers(run.table, [header for header, _ in COLUMNS.values()])
    return find_header(written.lstrip("-"), headers) is None and not guess_points(headers)


def _check_mass(pipeline: RunPipeline) -> None:
    """Raise an error if the run of a table needs a mass; films are checked when the study file is read."""
    if table_needs_mass(pipeline.run):
        raise FrictrackError(
            f'run "{pipeline.run.name}": expected a mass but got none; give mass = "0.35 kg" in [study] or in its '
            "[[run]], or --mass 0.35kg; only runs with measured friction (columns = {friction = ...}), or with a "
            'measured drive and mass = "fit", do without',
            usage=True,
        )


def _check_files(pipeline: RunPipeline) -> None:
    """Open the recording and read the tables of one run, unless it is measured."""
    if not isinstance(pipeline.run.source, Path) or pipeline.is_current("friction"):
        return
    faults = _errors(lambda p: p.get(next(iter(p.stages))), pipeline)
    for key, wanted in (("drive", ("drive",)), ("sensor", ("a", "friction"))):
        faults += _errors(partial(_check_sensor, key=key, wanted=wanted), pipeline)
    if faults:
        raise FrictrackError("; ".join(map(str, faults)), usage=all(fault.usage for fault in faults))


def _check_sensor(pipeline: RunPipeline, *, key: str, wanted: tuple[str, ...]) -> None:
    """Read the table of a drive or a sensor, if there is one."""
    from frictrack.study import read_sensor_table  # noqa: PLC0415

    given = getattr(pipeline.run, key)
    spec = {"table": given} if isinstance(given, Path) else given
    if not isinstance(spec, dict) or not isinstance(spec.get("table"), Path):
        return
    try:
        read_sensor_table(spec["table"], ("pressure",) if "area" in spec else wanted, spec.get("columns", {}))
    except FrictrackError as e:
        raise FrictrackError(f'run "{pipeline.run.name}", {key}: {e}', usage=e.usage) from e
