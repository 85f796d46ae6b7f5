"""Open a study file and check everything that can be checked before any computation."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from frictrack.calibration import parse_scale
from frictrack.errors import FrictrackError, raise_faults
from frictrack.flow.fit_request import FitRequest
from frictrack.study import Study, load


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
    """Check scales, model and effects of a study that was read; return the study.

    Raises
    ------
    FrictrackError
        (usage) With all faults.

    """
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
