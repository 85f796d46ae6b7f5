"""Compute the stages of a film: recording, track, further tracks, displacement.

A compressed film is decoded once for all tracks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.records import MEASURED, Displacement, Track
from frictrack.results import BACKWARD, RecordingInfo

if TYPE_CHECKING:
    from frictrack.base.workers import WorkerPool
    from frictrack.flow.pipeline import RunPipeline
    from frictrack.measure.calibration import PlaneMap
    from frictrack.recording import Recording
    from frictrack.study import RunTable, Study
    from frictrack.tracking import TargetModel

REFERENCE = "reference"  # name of the track that frictrack adds, as it adds `BACKWARD`
REASON_COVERED = "the target passes over it"
# Shake that every reference found automatically can show, px rms. If less were subtracted in some films of a study, it
# would remain in the others, where the diagnosis could not distinguish it from a vibration of the course.
MIN_SHAKE_PX = 0.02  # px, rms
NOTE_NO_REFERENCE = (
    "no fixed reference was found in the picture, so camera shake was not subtracted from the displacement; set "
    "reference = [x, y, width, height] to name one"
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
    from frictrack import tracking  # noqa: PLC0415 - loads OpenCV; tables do without
    from frictrack.tracking.detection import resolve_areas, rests_while_others_move  # noqa: PLC0415

    plane_before_tracking(pipeline)
    with pipeline.open_film() as opened:
        pipeline.progress(0, film.n_frames, "find the target")
        run = pipeline.run
        given = tracking.Areas(run.target, run.exclude, run.obstacles)
        areas, _, frame = resolve_areas(opened, given, run.template or 0)
        how: dict[str, Any] = {"template": frame, "progress": pipeline.progress, "pool": _pool(pipeline)}
        known = _target_of_anchor(pipeline)
        shared = known and tracking.track_same_target(opened, areas, known, **how)
        if shared:
            found, pipeline.lesson = shared
            return found
        pipeline.lesson = tracking.learn_target(opened, areas, **how)
        found = tracking.track_in_parallel(opened, areas, known=pipeline.lesson, **how)
        if run.target is None and (fault := rests_while_others_move(opened, found)):
            sheet = tracking.contact_sheet(opened, found, contact_sheet_path(pipeline.study, run.name))
            raise FrictrackError(f"{fault}; {sheet} shows the place")
        return found


def make_repaired(pipeline: RunPipeline, film: RecordingInfo, track: Track, tracks: dict[str, Track]) -> Track:
    """Repair the frames that the study file names; the track itself stays stored."""
    from frictrack.measure.repairing import repair  # noqa: PLC0415 - loads OpenCV
    from frictrack.tracking import contact_sheet, relearn_target  # noqa: PLC0415

    repairs = pipeline.run.repair
    with pipeline.open_film() as opened:
        pipeline.progress(0, len(track), "repair frames")
        if any(one.how == "track" for one in repairs) and pipeline.lesson is None:
            pipeline.lesson = relearn_target(opened, track)
        repaired = repair(track, opened, repairs, known=pipeline.lesson)
        contact_sheet(opened, repaired, contact_sheet_path(pipeline.study, pipeline.run.name), tuple(tracks.values()))
    return repaired


def _pool(pipeline: RunPipeline) -> WorkerPool | None:
    """Processes that take over segments of a long film; none for a compressed one, which has to be decoded in order."""
    return pipeline.pool if pipeline.recording.direct else None


def _target_of_anchor(pipeline: RunPipeline) -> TargetModel | None:
    """Return the target that was learnt from another film of the study, if it may be the same in this film.

    It is another one where outline, excluded parts or obstacles were drawn.
    """
    from frictrack.tracking import is_polygon, relearn_target  # noqa: PLC0415

    anchor = pipeline.anchor
    if anchor is None or any(is_polygon(r.target) or r.exclude or r.obstacles for r in (pipeline.run, anchor.run)):
        return None
    track: Track = anchor.get("track")  # learns the target if this process tracks the film
    if anchor.lesson is None:
        with anchor.open_film() as opened:
            anchor.lesson = relearn_target(opened, track)
    return anchor.lesson


def make_further_tracks(pipeline: RunPipeline, film: RecordingInfo, track: Track) -> dict[str, Track]:
    """Track everything else in the film and draw the contact sheet."""
    from frictrack import tracking  # noqa: PLC0415

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
    from frictrack.tracking import find_reference, track, track_in_parallel  # noqa: PLC0415
    from frictrack.tracking.checks import moves_with  # noqa: PLC0415

    given = pipeline.run.reference
    if given == "none":
        return {}
    if given != "auto":
        reference = track(opened, given, name=REFERENCE, progress=pipeline.progress)
        # Notes on the film stand in the target's track already.
        return {REFERENCE: _without_covered_frames(replace(reference, notes=()), target)}
    rectangle = find_reference(opened, target)
    if rectangle is None:
        return {}
    found = _track_or_none(
        lambda: track_in_parallel(opened, rectangle, pool=_pool(pipeline), progress=pipeline.progress)
    )
    if found is None or moves_with(target, found):
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
    from frictrack.tracking import Areas, relearn_target, track_in_parallel  # noqa: PLC0415

    assert forward.target is not None
    size = np.array(forward.target[2:])
    corner = np.rint(np.stack([forward.x_px, forward.y_px], axis=1) - (size - 1) / 2)
    whole = np.all((corner >= 0) & (corner + size <= opened.shape[::-1]), axis=1)
    if not np.any(whole):
        return {}
    last = int(np.flatnonzero(whole)[-1])
    rectangle = [*corner[last].tolist(), *size.tolist()]

    def follow() -> Track:
        known: TargetModel = pipeline.lesson or relearn_target(opened, forward)
        areas = Areas(rectangle, obstacles=forward.obstacles)
        how: dict[str, Any] = {"template": last, "progress": pipeline.progress, "pool": _pool(pipeline)}
        return track_in_parallel(opened, areas, known=known, **how)

    backward = _track_or_none(follow)
    return {} if backward is None else {BACKWARD: replace(backward, name=BACKWARD, picture=None, notes=())}


def _track_or_none(make: Callable[[], Track]) -> Track | None:
    """Return a track, or None if it cannot be made: an optional track must not stop the run."""
    try:
        return make()
    except FrictrackError:
        return None


def plane_before_tracking(pipeline: RunPipeline) -> PlaneMap | None:
    """Return the map from pixels to the course, as far as it needs no track."""
    from frictrack.measure.calibration import plane_map  # noqa: PLC0415

    run = pipeline.run
    several = list(run.scale) if isinstance(run.scale, list) else [run.scale]
    of_target = [isinstance(one, dict) and "target" in one for one in several]
    maps = [
        plane_map("1 mm/px" if later else one, lens=run.lens, film=pipeline.recording, axis=run.axis)
        for one, later in zip(several, of_target, strict=True)
    ]
    return maps[0] if len(maps) == 1 and not any(of_target) else None


def make_film_displacement(pipeline: RunPipeline, tracks: dict[str, Track], track: Track) -> Displacement:
    """Compute the displacement from the first to the last frame that shows the target.

    Camera shake is subtracted, and the times are corrected where frames are missing or doubled.
    """
    from frictrack.flow.track_quality import correct_track, residual_shake  # noqa: PLC0415
    from frictrack.measure.calibration import calibrate, plane_map  # noqa: PLC0415
    from frictrack.sampling import screened  # noqa: PLC0415
    from frictrack.tracking import align_track  # noqa: PLC0415

    run, anchor = pipeline.run, pipeline.anchor
    plane = plane_before_tracking(pipeline) or plane_map(
        run.scale, lens=run.lens, track=track, film=pipeline.recording, axis=run.axis
    )
    min_shake = min_shake_px(run)
    clean, notes, numbers = correct_track(track, tracks, clocked=pipeline.get("recording").clocked, min_shake=min_shake)
    clean = replace(clean, notes=(*track.notes, *notes))
    if anchor:  # after the checks: they compare tracks of one film, which follow one point
        clean = align_track(clean, anchor.get("track"), f"run {anchor.run.name}")
    unseen = (NOTE_NO_REFERENCE,) if run.reference == "auto" and REFERENCE not in tracks else ()
    displacement = calibrate(
        replace(clean, notes=tuple(dict.fromkeys((*clean.notes, *unseen)))),
        plane,
        axis=run.axis,
        origin_px=run.origin_px,
        x_offset=run.x_offset,
    )
    displacement = screened(_on_grid(displacement), numbers)
    displacement = displacement.rows(displacement.span)
    residual = residual_shake(tracks.get(REFERENCE), min_shake)
    if residual is None or displacement.pixel_pitch is None:
        return displacement
    return replace(displacement, shake=(residual[0], residual[1] * displacement.pixel_pitch))


def _on_grid(displacement: Displacement) -> Displacement:
    """Return a displacement whose frames have uneven times with the positions at the nearest points of an even grid."""
    from frictrack.sampling import is_even, moved_to_grid  # noqa: PLC0415

    columns = (displacement.x, displacement.y, displacement.angle)
    moved = None if is_even(displacement.t) else moved_to_grid(displacement.t, columns)
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
    from frictrack.tracking import overlay_video  # noqa: PLC0415

    with pipeline.open_film() as opened:
        track, tracks = pipeline.final_track, pipeline.get("tracks")
        return overlay_video(opened, track, overlay_path(pipeline), others=tracks_to_draw(tracks))


def overlay_path(pipeline: RunPipeline) -> Path:
    """Return the path of the overlay video; it exists only if it was asked for."""
    return pipeline.study.output / f"{pipeline.run.name}_overlay.avi"


def tracks_to_draw(tracks: dict[str, Any]) -> tuple[Track, ...]:
    """Return the tracks that are drawn besides the target's: all but the backward one."""
    return tuple(track for name, track in tracks.items() if name != BACKWARD)
