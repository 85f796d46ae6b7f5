"""A study file opened: read, and checked for all that can be checked before any work."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from frictrack.calibration import parse_scale
from frictrack.errors import FrictrackError, raise_faults
from frictrack.flow.stages import run_pipeline
from frictrack.flow.tried_models import FitRequest
from frictrack.study import Study, load, write_study


def open_study(path: str | Path, *, bare: bool = False) -> Study:
    """Read a study file and check all that can be checked before any work: scales, model, effects.

    A `bare` one may have no runs yet. Raises `FrictrackError` (usage) with every fault.
    """
    return check_study(load(path, bare=bare))


def check_study(study: Study) -> Study:
    """The same of a study that was read."""
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


def start_study(path: Path, recordings: Sequence[Path], keys: Mapping[str, Any]) -> Study:
    """Write the study file of bare recordings and open it; nothing is left behind when they cannot be used.

    Raises `FrictrackError`: (usage) where a study file is already, else what is wrong with a recording.
    """
    missing = [f"expected a recording {p} but there is no such file" for p in recordings if not p.exists()]
    if missing:
        raise FrictrackError("; ".join(missing), usage=True)
    write_study(path, recordings, keys)
    try:
        study = open_study(path)
        for pipeline in (run_pipeline(study, run) for run in study.runs):
            pipeline.get("recording" if pipeline.run.video else "displacement")
    except FrictrackError:
        path.unlink()
        raise
    return study


def _fault(check: Callable[[], Any], what: str) -> list[str]:
    try:
        check()
    except FrictrackError as e:
        return [f"{what}: {e}"]
    return []
