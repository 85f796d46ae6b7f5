"""The stages of one run: what computes each of them, and two tables of them, for films and for tables of positions.

Every function takes the pipeline and the results of the stage's inputs. They import the science that they need when
they are called, so that stored results are read without it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from frictrack.base.errors import FrictrackError
from frictrack.base.remote import local_path
from frictrack.effects import models
from frictrack.flow import film_stages as film
from frictrack.flow.pipeline import Progress, RunPipeline, Stage, make_run, no_progress
from frictrack.records import CutoffTradeOff, Displacement, Filtered, Friction, Motion, Run, RunEvents, Track
from frictrack.results import RecordingInfo, Sensors
from frictrack.settings.filters import SETTINGS as FILTER_SETTINGS
from frictrack.study import RunTable, Study, TableData

if TYPE_CHECKING:
    from frictrack.base.workers import WorkerPool

KEYS_OF_FORCE = ("mass", "incline", "rolling", "normal_load", "free")
MASS_FIT_MODEL = "coulomb,viscous"  # fitted together with an unknown mass, before the study's model is fitted


def make_table_displacement(pipeline: RunPipeline) -> Displacement:
    """Compute the displacement of a table of positions."""
    from frictrack.measure.repairing import repaired_rows  # noqa: PLC0415
    from frictrack.measure.tables import displacement_of_table  # noqa: PLC0415
    from frictrack.study import read_run_table  # noqa: PLC0415

    run = pipeline.run
    found = displacement_of_table(read_run_table(run), fps=run.fps, scale=run.scale, x_offset=run.x_offset)
    return repaired_rows(found, run.repair)


def _points(pipeline: RunPipeline) -> TableData:
    """The points (v, F) of a run, in order of speed."""
    from frictrack.measure.points import points_of_table  # noqa: PLC0415
    from frictrack.study import read_points  # noqa: PLC0415

    assert pipeline.run.table is not None
    return points_of_table(read_points(local_path(pipeline.run.table), pipeline.run.columns))


def make_point_displacement(pipeline: RunPipeline) -> Displacement:
    """Read a table of points (v, F): rows at no known place."""
    from frictrack.measure.points import motion_of_points  # noqa: PLC0415

    return motion_of_points(_points(pipeline))[0]


def make_point_sensors(pipeline: RunPipeline, displacement: Displacement) -> Sensors:
    """Return the friction force of every point, with its deviation and load where they are known."""
    from frictrack.measure.points import forces_of_points, motion_of_points  # noqa: PLC0415

    points = _points(pipeline)
    measured = Sensors(displacement.t, friction_N=points.friction)
    load = make_run(pipeline.run, displacement, motion_of_points(points)[1], measured).load
    return replace(measured, **forces_of_points(points, load))


def make_point_filtered(pipeline: RunPipeline, displacement: Displacement) -> Filtered:
    """Return the rows of points as they are."""
    nan = displacement.y
    return Filtered(displacement.t, displacement.x, nan, nan, nan, reason="nothing is smoothed")


def make_point_motion(pipeline: RunPipeline, displacement: Displacement) -> Motion:
    """Return the speed of every point."""
    from frictrack.measure.points import motion_of_points  # noqa: PLC0415

    return motion_of_points(_points(pipeline))[1]


def make_sensors(pipeline: RunPipeline, displacement: Displacement) -> Sensors:
    """Read the drive and the sensors at the times of the frames."""
    from frictrack.flow.sensor_stage import read_sensors  # noqa: PLC0415

    return read_sensors(pipeline.run, displacement)


def make_filtered(pipeline: RunPipeline, displacement: Displacement, sensors: Sensors) -> Filtered:
    """Low-pass the displacement, with the acceleration of a sensor if it agrees with the camera."""
    from frictrack.flow.sensor_stage import fused_acceleration  # noqa: PLC0415
    from frictrack.measure.motion import low_pass  # noqa: PLC0415

    return low_pass(displacement, method=pipeline.run.filter_choice, acceleration=fused_acceleration(sensors))


def make_motion(pipeline: RunPipeline, filtered: Filtered) -> Motion:
    """Differentiate the filtered displacement."""
    from frictrack.measure.motion import differentiate  # noqa: PLC0415

    return differentiate(filtered)


def make_cutoff(
    pipeline: RunPipeline, displacement: Displacement, filtered: Filtered, motion: Motion
) -> CutoffTradeOff:
    """Compute what another cut-off frequency would change."""
    from frictrack.measure.motion import cutoff_tradeoff  # noqa: PLC0415

    return cutoff_tradeoff(displacement, filtered, motion)


def make_friction(pipeline: RunPipeline, displacement: Displacement, motion: Motion, sensors: Sensors) -> Friction:
    """Compute the friction force; an unknown mass is estimated first."""
    from frictrack.measure.friction import friction  # noqa: PLC0415

    run = make_run(pipeline.run, displacement, motion, sensors)
    if run.mass is not None or run.friction_N is not None:
        return _friction_or_missing_incline(pipeline, run)
    weighed, says = _with_fitted_mass(run)
    found = friction(weighed)
    return replace(found, reason=f"{found.reason}; {says}")


def make_events(pipeline: RunPipeline, displacement: Displacement, motion: Motion, sensors: Sensors) -> RunEvents:
    """Find release, stops and reversals."""
    from frictrack.measure.friction import find_events  # noqa: PLC0415

    return find_events(make_run(pipeline.run, displacement, motion, sensors))


def _friction_or_missing_incline(pipeline: RunPipeline, run: Run) -> Friction:
    """Compute the friction force of a run; if it has no free section because the incline is missing, say so."""
    from frictrack.measure.friction import friction  # noqa: PLC0415
    from frictrack.measure.plausibility import missing_incline, path_angle  # noqa: PLC0415

    try:
        return friction(run)
    except FrictrackError as e:
        lacks = missing_incline(run, path_angle(pipeline.final_track) if "track" in pipeline.stages else None)
        if lacks is None:
            raise
        raise FrictrackError(lacks.words) from e


def _with_fitted_mass(run: Run) -> tuple[Run, str]:
    """Return a run of unknown mass with the mass that its drive determines, and a sentence for the user."""
    from frictrack.fit import fit  # noqa: PLC0415 - a second that runs of known mass need not wait for

    found = fit(models.parse(MASS_FIT_MODEL), [run]).parameters["mass.m"]
    if found.value is None or found.std is None:
        raise FrictrackError(f'mass = "fit": {found.reason}')
    says = f"mass {found.value:.4g} ± {found.std:.2g} kg, fitted to the drive with Coulomb and viscous friction"
    return replace(run, mass=found.value, sigma_mass=found.std), says


def _stage_table(*head: Stage) -> dict[str, Stage]:
    """Return a table of stages: the given ones, then those that every run has after its displacement."""
    tail = (
        Stage("sensors", ("displacement",), ("drive", "sensor"), make_sensors, Sensors),
        Stage("filtered", ("displacement", "sensors"), FILTER_SETTINGS, make_filtered, Filtered),
        Stage("motion", ("filtered",), (), make_motion, Motion),
        Stage("cutoff", ("displacement", "filtered", "motion"), (), make_cutoff, CutoffTradeOff),
        Stage("friction", ("displacement", "motion", "sensors"), KEYS_OF_FORCE, make_friction, Friction),
        Stage("events", ("displacement", "motion", "sensors"), KEYS_OF_FORCE, make_events, RunEvents),
    )
    return {stage.name: stage for stage in (*head, *tail)}


FILM = _stage_table(
    Stage("recording", (), ("video", "fps"), film.make_recording, RecordingInfo),
    Stage("track", ("recording",), ("target", "template", "exclude", "obstacles"), film.make_track, Track),
    Stage("tracks", ("recording", "track"), ("reference", "targets", "obstacles"), film.make_further_tracks, dict),
    Stage(
        "displacement",
        ("tracks", "track"),
        ("scale", "lens", "axis", "origin_px", "x_offset", "repair"),
        film.make_film_displacement,
        Displacement,
    ),
)
# Repairs come after the track, which stays stored as it was: undoing a repair does not track the film again.
FILM_REPAIRED = _stage_table(
    *(FILM[name] for name in ("recording", "track", "tracks")),
    Stage("repaired", ("recording", "track", "tracks"), ("repair",), film.make_repaired, Track),
    replace(FILM["displacement"], inputs=("tracks", "repaired")),
)
TABLE = _stage_table(
    Stage(
        "displacement",
        (),
        ("table", "columns", "fps", "scale", "x_offset", "repair"),
        make_table_displacement,
        Displacement,
    )
)


POINTS = {
    **TABLE,
    "displacement": replace(TABLE["displacement"], settings=("table", "columns"), make=make_point_displacement),
    "sensors": replace(TABLE["sensors"], settings=("table", "columns", "mass", "normal_load"), make=make_point_sensors),
    "filtered": Stage("filtered", ("displacement",), (), make_point_filtered, Filtered),
    "motion": Stage("motion", ("displacement",), ("table", "columns"), make_point_motion, Motion),
}
del POINTS["cutoff"]


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
    of_table = POINTS if run.is_of_points else TABLE
    stages = of_table if run.table else FILM_REPAIRED if run.repair else FILM
    return RunPipeline(study, run, stages, progress, stored_only=stored_only)


def run_pipelines(study: Study, progress: Progress = no_progress, pool: WorkerPool | None = None) -> list[RunPipeline]:
    """Return the pipelines of all runs; those of films share one, and the target learnt from its film."""
    found = [run_pipeline(study, run, progress) for run in study.runs]
    for pipeline in found:
        pipeline.pool = pool
    films = sorted((pipeline for pipeline in found if pipeline.run.video), key=lambda one: one.run.name)
    for pipeline in films[1:]:
        pipeline.anchor = films[0]
    return found
