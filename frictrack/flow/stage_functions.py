"""Compute the stages of one run: every function takes the pipeline and the results of the stage's inputs."""

from __future__ import annotations

from dataclasses import replace

from frictrack import models
from frictrack.errors import FrictrackError
from frictrack.flow.film_stages import (
    make_displacement,
    make_further_tracks,
    make_recording,
    make_repaired,
    make_track,
)
from frictrack.flow.pipeline import RunPipeline, make_run
from frictrack.flow.sensor_stage import fused_acceleration, read_sensors
from frictrack.friction import find_events, friction
from frictrack.motion import cutoff_tradeoff, differentiate, low_pass
from frictrack.plausibility import missing_incline, path_angle
from frictrack.records import CutoffTradeOff, Displacement, Filtered, Friction, Motion, Run, RunEvents, Track
from frictrack.repairing import repaired_rows
from frictrack.results import Sensors
from frictrack.study import read_run_table
from frictrack.tables import displacement_of_table

__all__ = [
    "make_cutoff",
    "make_events",
    "make_filtered",
    "make_friction",
    "make_further_tracks",
    "make_motion",
    "make_recording",
    "make_repaired",
    "make_sensors",
    "make_table_displacement",
    "make_track",
    "make_video_displacement",
]

MASS_FIT_MODEL = "coulomb,viscous"  # fitted together with an unknown mass, before the study's model is fitted


def make_video_displacement(pipeline: RunPipeline, tracks: dict[str, Track], track: Track) -> Displacement:
    """Compute the displacement of a film."""
    return make_displacement(pipeline, track, tracks)


def make_table_displacement(pipeline: RunPipeline) -> Displacement:
    """Compute the displacement of a table of positions."""
    run = pipeline.run
    found = displacement_of_table(read_run_table(run), fps=run.fps, scale=run.scale, x_offset=run.x_offset)
    return repaired_rows(found, run.repair)


def make_sensors(pipeline: RunPipeline, displacement: Displacement) -> Sensors:
    """Read the drive and the sensors at the times of the frames."""
    return read_sensors(pipeline.run, displacement)


def make_filtered(pipeline: RunPipeline, displacement: Displacement, sensors: Sensors) -> Filtered:
    """Low-pass the displacement, with the acceleration of a sensor if it agrees with the camera."""
    return low_pass(displacement, method=pipeline.run.filter_choice, acceleration=fused_acceleration(sensors))


def make_motion(pipeline: RunPipeline, filtered: Filtered) -> Motion:
    """Differentiate the filtered displacement."""
    return differentiate(filtered)


def make_cutoff(
    pipeline: RunPipeline, displacement: Displacement, filtered: Filtered, motion: Motion
) -> CutoffTradeOff:
    """Compute what another cut-off frequency would change."""
    return cutoff_tradeoff(displacement, filtered, motion)


def make_friction(pipeline: RunPipeline, displacement: Displacement, motion: Motion, sensors: Sensors) -> Friction:
    """Compute the friction force; an unknown mass is estimated first."""
    run = make_run(pipeline.run, displacement, motion, sensors)
    if run.mass is not None or run.friction_N is not None:
        return _friction_or_missing_incline(pipeline, run)
    weighed, says = _with_fitted_mass(run)
    found = friction(weighed)
    return replace(found, reason=f"{found.reason}; {says}")


def make_events(pipeline: RunPipeline, displacement: Displacement, motion: Motion, sensors: Sensors) -> RunEvents:
    """Find release, stops and reversals."""
    return find_events(make_run(pipeline.run, displacement, motion, sensors))


def _friction_or_missing_incline(pipeline: RunPipeline, run: Run) -> Friction:
    """Compute the friction force of a run; if it has no free section because the incline is missing, say so."""
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
