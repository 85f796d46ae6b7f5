"""Plan which runs to film: collect what is known before or after the first films, and write the page of the plan."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack.calibration import parse_scale
from frictrack.errors import FrictrackError
from frictrack.flow.pipeline import Progress, no_progress
from frictrack.flow.session import Session
from frictrack.results import to_builtins
from frictrack.study import Study

if TYPE_CHECKING:
    from frictrack.plan import ExperimentSetup


def plan(study: Study, progress: Progress = no_progress) -> dict[str, Any]:
    """Plan which runs to film so that the effects can be distinguished: JSON of `frictrack plan`.

    The page ``plan.html`` is written, too.

    Parameters
    ----------
    study
        A study; it may have no runs yet.
    progress
        Called as ``progress(done, total, what)``.

    Raises
    ------
    FrictrackError
        If mass, frame rate or scale are unknown, or the folder cannot be written.

    """
    from frictrack.plan import choose_runs, summarise_plan  # noqa: PLC0415
    from frictrack.report import write_plan  # noqa: PLC0415 - loads matplotlib

    named: dict[str, Any] = {"next": None, "next_reason": None}
    if study.runs:
        session = Session(study, progress)
        session.bring_up_to("friction")
        setup, named = _setup_of_fit(session), session.name_next_run()
    else:
        setup = replace(_setup_without_runs(study), costs=study.costs)
    run_plan = choose_runs(setup, progress)
    summary = to_builtins({**summarise_plan(run_plan), **named, "name": study.name})
    page = write_plan(summary, study.output / "plan.html")
    return {**summary, "page": str(page), "output": str(study.output)}


def _setup_without_runs(study: Study) -> ExperimentSetup:
    """Return the set-up of a study without films: mass and camera are given, the rest is assumed."""
    from frictrack.plan import default_setup  # noqa: PLC0415

    faults = []
    if study.mass is None:
        faults.append('expected a mass in [study] but got none; give mass = "0.35 kg" (roughly is enough)')
    if study.fps is None:
        faults.append("expected the frame rate in [camera] but got none; give fps = 4000")
    if study.scale is None:
        faults.append('expected a scale in [camera] but got none; give scale = "0.5 mm/px" (roughly is enough)')
    if faults:
        raise FrictrackError(f"{study.path.name}, plan: " + "; ".join(faults), usage=True)
    assert study.mass is not None
    assert study.fps is not None
    pitch = parse_scale(study.scale)[0]
    if not np.isfinite(pitch):
        raise FrictrackError(
            "expected a scale that is known before filming but got one that needs a picture; give its rough value, "
            'scale = "0.5 mm/px"'
        )
    return default_setup(study.mass[0], study.fps, pitch)


def _setup_of_fit(session: Session) -> ExperimentSetup:
    """Return the set-up as the current fit describes it."""
    from frictrack.fit import Fit  # noqa: PLC0415
    from frictrack.plan import fitted_setup  # noqa: PLC0415

    fitted = session.models.fit(session.models.current()[0])
    if not isinstance(fitted, Fit):
        raise FrictrackError("expected one fit of all runs to plan with but got one per group; fit without --per first")
    return fitted_setup(fitted, session.study.costs)
