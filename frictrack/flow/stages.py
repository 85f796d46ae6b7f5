"""Define the stages of one run: two tables, one for films and one for tables of measured positions."""

from __future__ import annotations

from dataclasses import replace

from frictrack import models
from frictrack.errors import FrictrackError
from frictrack.events import happenings
from frictrack.flow.film_stages import make_displacement, make_further_tracks, make_recording, make_track
from frictrack.flow.pipeline import Progress, RunPipeline, Stage, make_run, no_progress
from frictrack.flow.sensor_stage import fused_acceleration, read_sensors
from frictrack.flow.table_stage import make_displacement_from_table, read_run_table
from frictrack.friction import friction
from frictrack.motion import differentiate, low_pass, trade
from frictrack.plausibility import missing_incline, path_angle
from frictrack.records import CutoffTradeOff, Displacement, Filtered, Friction, Motion, Run, RunEvents, Track
from frictrack.results import RecordingInfo, Sensors
from frictrack.study import RunTable, Study

MASS_FIT_MODEL = "coulomb,viscous"  # fitted together with an unknown mass, before the study's model is fitted


def _make_displacement(pipeline: RunPipeline) -> Displacement:
    """Compute the displacement of a table of positions."""
    return make_displacement_from_table(read_run_table(pipeline.run), pipeline.run)


def _make_filtered(pipeline: RunPipeline, displacement: Displacement, sensors: Sensors) -> Filtered:
    """Low-pass the displacement, with the acceleration of a sensor if it agrees with the camera."""
    return low_pass(displacement, pipeline.run.cutoff, acceleration=fused_acceleration(sensors))


def _make_friction(pipeline: RunPipeline, displacement: Displacement, motion: Motion, sensors: Sensors) -> Friction:
    """Compute the friction force; an unknown mass is estimated first."""
    run = make_run(pipeline.run, displacement, motion, sensors)
    if run.mass is not None or run.friction_N is not None:
        return _friction_or_missing_incline(pipeline, run)
    weighed, says = _with_fitted_mass(run)
    found = friction(weighed)
    return replace(found, reason=f"{found.reason}; {says}")


def _friction_or_missing_incline(pipeline: RunPipeline, run: Run) -> Friction:
    """Compute the friction force of a run; if it has no free section because the incline is missing, say so."""
    try:
        return friction(run)
    except FrictrackError as e:
        lacks = missing_incline(run, path_angle(pipeline.get("track")) if "track" in pipeline.stages else None)
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
        Stage(
            "sensors",
            ("displacement",),
            ("drive", "sensor"),
            lambda pipeline, d: read_sensors(pipeline.run, d),
            Sensors,
        ),
        Stage("filtered", ("displacement", "sensors"), ("cutoff",), _make_filtered, Filtered),
        Stage("motion", ("filtered",), (), lambda pipeline, filtered: differentiate(filtered), Motion),
        Stage(
            "cutoff",
            ("displacement", "filtered", "motion"),
            (),
            lambda pipeline, d, f, m: trade(d, f, m),
            CutoffTradeOff,
        ),
        Stage(
            "friction",
            ("displacement", "motion", "sensors"),
            ("mass", "incline", "normal_load", "free"),
            _make_friction,
            Friction,
        ),
        Stage(
            "events",
            ("displacement", "motion", "sensors"),
            ("mass", "incline", "normal_load", "free"),
            lambda pipeline, *inputs: happenings(make_run(pipeline.run, *inputs)),
            RunEvents,
        ),
    )
    return {stage.name: stage for stage in (*head, *tail)}


FILM = _stage_table(
    Stage("recording", (), ("video", "fps"), make_recording, RecordingInfo),
    Stage("track", ("recording",), ("target", "template", "exclude", "obstacles"), make_track, Track),
    Stage("tracks", ("recording", "track"), ("reference", "targets", "obstacles"), make_further_tracks, dict),
    Stage(
        "displacement",
        ("tracks", "track"),
        ("scale", "lens", "axis", "origin_px", "x_offset"),
        lambda pipeline, tracks, track: make_displacement(pipeline, track, tracks),
        Displacement,
    ),
)
TABLE = _stage_table(
    Stage("displacement", (), ("table", "columns", "fps", "scale", "x_offset"), _make_displacement, Displacement),
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
    return RunPipeline(study, run, FILM if run.video else TABLE, progress, stored_only=stored_only)
