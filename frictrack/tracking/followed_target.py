"""Measure the frames of a target that was followed, and state the errors of its positions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from frictrack.errors import FrictrackError
from frictrack.recording import Recording
from frictrack.records import Array, Track
from frictrack.tracking.areas import Areas
from frictrack.tracking.checks import at_rest, interlacing_note, key_frame_notes
from frictrack.tracking.correlation import Rectangle
from frictrack.tracking.measured_rows import measure_all
from frictrack.tracking.raw_track import UNREAD, RawTrack
from frictrack.tracking.segments import Work
from frictrack.tracking.super_resolution import peak_locking_correction
from frictrack.tracking.target_model import TargetModel

# Slow position errors, rms, as a share of a frame's standard deviation and in px: the noise of the template, and blur
# that changes with the speed. Measured on films of known truth, with sharp and blurred targets and 0.001 to 0.005 px
# of noise.
SYSTEMATIC_SHARE, MIN_SYSTEMATIC_PX = 0.12, 2e-4
MIN_REPORTED_PEAK_LOCKING_PX = 0.01  # amplitude
MIN_SIGMA = 1e-6  # px and rad; equal pictures without noise would give 0


@dataclass(frozen=True)
class Followed:
    """A target that was followed: rectangle in frame `template`, track, model, and frames to be measured again.

    `rereadable` tells whether any frame can still be read.
    """

    rectangle: Rectangle
    template: int
    raw_track: RawTrack
    target_model: TargetModel
    rows: NDArray[np.int64]
    rereadable: bool = True


def measure_track(
    recording: Recording, film: Recording, drawn: Areas, followed: Followed, name: str, work: Work
) -> Track:
    """Measure the frames of a target that was followed, and state the errors of its positions."""
    target_model, template, rectangle = followed.target_model, followed.template, followed.rectangle
    raw_track = followed.raw_track
    measured = raw_track if target_model.rotates else measure_all(film, raw_track, followed.rows, target_model, work)
    change = _frame_changes(film) if recording.interframe else None
    result = _to_track(recording, measured, rectangle, name)
    result = _with_systematic_error(result, target_model)
    if np.count_nonzero(result.found) < 2:
        raise FrictrackError(
            f"{recording.path.name}: the target {list(rectangle)} is found in fewer than two frames; "
            "choose a rectangle that fits the moving body, in a frame that shows it well"
        )
    result = _with_reference_sigma(result, template)
    codec_notes = () if change is None else key_frame_notes(change, result.x_px, result.y_px)
    line_notes = interlacing_note(film, result) if followed.rereadable else ()
    notes = (*result.notes, *codec_notes, *line_notes, *at_rest(result))
    return replace(
        result,
        template=template,
        picture=target_model.template.image,
        notes=notes,
        outline=drawn.outline,
        exclude=tuple(drawn.exclude),
        obstacles=tuple(drawn.obstacles),
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


def _with_systematic_error(track: Track, target_model: TargetModel) -> Track:
    """Add the systematic error along the path, with a note where the target's appearance changes."""
    found = track.found
    sigma, at = track.sigma_px[found], np.stack([track.x_px, track.y_px])[:, found]
    if not found.any():
        return track
    direction = np.linalg.svd(at - at.mean(axis=1, keepdims=True), full_matrices=False)[0][:, 0]
    systematic = float(np.sqrt(max(direction @ target_model.systematic_covariance @ direction, 0.0)))
    min_systematic = float(np.hypot(SYSTEMATIC_SHARE * np.median(sigma), MIN_SYSTEMATIC_PX))
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


def _frame_changes(film: Recording) -> Array:
    """Rms change (n,) from each frame to the next beyond a uniform change of light, on every fourth pixel."""
    change, before = np.full(film.n_frames, np.nan), None
    for i, frame in enumerate(film.frames()):
        sparse = frame[::4, ::4].astype(np.float32)
        if before is not None:
            change[i] = np.std(sparse - before)
        before = sparse
    return change
