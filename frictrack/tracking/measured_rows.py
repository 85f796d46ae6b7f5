"""Measure the frames of a rough track with the learnt model of the target."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frictrack.recording import Recording
from frictrack.records import Array
from frictrack.tracking.correlation import nearest_corner
from frictrack.tracking.measure import measure_frames
from frictrack.tracking.occlusion import remeasure_occluded
from frictrack.tracking.raw_track import LEAVES, NOT_CONVERGED, RawTrack
from frictrack.tracking.segments import SEGMENT_FRAMES, Work
from frictrack.tracking.target_model import TargetModel

CHUNK_FRAMES = 256  # measured at once
MAX_OFF_CENTRE_PX = 0.55  # from the corner of its cut-out, beyond which a target is measured on the next one
MIN_SCORE_SHARE = 0.7  # of the film's typical score, that a trusted frame reaches


def measure_all(
    film: Recording, raw_track: RawTrack, rows: NDArray[np.int64], target_model: TargetModel, work: Work
) -> RawTrack:
    """Measure frames with the learnt model; set the reason where a frame cannot be trusted.

    Parameters
    ----------
    film : Recording
        Film with random access.
    raw_track : RawTrack
        Rough track of all frames; its rows are replaced.
    rows : array of int (m,)
        Frames that are measured.
    target_model : TargetModel
        Learnt model.
    work : Work
        Where the frames are measured.

    Returns
    -------
    RawTrack
        The same track.

    """
    size = target_model.template.weight.shape
    max_corner = np.array(film.shape[::-1]) - np.array(size[::-1])
    raw_track.fit.sigma[:] *= target_model.sigma_inflation
    parts = [rows[at : at + SEGMENT_FRAMES] for at in range(0, len(rows), SEGMENT_FRAMES)]
    measured = work.run(_measure_rows, [(film, part, raw_track[part], target_model) for part in parts], "measure")
    for part, found in zip(parts, measured, strict=True):
        raw_track.put(part, found)
    remeasure_occluded(film, raw_track, target_model)
    found_rows = np.flatnonzero(raw_track.found)
    raw_track.reason[found_rows] = _loss_reasons(raw_track, found_rows, max_corner)
    return raw_track


def _measure_rows(film: Recording, rows: NDArray[np.int64], raw_track: RawTrack, target_model: TargetModel) -> RawTrack:
    """Measure the frames `rows` (m,), whose rough track is `raw_track` (m rows)."""
    for at in range(0, len(rows), CHUNK_FRAMES):
        chunk = np.arange(at, min(at + CHUNK_FRAMES, len(rows)))
        _measure_chunk(film, raw_track, rows, chunk, target_model)
        off_centre = chunk[np.any(np.abs(raw_track.fit.position[chunk]) > MAX_OFF_CENTRE_PX, axis=1)]
        if len(off_centre):  # the learnt picture has the target nearer to another pixel than the first look had
            _measure_chunk(film, raw_track, rows, off_centre, target_model)
    return raw_track


def _measure_chunk(
    film: Recording, raw_track: RawTrack, frames: NDArray[np.int64], rows: NDArray[np.int64], target_model: TargetModel
) -> None:
    """Measure some rows (m,) of a track of `frames` on cut-outs centred on their last known positions."""
    size = target_model.template.weight.shape
    corner = nearest_corner(raw_track.position[rows], film.shape, size)
    guess = raw_track.fit[rows].moved(raw_track.corner[rows] - corner)
    raw_track.fit.put(rows, measure_frames(film.cut(frames[rows], corner, size), corner, guess, target_model)[0])
    raw_track.corner[rows] = corner


def _loss_reasons(result: RawTrack, rows: NDArray[np.int64], max_corner: Array) -> list[str]:
    """State for each frame why its position cannot be trusted; "" where it can."""
    fit, at = result.fit[rows], result.position[rows]
    out = np.any((at < -0.5) | (at > max_corner + 0.5), axis=1)
    known = fit.score[np.isfinite(fit.score)]
    min_score = MIN_SCORE_SHARE * (float(np.median(known)) if len(known) else 1.0)
    reasons = []
    for outside, converged, score in zip(out, fit.converged, fit.score, strict=True):
        if outside:
            reasons.append(LEAVES)
        elif not score >= min_score:
            reasons.append(f"match score {score:.2f} below {min_score:.2f}")
        else:
            reasons.append("" if converged else NOT_CONVERGED)
    return reasons
