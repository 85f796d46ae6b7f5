"""The stages of one run: what computes each of them, and tables of them, for films and for tables of positions.

Every function takes the pipeline and the results of the stage's inputs. The rooms import the science when it is first
used, so that stored results are read without it. A compressed film is decoded once for all tracks.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack import measure, sampling, study, tracking
from frictrack.base.errors import FrictrackError, result_or_none
from frictrack.base.remote import local_path
from frictrack.effects import models
from frictrack.flow import sensor_stage, track_quality
from frictrack.flow.pipeline import Progress, RunPipeline, Stage, make_run, no_progress
from frictrack.flow.plausibility_checks import find_missing_incline
from frictrack.records import MEASURED, CutoffTradeOff, Displacement, Filtered, Friction, Motion, Run, RunEvents, Track
from frictrack.results import BACKWARD, RecordingInfo, Sensors
from frictrack.settings.filters import SETTINGS as FILTER_SETTINGS
from frictrack.study import RunTable, Study

if TYPE_CHECKING:
    from frictrack.base.workers import WorkerPool
    from frictrack.recording import Recording

REFERENCE = "reference"  # name of the track that frictrack adds, as it adds `BACKWARD`
REASON_COVERED = "the target passes over it"
# Shake that every reference found automatically can show, px rms. If less were subtracted in some films of a study, it
# would remain in the others, where the diagnosis could not distinguish it from a vibration of the course.
MIN_SHAKE_PX = 0.02  # px, rms
NOTE_NO_REFERENCE = (
    "no fixed reference was found in the picture, so camera shake was not subtracted from the displacement; draw one "
    "on the page, or set reference = [x, y, width, height]"
)


def make_recording(pipeline: RunPipeline) -> RecordingInfo:
    """Return what is stored of the recording: clock, identity, first frame, audit of the time base."""
    rec = pipeline.recording
    same = ("t", "fps", "n_frames", "bit_depth", "hash", "exposure", "clocked")
    return RecordingInfo(
        **{name: getattr(rec, name) for name in same},
        path=pipeline.settings("recording")["video"],
        picture=np.asarray(rec.frame(0)),
        notes=tuple(rec.notes),
        audit=rec.timebase.rows,
    )


def make_track(pipeline: RunPipeline, film: RecordingInfo) -> Track:
    """Track the target; what is learnt of it stays in the pipeline, for the tracks stage and for other films."""
    plane_before_tracking(pipeline)
    with pipeline.open_film() as opened:
        pipeline.progress(0, film.n_frames, "find the target")
        run = pipeline.run
        given = tracking.Areas(run.target, run.exclude, run.obstacles)
        areas, _, frame = tracking.detection.resolve_areas(opened, given, run.template or 0)
        work, known = tracking.Work(pipeline.progress, _pool(pipeline)), _target_of_anchor(pipeline)
        shared = tracking.track_same_target(opened, areas, known, frame, work) if known else None
        found, pipeline.lesson = shared or tracking.track_and_learn(opened, areas, frame, work=work)
        if shared:
            return found
        if run.target is None and (fault := tracking.detection.target_fault(opened, found)):
            sheet = tracking.contact_sheet(opened, found, contact_sheet_path(pipeline.study, run.name))
            raise FrictrackError(f"{fault}; {sheet} shows the place")
        return found


def make_repaired(pipeline: RunPipeline, film: RecordingInfo, track: Track, tracks: dict[str, Track]) -> Track:
    """Repair the frames that the study file names; the track itself stays stored."""
    repairs = pipeline.run.repair
    with pipeline.open_film() as opened:
        pipeline.progress(0, len(track), "repair frames")
        if any(one.how == "track" for one in repairs) and pipeline.lesson is None:
            pipeline.lesson = tracking.relearn_target(opened, track)
        repaired = measure.repairing.repair(track, opened, repairs, known=pipeline.lesson)
        sheet = contact_sheet_path(pipeline.study, pipeline.run.name)
        tracking.contact_sheet(opened, repaired, sheet, tuple(tracks.values()))
    return repaired


def _pool(pipeline: RunPipeline) -> WorkerPool | None:
    """Processes that take over segments of a long film; none for a compressed one, which has to be decoded in order."""
    return pipeline.pool if pipeline.recording.direct else None


def _target_of_anchor(pipeline: RunPipeline) -> tracking.TargetModel | None:
    """Return the target that was learnt from another film of the study, if it may be the same in this film.

    It is another one where outline, excluded parts or obstacles were drawn.
    """
    anchor = pipeline.anchor
    runs = () if anchor is None else (pipeline.run, anchor.run)
    if anchor is None or any(tracking.is_polygon(run.target) or run.exclude or run.obstacles for run in runs):
        return None
    track: Track = anchor.get("track")  # learns the target if this process tracks the film
    if anchor.lesson is None:
        with anchor.open_film() as opened:
            anchor.lesson = tracking.relearn_target(opened, track)
    return anchor.lesson


def make_further_tracks(pipeline: RunPipeline, film: RecordingInfo, track: Track) -> dict[str, Track]:
    """Track everything else in the film and draw the contact sheet."""
    found: dict[str, Track] = {}
    with pipeline.open_film() as opened:
        for name, target in pipeline.run.targets.items():
            areas = tracking.Areas(target, obstacles=pipeline.run.obstacles)
            found[name] = tracking.track(opened, areas, name=name, progress=pipeline.progress)
        found |= _reference_track(opened, track, pipeline)
        sheet = pipeline.study.output / f"{pipeline.run.name}_track.png"
        tracking.contact_sheet(opened, track, sheet, tuple(found.values()))
        return found | _backward_track(opened, track, pipeline)


def _reference_track(opened: Recording, target: Track, pipeline: RunPipeline) -> dict[str, Track]:
    """Track the fixed reference that the study file names, or the one that is found; empty if there is none."""
    given = pipeline.run.reference
    if given == "none":
        return {}
    if given != "auto":
        reference = tracking.track(opened, given, name=REFERENCE, progress=pipeline.progress)
        # Notes on the film stand in the target's track already.
        return {REFERENCE: _without_covered_frames(replace(reference, notes=()), target)}
    rectangle = tracking.find_reference(opened, target)
    if rectangle is None:
        return {}
    how: dict[str, Any] = {"pool": _pool(pipeline), "progress": pipeline.progress}
    found = result_or_none(tracking.track, opened, rectangle, **how)  # the run can do without
    if found is None or tracking.checks.moves_with(target, found):
        return {}
    return {REFERENCE: replace(found, name=REFERENCE, notes=())}


def _without_covered_frames(reference: Track, target: Track) -> Track:
    """Mark the frames as lost in which the target passes over the reference: there the reference would move with it."""
    assert reference.target is not None
    assert target.target is not None
    (x, y, w, h), (_, _, width, height) = reference.target, target.target
    near_x = np.abs(target.x_px - x - (w - 1) / 2) < (w + width) / 2
    near_y = np.abs(target.y_px - y - (h - 1) / 2) < (h + height) / 2
    covered = near_x & near_y
    if not np.any(covered):
        return reference
    mask = np.where(covered, np.nan, 0.0)
    columns = {c: q + mask for c in MEASURED if (q := getattr(reference, c)) is not None}
    reason = np.where(covered & reference.found, REASON_COVERED, reference.reason)
    note = (
        f"the target passes over the fixed reference in {np.count_nonzero(covered)} frames, where camera shake is not "
        "measured; choose a rectangle outside its path"
    )
    return replace(reference, **columns, reason=reason, notes=(*reference.notes, note))


def _backward_track(opened: Recording, forward: Track, pipeline: RunPipeline) -> dict[str, Track]:
    """Track the target from the last frame that shows it completely to the first one, with the learnt template."""
    assert forward.target is not None
    size = np.array(forward.target[2:])
    corner = np.rint(np.stack([forward.x_px, forward.y_px], axis=1) - (size - 1) / 2)
    whole = np.all((corner >= 0) & (corner + size <= opened.shape[::-1]), axis=1)
    if not np.any(whole):
        return {}
    last = int(np.flatnonzero(whole)[-1])
    rectangle = [*corner[last].tolist(), *size.tolist()]

    def follow() -> Track:
        known = pipeline.lesson or tracking.relearn_target(opened, forward)
        areas = tracking.Areas(rectangle, obstacles=forward.obstacles)
        how: dict[str, Any] = {"template": last, "progress": pipeline.progress, "pool": _pool(pipeline)}
        return tracking.track(opened, areas, known=known, **how)

    backward = result_or_none(follow)
    return {} if backward is None else {BACKWARD: replace(backward, name=BACKWARD, picture=None, notes=())}


def plane_before_tracking(pipeline: RunPipeline) -> measure.calibration.PlaneMap | None:
    """Return the map from pixels to the course, as far as it needs no track."""
    run = pipeline.run
    several = list(run.scale) if isinstance(run.scale, list) else [run.scale]
    of_target = [isinstance(one, dict) and "target" in one for one in several]
    how: dict[str, Any] = {"lens": run.lens, "film": pipeline.recording, "axis": run.axis}
    known = ("1 mm/px" if later else one for one, later in zip(several, of_target, strict=True))
    maps = [measure.calibration.plane_map(one, **how) for one in known]
    return maps[0] if len(maps) == 1 and not any(of_target) else None


def make_film_displacement(pipeline: RunPipeline, tracks: dict[str, Track], track: Track) -> Displacement:
    """Compute the displacement from the first to the last frame that shows the target.

    Camera shake is subtracted, and the times are corrected where frames are missing or doubled.
    """
    run, anchor, min_shake = pipeline.run, pipeline.anchor, min_shake_px(pipeline.run)
    plane = plane_before_tracking(pipeline) or measure.calibration.plane_map(
        run.scale, lens=run.lens, track=track, film=pipeline.recording, axis=run.axis
    )
    clocked = pipeline.get("recording").clocked
    clean, notes, numbers = track_quality.correct_track(track, tracks, clocked=clocked, min_shake=min_shake)
    clean = replace(clean, notes=(*track.notes, *notes))
    if anchor:  # after the checks: they compare tracks of one film, which follow one point
        clean = tracking.align_track(clean, anchor.get("track"), f"run {anchor.run.name}")
    unseen = (NOTE_NO_REFERENCE,) if run.reference == "auto" and REFERENCE not in tracks else ()
    clean = replace(clean, notes=tuple(dict.fromkeys((*clean.notes, *unseen))))
    where: dict[str, Any] = {"axis": run.axis, "origin_px": run.origin_px, "x_offset": run.x_offset}
    displacement = sampling.screened(_on_grid(measure.calibration.calibrate(clean, plane, **where)), numbers)
    displacement = displacement.rows(displacement.span)
    residual = track_quality.residual_shake(tracks.get(REFERENCE), min_shake)
    if residual is None or displacement.pixel_pitch is None:
        return displacement
    return replace(displacement, shake=(residual[0], residual[1] * displacement.pixel_pitch))


def _on_grid(displacement: Displacement) -> Displacement:
    """Return a displacement whose frames have uneven times with the positions at the nearest points of an even grid."""
    columns = (displacement.x, displacement.y, displacement.angle)
    moved = None if sampling.is_even(displacement.t) else sampling.moved_to_grid(displacement.t, columns)
    if moved is None:
        return displacement
    t, (x, y, angle) = moved
    note = "positions are moved along their course from the uneven times of the frames to the nearest even ones"
    return replace(displacement, t=t, x=x, y=y, angle=angle, notes=(*displacement.notes, note))


def min_shake_px(run: RunTable) -> float:
    """Return the camera shake that is subtracted at least, px rms; smaller shake is left in."""
    return MIN_SHAKE_PX if run.reference == "auto" else 0.0


def contact_sheet_path(study: Study, run: str) -> Path:
    """Return the path of the contact sheet of a run's film; a repaired track has a sheet of its own."""
    repaired = any(one.name == run and one.repair for one in study.runs)
    return study.output / f"{run}_track{'_repaired' if repaired else ''}.png"


def write_overlay(pipeline: RunPipeline) -> Path:
    """Write the film with the tracked positions drawn into it; return its path."""
    with pipeline.open_film() as opened:
        others = tracks_to_draw(pipeline.get("tracks"))
        return tracking.overlay_video(opened, pipeline.final_track, overlay_path(pipeline), others=others)


def overlay_path(pipeline: RunPipeline) -> Path:
    """Return the path of the overlay video; it exists only if it was asked for."""
    return pipeline.study.output / f"{pipeline.run.name}_overlay.avi"


def tracks_to_draw(tracks: dict[str, Any]) -> tuple[Track, ...]:
    """Return the tracks that are drawn besides the target's: all but the backward one."""
    return tuple(track for name, track in tracks.items() if name != BACKWARD)


TABLE_KEYS = ("table", "columns", "fps", "scale", "x_offset", "repair")
SCALE_KEYS = ("scale", "lens", "axis", "origin_px", "x_offset", "repair")
KEYS_OF_FORCE = ("mass", "incline", "radius", "rolling", "normal_load", "sigma_drive", "free")
MASS_FIT_MODEL = "coulomb,viscous"  # fitted together with an unknown mass, before the study's model is fitted


def make_table_displacement(pipeline: RunPipeline) -> Displacement:
    """Compute the displacement of a table of positions."""
    run, table = pipeline.run, study.read_run_table(pipeline.run)
    found = measure.tables.displacement_of_table(table, fps=run.fps, scale=run.scale, x_offset=run.x_offset)
    return measure.repairing.repaired_rows(found, run.repair)


def _points(pipeline: RunPipeline) -> study.TableData:
    """Return the points (v, F) of a run, in order of speed."""
    assert pipeline.run.table is not None
    return measure.tables.points_of_table(study.read_points(local_path(pipeline.run.table), pipeline.run.columns))


def _motion_of_points(pipeline: RunPipeline) -> tuple[Displacement, Motion]:
    """Read a table of points (v, F): rows at no known place, and their speeds."""
    return measure.tables.motion_of_points(_points(pipeline))


def make_point_sensors(pipeline: RunPipeline, displacement: Displacement) -> Sensors:
    """Return the friction force of every point, with its deviation and load where they are known."""
    points = _points(pipeline)
    measured = Sensors(displacement.t, friction_N=points.friction)
    load = make_run(pipeline.run, displacement, _motion_of_points(pipeline)[1], measured).load
    return replace(measured, **measure.tables.forces_of_points(points, load))


def make_point_filtered(pipeline: RunPipeline, displacement: Displacement) -> Filtered:
    """Return the rows of points as they are."""
    nan = displacement.y
    return Filtered(displacement.t, displacement.x, nan, nan, nan, reason="nothing is smoothed")


def make_filtered(pipeline: RunPipeline, displacement: Displacement, sensors: Sensors) -> Filtered:
    """Low-pass the displacement, with the acceleration of a sensor if it agrees with the camera."""
    acceleration = sensor_stage.fused_acceleration(sensors)
    return measure.motion.low_pass(displacement, method=pipeline.run.filter_choice, acceleration=acceleration)


def make_cutoff(pipeline: RunPipeline, *measured: Any) -> CutoffTradeOff:
    """Compute what another cut-off frequency would change."""
    return measure.motion.cutoff_tradeoff(*measured)


def make_friction(pipeline: RunPipeline, *measured: Any) -> Friction:
    """Compute the friction force; an unknown mass is estimated first. A missing incline is named as the cause."""
    run = make_run(pipeline.run, *measured)
    if run.mass is None and run.friction_N is None:
        weighed, says = _with_fitted_mass(run)
        found = measure.friction.friction(weighed)
        return replace(found, reason=f"{found.reason}; {says}")
    try:
        return measure.friction.friction(run)
    except FrictrackError as e:
        lacks = find_missing_incline(pipeline, run)
        if lacks is None:
            raise
        raise FrictrackError(lacks.words) from e


def make_events(pipeline: RunPipeline, *measured: Any) -> RunEvents:
    """Find release, stops and reversals."""
    return measure.friction.find_events(make_run(pipeline.run, *measured))


def _with_fitted_mass(run: Run) -> tuple[Run, str]:
    """Return a run of unknown mass with the mass that its drive determines, and a sentence for the user."""
    from frictrack.fit import fit  # noqa: PLC0415 - a second that runs of known mass need not wait for

    found = fit(models.parse(MASS_FIT_MODEL), [replace(run, role="fit")]).parameters["mass.m"]
    if found.value is None or found.std is None:
        raise FrictrackError(f'mass = "fit": {found.reason}')
    says = f"mass {found.value:.4g} ± {found.std:.2g} kg, fitted to the drive with Coulomb and viscous friction"
    return replace(run, mass=found.value, sigma_mass=found.std), says


def _stage_table(*head: Stage) -> dict[str, Stage]:
    """Return a table of stages: the given ones, then those that every run has after its displacement."""
    measured = ("displacement", "motion", "sensors")
    tail = (
        Stage("sensors", ("displacement",), ("drive", "sensor"), sensor_stage.read_sensors, Sensors),
        Stage("filtered", ("displacement", "sensors"), FILTER_SETTINGS, make_filtered, Filtered),
        Stage("motion", ("filtered",), (), lambda _, filtered: measure.motion.differentiate(filtered), Motion),
        Stage("cutoff", ("displacement", "filtered", "motion"), (), make_cutoff, CutoffTradeOff),
        Stage("friction", measured, KEYS_OF_FORCE, make_friction, Friction),
        Stage("events", measured, KEYS_OF_FORCE, make_events, RunEvents),
    )
    return {stage.name: stage for stage in (*head, *tail)}


FILM = _stage_table(
    Stage("recording", (), ("video", "fps"), make_recording, RecordingInfo),
    Stage("track", ("recording",), ("target", "template", "exclude", "obstacles"), make_track, Track),
    Stage("tracks", ("recording", "track"), ("reference", "targets", "obstacles"), make_further_tracks, dict),
    Stage("displacement", ("tracks", "track"), SCALE_KEYS, make_film_displacement, Displacement),
)
# Repairs come after the track, which stays stored as it was: undoing a repair does not track the film again.
FILM_REPAIRED = _stage_table(
    *(FILM[name] for name in ("recording", "track", "tracks")),
    Stage("repaired", ("recording", "track", "tracks"), ("repair",), make_repaired, Track),
    replace(FILM["displacement"], inputs=("tracks", "repaired")),
)
TABLE = _stage_table(Stage("displacement", (), TABLE_KEYS, make_table_displacement, Displacement))
POINTS = {
    **TABLE,
    "displacement": Stage("displacement", (), TABLE_KEYS[:2], lambda p: _motion_of_points(p)[0], Displacement),
    "sensors": replace(TABLE["sensors"], settings=("table", "columns", "mass", "normal_load"), make=make_point_sensors),
    "filtered": Stage("filtered", ("displacement",), (), make_point_filtered, Filtered),
    "motion": Stage("motion", ("displacement",), ("table", "columns"), lambda p, _: _motion_of_points(p)[1], Motion),
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
