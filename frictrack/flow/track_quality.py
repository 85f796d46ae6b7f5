"""Correct the track of a film for camera shake and lost frames, and describe how well the film was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack import measure, tracking
from frictrack.records import MEASURED, Array, Mask, Track, stretches
from frictrack.results import RecordingInfo
from frictrack.sampling import Slip, correct_ticks

Rows = NDArray[np.int64]
MIN_STRETCHED_SHARE = 0.3  # of the frames that repeat the frame before; from here on the film was stretched
NOTE_STRETCHED = (
    "the film was stretched by repeating frames; fps is taken as the rate of the original frames: if it is the rate "
    "of the stretched film, divide fps by the number of repetitions (friction scales with its square)"
)
MIN_LOST_SHARE = 0.01  # of the frames of a path; fewer lost frames are not reported
MIN_DIRECTION_SIGMAS = 0.5  # between forward and backward tracking, in standard deviations; less is not reported
ANGLE_WINDOW_FRAMES = 9  # over which an angle is averaged
MIN_ROTATION_FRAMES = 3 * ANGLE_WINDOW_FRAMES  # frames with an angle that can show a turn
MIN_ROTATION_SIGMAS = 5.0  # by which the rotation must exceed its standard deviation


def correct_track(
    track: Track, tracks: dict[str, Track], *, clocked: bool, min_shake: float = 0.0
) -> tuple[Track, tuple[str, ...], Rows]:
    """Subtract camera shake from a track, correct its times and describe what was found.

    Times are corrected only if the camera wrote no time stamps.
    """
    track = track.measured
    clean, notes, faults = _corrected_track(track, tracks.get("reference"), clocked=clocked, min_shake=min_shake)
    if "backward" in tracks:
        both = tracking.checks.forward_backward(*_unrepaired(track, tracks["backward"]))
        notes += (both.summary,) if both.only_one or both.in_sigma > MIN_DIRECTION_SIGMAS else ()
    notes += (*tracking.checks.self_test(clean), *rotation_note(clean), *lost_frames_note(clean))
    rows = np.arange(len(track)) if clocked else kept_rows(len(track), faults)
    return clean, (*notes, *_timing_notes(faults, len(track), clocked=clocked)), rows


def lost_frames_note(track: Track) -> tuple[str, ...]:
    """Return a note if frames are lost between the first and the last that show the target; at most one."""
    found = np.flatnonzero(track.found)
    if not len(found):
        return ()
    between = track.rows(slice(int(found[0]), int(found[-1]) + 1))
    lost = ~between.found & (True if between.repaired is None else between.repaired == 0)  # repairs have a note already
    count = int(np.count_nonzero(lost))
    if count < max(MIN_LOST_SHARE * len(between), 2):
        return ()
    reasons = replace(between, reason=np.where(lost, between.reason, "")).lost
    why = ", ".join(f"{reason} in {frames}" for reason, frames in reasons.most_common())
    gap = max(stretches(lost), key=lambda part: part.stop - part.start)
    where = f"the longest gap is that of the frames {found[0] + gap.start} to {found[0] + gap.stop - 1}"
    return (f"{count} of {len(between)} frames of the path are empty: {why}; {where}",)


def _corrected_track(
    track: Track, reference: Track | None, *, clocked: bool, min_shake: float = 0.0
) -> tuple[Track, tuple[str, ...], tuple[Slip, ...]]:
    """Return the track without shake and with true times, notes on shake, and the faults of the times.

    The faults are searched first, with the reference as it was measured: a jump in time breaks the tones of a shake.
    """
    found = tracking.checks.slips(_minus_reference(track, reference))
    if clocked:  # a frame that shows the one before is left out, but no time is changed
        track = correct_times(track, [replace(s, frames=0) for s in found if s.doubled])
    else:
        track, reference = correct_times(track, found), None if reference is None else correct_times(reference, found)
    return *measure.calibration.subtract_shake(track, reference, min_shake), found


def _minus_reference(track: Track, reference: Track | None) -> Track:
    """Return the track minus the reference as it was measured, if the reference shakes."""
    if reference is None or not measure.calibration.estimate_shake(reference).detected:
        return track
    x, y = (np.nan_to_num(q - np.nanmean(q)) for q in (reference.x_px, reference.y_px))
    noise = {name: np.nanmedian(getattr(reference, name)) for name in ("sigma_px", "sigma_y_px")}
    sigma = {name: np.hypot(getattr(track, name), own) for name, own in noise.items()}
    return replace(track, x_px=track.x_px - x, y_px=track.y_px - y, **sigma)


def residual_shake(reference: Track | None, min_shake: float) -> tuple[float, float, str] | None:
    """Return the camera shake that may be left in the displacement."""
    if reference is None:
        return None
    used = measure.calibration.estimate_shake(reference, min_shake)
    if used.detected:
        reason = "error of the reference's movement, which was subtracted"
        return used.frequency or 0.0, float(used.sigma[0]), reason
    if used.left_in:
        whole = measure.calibration.estimate_shake(reference)
        return whole.frequency or 0.0, used.left_in, "too small to be subtracted, left in"
    return None


def _unrepaired(track: Track, *others: Track) -> tuple[Track, ...]:
    """Return tracks without the frames that the user repaired in the first of them."""
    if track.repaired is None:
        return track, *others
    hidden = np.where(track.repaired > 0, np.nan, 0.0)
    return tuple(replace(one, x_px=one.x_px + hidden) for one in (track, *others))


def kept_rows(n: int, faults: Sequence[Slip]) -> Rows:
    """Return the rows (of n frames) that are kept: all but doubled frames that were inserted."""
    return np.setdiff1d(np.arange(n), [s.frame for s in faults if s.frames < 0])


def correct_times(track: Track, faults: Sequence[Slip]) -> Track:
    """Return the track with gaps in time where frames are missing, and without inserted doubled frames.

    A doubled frame that replaces a lost one keeps its row, and its position is NaN.
    """
    if not faults:
        return track
    interval = float(np.median(np.diff(track.t)))
    ticks = np.rint((track.t - track.t[0]) / interval).astype(np.int64)
    right, keep = correct_ticks(ticks, faults)
    rows = kept_rows(len(track), faults)
    lost = ~keep[rows]
    own = {f.name: getattr(track, f.name) for f in fields(track) if f.metadata.get("column")}
    columns: dict[str, Any] = {name: np.array(column)[rows] for name, column in own.items() if column is not None}
    for name in MEASURED & columns.keys():
        columns[name][lost] = np.nan
    columns["t"] = columns["t"] + ((right - ticks) * interval)[rows]
    columns["reason"] = np.where(lost, "the frame before once more", columns["reason"])
    return replace(track, **columns)


def _timing_notes(faults: Sequence[Slip], n: int, *, clocked: bool) -> tuple[str, ...]:
    """Return notes on faults of the times of n frames: corrected, or contradicted by the camera's own time stamps."""
    doubled = tracking.checks.timing_note([s for s in faults if s.doubled])
    missing = tracking.checks.timing_note([s for s in faults if not s.doubled])
    if clocked:
        believed = "the film's time stamps disagree and are used"
        return (*(f"{note}; left out, {believed}" for note in doubled), *(f"{note}; {believed}" for note in missing))
    stretched = (NOTE_STRETCHED,) if sum(s.frames < 0 for s in faults) > MIN_STRETCHED_SHARE * n else ()
    left_out = (f"{note}; left out" for note in doubled)
    return (*left_out, *stretched, *(f"{note}; left as gaps in time" for note in missing))


def track_quality(film: RecordingInfo, track: Track, tracks: dict[str, Track], pitch: float | None) -> dict[str, Any]:
    """Return numbers that describe how well one film was measured.

    Parameters
    ----------
    film, track, tracks
        The recording, the track of the target and the other tracks.
    pitch
        Size of a pixel, m; None if it is unknown.

    Returns
    -------
    dict
        Keys of the JSON of `track`; None for what is unknown.

    """
    track = track.measured
    found = track.found
    um = None if pitch is None else 1e6 * pitch
    clean, *_ = _corrected_track(track, tracks.get("reference"), clocked=film.clocked)
    locking, history = tracking.checks.peak_locking(clean), tracking.checks.scores(track)
    both = tracking.checks.forward_backward(*_unrepaired(track, tracks["backward"])) if "backward" in tracks else None
    sigma = float(np.median(clean.sigma_px[clean.found])) if np.any(clean.found) else None
    return {
        "frames": len(track),
        "found": int(np.sum(found)),
        "lost": dict(track.lost),
        "travel_px": float(np.ptp(track.x_px[found])) if np.any(found) else None,
        "sigma_px": sigma,
        "sigma_um": None if um is None or sigma is None else um * sigma,
        "sigma_angle_rad": _median(track.sigma_angle),
        "score": history.median if history else None,
        "lowest_score": history.lowest if history else None,
        "peak_locking_px": locking.amplitude if locking else None,
        "peak_locking_std_px": locking.error if locking else None,
        "forward_backward_px": both.rms if both else None,
        "forward_backward_sigmas": both.in_sigma if both else None,
        **_reference_noise(tracks.get("reference"), um),
        "exposure_s": film.exposure,
        "blur_px": None if film.exposure is None else _high_speed(track) * film.exposure,
        "timebase": [{"what": what, "value": value, "verdict": verdict} for what, value, verdict in film.audit],
    }


def _median(values: Array | None) -> float | None:
    """Return the median of the finite values of a column; None if there are none."""
    known = np.zeros(0) if values is None else values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def _reference_noise(track: Track | None, um: float | None) -> dict[str, Any]:
    """Return the noise of the fixed reference beyond camera shake, and the shake."""
    if track is None:
        return dict.fromkeys(("reference", "noise_floor_px", "noise_floor_um", "shake_px", "shake_Hz"))
    found = measure.calibration.estimate_shake(track)
    floor = float(found.floor[0])
    return {
        "reference": None if track.target is None else list(track.target),
        "noise_floor_px": floor,
        "noise_floor_um": None if um is None else um * floor,
        "shake_px": float(np.hypot(*found.size)),
        "shake_Hz": found.frequency,
    }


def _high_speed(track: Track) -> float:
    """Return the speed of the target that 1 % of the frames exceed, px/s."""
    step = np.hypot(np.diff(track.x_px), np.diff(track.y_px)) / np.diff(track.t)
    known = step[np.isfinite(step)]
    return float(np.quantile(known, 0.99)) if len(known) else float("nan")


def rotation_note(track: Track) -> tuple[str, ...]:
    """Return a note on a target that rotates; empty if it does not.

    A rotation counts if it moves the corners of the target by five standard deviations of its position.
    """
    known = track.found & np.isfinite(track.angle)
    if track.target is None or np.count_nonzero(known) < MIN_ROTATION_FRAMES:
        return ()
    angle = np.unwrap(track.angle[known])
    mean = _running_mean(angle)
    arm = float(np.hypot(*track.target[2:])) / 2
    place = float(np.median(track.sigma_px[known])) / arm
    if np.ptp(mean) < MIN_ROTATION_SIGMAS * max(_range_std(track, angle, known, mean), place):
        return ()
    degrees = float(np.degrees(np.ptp(angle)))
    steps = np.abs(mean[ANGLE_WINDOW_FRAMES:] - mean[:-ANGLE_WINDOW_FRAMES])
    rate = float(np.degrees(np.max(steps))) / ANGLE_WINDOW_FRAMES
    written = f"{degrees:.3g}" if degrees < 100 else f"{degrees:.0f}"
    rocks = "; its middle is followed, and a centre of mass elsewhere moves along another path"
    turns = f"the target turns by {written} deg, up to {rate:.2g} deg a frame"
    return (turns + (rocks if np.ptp(angle) < measure.calibration.MIN_ROTATION else ""),)


def _range_std(track: Track, angle: Array, known: Mask, mean: Array) -> float:
    """Return the standard deviation of the range of the averaged angle, rad.

    The stated deviation is scaled to the scatter of neighbouring frames: a target that is half hidden has a poor angle.
    """
    sigma = np.ones(len(track.angle)) if track.sigma_angle is None else track.sigma_angle
    sigma = np.where(np.isfinite(sigma) & (sigma > 0), sigma, np.inf)[known]
    curvature = np.diff(angle, 2)
    expected = sigma[:-2] ** 2 + 4 * sigma[1:-1] ** 2 + sigma[2:] ** 2
    unit = np.mean(np.where(np.isfinite(expected), curvature**2 / expected, 0.0))
    doubt = np.sqrt(unit * _running_mean(sigma**2) / ANGLE_WINDOW_FRAMES)
    return float(np.hypot(doubt[np.argmax(mean)], doubt[np.argmin(mean)]))


def _running_mean(angle: Array) -> Array:
    """Return the running mean (n - `ANGLE_WINDOW_FRAMES` + 1,) of angles (n,)."""
    return np.convolve(angle, np.full(ANGLE_WINDOW_FRAMES, 1.0 / ANGLE_WINDOW_FRAMES), mode="valid")
