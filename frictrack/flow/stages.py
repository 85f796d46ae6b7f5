"""Define the stages of one run: two tables, one for films and one for tables of measured positions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from frictrack.filters import SETTINGS as FILTER_SETTINGS
from frictrack.flow.pipeline import Progress, RunPipeline, Stage, no_progress
from frictrack.records import CutoffTradeOff, Displacement, Filtered, Friction, Motion, RunEvents, Track
from frictrack.results import RecordingInfo, Sensors
from frictrack.study import RunTable, Study

if TYPE_CHECKING:
    from frictrack.workers import WorkerPool


def _function(name: str) -> Callable[..., Any]:
    """Return a function of `stage_functions`; that module, which loads the science, is imported when it is called."""

    def make(pipeline: RunPipeline, *inputs: Any) -> Any:
        from frictrack.flow import stage_functions  # noqa: PLC0415

        return getattr(stage_functions, name)(pipeline, *inputs)

    return make


def _stage_table(*head: Stage) -> dict[str, Stage]:
    """Return a table of stages: the given ones, then those that every run has after its displacement."""
    tail = (
        Stage(
            "sensors",
            ("displacement",),
            ("drive", "sensor"),
            _function("make_sensors"),
            Sensors,
        ),
        Stage("filtered", ("displacement", "sensors"), FILTER_SETTINGS, _function("make_filtered"), Filtered),
        Stage("motion", ("filtered",), (), _function("make_motion"), Motion),
        Stage(
            "cutoff",
            ("displacement", "filtered", "motion"),
            (),
            _function("make_cutoff"),
            CutoffTradeOff,
        ),
        Stage(
            "friction",
            ("displacement", "motion", "sensors"),
            ("mass", "incline", "normal_load", "free"),
            _function("make_friction"),
            Friction,
        ),
        Stage(
            "events",
            ("displacement", "motion", "sensors"),
            ("mass", "incline", "normal_load", "free"),
            _function("make_events"),
            RunEvents,
        ),
    )
    return {stage.name: stage for stage in (*head, *tail)}


FILM = _stage_table(
    Stage("recording", (), ("video", "fps"), _function("make_recording"), RecordingInfo),
    Stage("track", ("recording",), ("target", "template", "exclude", "obstacles"), _function("make_track"), Track),
    Stage(
        "tracks", ("recording", "track"), ("reference", "targets", "obstacles"), _function("make_further_tracks"), dict
    ),
    Stage(
        "displacement",
        ("tracks", "track"),
        ("scale", "lens", "axis", "origin_px", "x_offset", "repair"),
        _function("make_video_displacement"),
        Displacement,
    ),
)
# Repairs come after the track, which stays stored as it was: undoing a repair does not track the film again.
FILM_REPAIRED = _stage_table(
    *(FILM[name] for name in ("recording", "track", "tracks")),
    Stage("repaired", ("recording", "track", "tracks"), ("repair",), _function("make_repaired"), Track),
    replace(FILM["displacement"], inputs=("tracks", "repaired")),
)
TABLE = _stage_table(
    Stage(
        "displacement",
        (),
        ("table", "columns", "fps", "scale", "x_offset", "repair"),
        _function("make_table_displacement"),
        Displacement,
    ),
)


def run_pipeline(
    study: Study, run: RunTable, progress: Progress = no_progress, *, stored_only: bool = False
) -> RunPipeline:
    """Return the pipeline of a run: the stages of a film, or those of a table of positions.

    Parameters
    ----------
    study, run
        The study, and the ``[[run]]`` of it.
    progress
        Called while a stage is being computed.
    stored_only
        Take every stored result as up to date: nothing is computed and no recording is opened.

    """
    film = FILM_REPAIRED if run.repair else FILM
    return RunPipeline(study, run, film if run.video else TABLE, progress, stored_only=stored_only)


def run_pipelines(study: Study, progress: Progress = no_progress, pool: WorkerPool | None = None) -> list[RunPipeline]:
    """Return the pipelines of all runs; those of films share one, and the target learnt from its film.

    Parameters
    ----------
    study
        The study.
    progress
        Called while a stage is being computed.
    pool
        Processes that take over segments of long films.

    """
    found = [run_pipeline(study, run, progress) for run in study.runs]
    for pipeline in found:
        pipeline.pool = pool
    films = sorted((pipeline for pipeline in found if pipeline.run.video), key=lambda one: one.run.name)
    for pipeline in films[1:]:
        pipeline.anchor = films[0]
    return found
