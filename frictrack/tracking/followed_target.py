"""Measure the frames of a target that was followed, and state the errors of its positions.

Measure frames in which part of the target is hidden again, starting from the positions in neighbouring frames.

A match of the whole template is biased toward an object that hides the target, and from the biased position all pixels
misfit. From a position predicted by frames that show the target well, the object itself stands out and is excluded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from frictrack.base.errors import FrictrackError
from frictrack.recording import Recording
from frictrack.records import Array, Mask, Track
from frictrack.tracking.areas import Areas
from frictrack.tracking.batch_tracker import MAX_MISFIT_RATIO, SEGMENT_FRAMES, Work
from frictrack.tracking.checks import at_rest, interlacing_note, slips
from frictrack.tracking.correlation import Rectangle, nearest_corner
from frictrack.tracking.measure import codec_shift, measure_frames, refine_predicted, unexplained_share, with_scatter
from frictrack.tracking.subpixel_fit import LEAVES, NOT_CONVERGED, UNREAD, RawTrack
from frictrack.tracking.template import MAX_SHIFT_PX, TargetModel
from frictrack.tracking.template_learning import peak_locking_correction

MAX_PREDICTION_GAP = 3  # frames to the nearest good one
MAX_NEIGHBOURS, MAX_NEIGHBOUR_DISTANCE = 16, 64  # good frames that predict a position, and their distance in frames
MAX_ROUNDS = 64  # of predicting from the frames of the round before
MAX_UNEXPLAINED_SHARE = 0.03  # of the picture's variance beyond the noise; more shows another object
MAX_PREDICTION_SIGMAS = 4.0  # standard deviations between position and prediction
OCCLUDED = "too much of the target is hidden"
CHUNK_FRAMES = 256  # measured at once
MAX_OFF_CENTRE_PX = 0.55  # from the corner of its cut-out, beyond which a target is measured on the next one
MIN_SCORE_SHARE = 0.7  # of the film's typical score, that a trusted frame reaches
# Slow position errors, rms, as a share of a frame's standard deviation and in px: the noise of the template, and blur
# that changes with the speed. Measured on films of known truth, with sharp and blurred targets and 0.001 to 0.005 px
# of noise.
SYSTEMATIC_SHARE, MIN_SYSTEMATIC_PX = 0.12, 2e-4
MIN_REPORTED_PEAK_LOCKING_PX = 0.01  # amplitude
UNKNOWN_ANGLE_SIGMA = np.pi / np.sqrt(3)  # rad, of any angle in a turn
ROTATION_UNSEEN = (
    "the target is round and shows no marks that can be followed: whether and how far it turns is not seen; "
    "a rolling body needs a mark for that"
)
MIN_SIGMA = 1e-6  # px and rad; equal pictures without noise would give 0


def remeasure_occluded(film: Recording, raw_track: RawTrack, target_model: TargetModel) -> None:
    """Measure frames with a large misfit again, and mark those that cannot be trusted.

    Parameters
    ----------
    film : Recording
        Film with random access.
    raw_track : RawTrack
        Track of the target; it is updated in place.
    target_model : TargetModel
        Learnt model of the target.

    """
    limit = MAX_MISFIT_RATIO * max(target_model.typical_misfit, target_model.template.min_misfit)
    suspect = raw_track.found & ~((raw_track.fit.misfit < limit) & raw_track.fit.converged)
    if not suspect.any() or np.isnan(limit):
        return
    share = unexplained_share(raw_track.fit.score, raw_track.fit.misfit, target_model.typical_misfit)
    good, visited = raw_track.found & ~suspect, ~suspect
    for _ in range(MAX_ROUNDS):
        rows = np.flatnonzero(~visited & binary_dilation(good, iterations=MAX_PREDICTION_GAP))
        if len(rows) == 0:
            break
        visited[rows] = True
        good[rows] = _remeasure(film, raw_track, rows, np.flatnonzero(good), share, target_model)
    raw_track.reason[suspect & ~good & ~(share <= MAX_UNEXPLAINED_SHARE)] = OCCLUDED


def _remeasure(
    film: Recording,
    raw_track: RawTrack,
    rows: NDArray[np.int64],
    good: NDArray[np.int64],
    share: Array,
    target_model: TargetModel,
) -> Mask:
    """Measure frames (m,) from predictions by the good ones; return which of them can be trusted.

    Where light changes along the path, so does the look: what lies where it is predicted is the target, if its
    unexplained `share` (n,) hardly exceeds that of the nearest good frame.
    """
    predicted, nearest = _predict_from_neighbours(raw_track.position, rows, good)
    off = np.abs(raw_track.position[rows] - predicted) / raw_track.fit.sigma[rows, :2]
    changed = np.all(off < MAX_PREDICTION_SIGMAS, axis=1) & (share[rows] <= share[nearest] + MAX_UNEXPLAINED_SHARE)
    typical = max(target_model.typical_misfit, target_model.template.min_misfit)
    corner, fit = refine_predicted(film, rows, predicted, raw_track.fit[nearest], target_model, typical)
    accepted = (
        fit.converged & (fit.misfit < MAX_MISFIT_RATIO * typical) & np.all(np.abs(fit.position) < MAX_SHIFT_PX, axis=1)
    )
    raw_track.corner[rows[accepted]] = corner[accepted]
    raw_track.fit.put(rows[accepted], fit[accepted])
    return np.asarray(accepted | changed)


def _predict_from_neighbours(
    at: Array, rows: NDArray[np.int64], good: NDArray[np.int64]
) -> tuple[Array, NDArray[np.int64]]:
    """Predict positions (m, 2) px by parabolas through the nearest good frames; return the nearest of these, too."""
    places, nearest = np.empty((len(rows), 2)), np.empty(len(rows), np.int64)
    for k, row in enumerate(rows):
        centre = int(np.searchsorted(good, row))
        near = good[max(centre - MAX_NEIGHBOURS, 0) : centre + MAX_NEIGHBOURS]
        near = near[np.argsort(np.abs(near - row), kind="stable")][:MAX_NEIGHBOURS]
        near = near[np.abs(near - row) <= MAX_NEIGHBOUR_DISTANCE]
        nearest[k] = near[0]
        powers = np.vander((near - row) / MAX_NEIGHBOUR_DISTANCE, min(3, 1 + len(near) // 3), increasing=True)
        places[k] = np.linalg.lstsq(powers, at[near], rcond=None)[0][0]
    return places, nearest


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
    poor = [f"match score {score:.2f} below {min_score:.2f}" for score in fit.score]
    cases = [(out, LEAVES), (~(fit.score >= min_score), poor), (~fit.converged, NOT_CONVERGED)]
    return list(np.select([case for case, _ in cases], [np.asarray(words) for _, words in cases], ""))


@dataclass(frozen=True)
class Followed:
    """A target that was followed: its areas and rectangle in frame `template`, track and model.

    `remeasure` tells whether frames are measured again with the model.
    """

    drawn: Areas
    rectangle: Rectangle
    template: int
    raw_track: RawTrack
    target_model: TargetModel
    remeasure: bool = True


def measure_track(recording: Recording, film: Recording, followed: Followed, name: str, work: Work) -> Track:
    """Measure the frames of a target that was followed, and state the errors of its positions."""
    target_model, measured = followed.target_model, followed.raw_track
    if not target_model.rotates:
        rows = np.flatnonzero(measured.found & followed.remeasure)
        measured = measure_all(film, measured, rows, target_model, work)
    if np.count_nonzero(measured.found) < 2:
        raise FrictrackError(
            f"{recording.path.name}: the target {list(followed.rectangle)} is found in fewer than two frames; "
            "choose a rectangle that fits the moving body, in a frame that shows it well"
        )
    result = _to_track(recording, measured, followed.rectangle, name)
    direction = _path_direction(result)
    result = _with_systematic_error(result, target_model, direction)
    counts = ~np.isin(np.arange(len(result)), [s.frame for s in slips(result) if s.doubled])
    result = with_scatter(result, direction, codec_shift(film, measured, target_model, counts), counts)
    if not target_model.rotation_seen:
        lost = np.where(result.found, 0.0, np.nan)
        result = replace(
            result, angle=lost, sigma_angle=lost + UNKNOWN_ANGLE_SIGMA, notes=(*result.notes, ROTATION_UNSEEN)
        )
    result = _with_reference_sigma(result, followed.template)
    return replace(
        result,
        template=followed.template,
        picture=target_model.template.image,
        notes=(*result.notes, *interlacing_note(film, result), *at_rest(result)),
        outline=followed.drawn.outline,
        exclude=tuple(followed.drawn.exclude),
        obstacles=tuple(followed.drawn.obstacles),
    )


def _to_track(recording: Recording, measured: RawTrack, rectangle: Rectangle, name: str) -> Track:
    """Convert raw positions to a `Track`: NaN and a reason where a frame cannot be trusted."""
    _, _, w, h = rectangle
    fit, at, found = measured.fit, measured.position, np.flatnonzero(measured.found)
    nan_where_lost = np.where(measured.found, 0.0, np.nan)
    sigma = np.maximum(fit.sigma, MIN_SIGMA)
    locking_error, size = peak_locking_correction(found, at[found])
    at[found] -= locking_error
    return Track(
        t=recording.t,
        x_px=at[:, 0] + (w - 1) / 2 + nan_where_lost,
        y_px=at[:, 1] + (h - 1) / 2 + nan_where_lost,
        angle=fit.angle + nan_where_lost,
        sigma_px=sigma[:, 0] + nan_where_lost,
        sigma_y_px=sigma[:, 1] + nan_where_lost,
        sigma_angle=sigma[:, 2] + nan_where_lost,
        score=fit.score,
        reason=measured.reason.astype(str),
        name=name,
        target=(float(rectangle[0]), float(rectangle[1]), float(w), float(h)),
        notes=(*recording.notes, *_unread_note(measured), *_peak_locking_note(size)),
    )


def _with_reference_sigma(track: Track, template: int) -> Track:
    """Raise the standard deviations of frame `template` to the median of all frames.

    That frame made the first template, so that its own misfit is too small.
    """
    columns = {name: getattr(track, name).copy() for name in ("sigma_px", "sigma_y_px", "sigma_angle")}
    for sigma in columns.values():
        sigma[template] = np.maximum(sigma[template], np.nanmedian(sigma))
    return replace(track, **columns)


def _path_direction(track: Track) -> Array:
    """Unit vector (2,) along which a target that was found moves most."""
    at = np.stack([track.x_px, track.y_px])[:, track.found]
    return np.asarray(np.linalg.svd(at - at.mean(axis=1, keepdims=True), full_matrices=False)[0][:, 0])


def _with_systematic_error(track: Track, target_model: TargetModel, direction: Array) -> Track:
    """Add the systematic error along the path, with a note where the target's appearance changes."""
    systematic = float(np.sqrt(max(float(direction @ target_model.systematic_covariance @ direction), 0.0)))
    min_systematic = float(np.hypot(SYSTEMATIC_SHARE * np.nanmedian(track.sigma_px), MIN_SYSTEMATIC_PX))
    if systematic < min_systematic:
        return replace(track, systematic=min_systematic)
    note = (
        f"the appearance of the target changes along its path (light, highlights, background): slow position errors of "
        f"{systematic:.2g} px rms; an outline of the part that does not change, target = [[x, y], ...], or even light "
        "reduces them"
    )
    return replace(track, systematic=float(np.hypot(min_systematic, systematic)), notes=(*track.notes, note))


def _unread_note(measured: RawTrack) -> tuple[str, ...]:
    """Note how many frames of the film could be read, where some could not."""
    count = int(np.count_nonzero(measured.reason == UNREAD))
    total = len(measured.reason)
    return (f"{total - count} of {total} frames could be read; the rest is missing or damaged",) if count else ()


def _peak_locking_note(size: Array) -> tuple[str, ...]:
    """Note the correction of peak locking, from its amplitudes (2,) along x and y, px."""
    if not np.any(size > MIN_REPORTED_PEAK_LOCKING_PX):
        return ()
    return (
        f"peak locking of {np.max(size):.3f} px was corrected: the target is sharper "
        "than the sensor resolves; a slight defocus would avoid it",
    )
