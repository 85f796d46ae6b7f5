"""Repair frames of a film in which the target was tracked wrongly or lost, and find the frames to look at.

Frames are tracked again with the template of the whole film, bridged by the smoothed motion, or left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from frictrack.base.distributions import MEDIAN_TO_SIGMA
from frictrack.base.errors import FrictrackError
from frictrack.measure.motion import differentiate, low_pass
from frictrack.recording import Recording, random_access
from frictrack.records import INTERPOLATED, MEASURED, Array, Displacement, Mask, Track, mask_of_spans, stretches
from frictrack.settings.repairs import LEFT_OUT, MEANINGS, Repair, read_repairs, repair_codes
from frictrack.tracking import Areas, TargetModel, relearn_target, track_frames
from frictrack.tracking.checks import scores

Rows = NDArray[np.intp]
REASON_INTERPOLATED, REASON_LEFT_OUT = "interpolated", "left out by the user"
LONG_GAP_SIGMAS = 10.0  # standard deviation of an interpolated position over that of a measured one, which is reported
MIN_SMOOTHED_FRAMES = 200  # to either side of a gap, from which the motion is smoothed
MIN_SIDE_FRAMES = 3  # that must be measured before and after a gap
CONTEXT_FRAMES = 512  # to either side of frames that are tracked again, which tie these to the rest of the track
MAX_DISAGREEMENT_PX = 0.5  # from the rest of the track, in a frame of the context that is used
MIN_CONTEXT_FRAMES = 5  # from which the offset is estimated

MIN_JUMP_PX = 0.5  # of a step from frame to frame beyond the usual one
MIN_JUMP_SIGMAS = 8.0  # of the scatter of the steps
STEP_WINDOW_FRAMES = 15  # whose median step is the usual one: it follows a release or an impact, which change the speed
MAX_JUMP_SPAN_FRAMES = 100  # between jumps that belong to one mistrack: to another object and back
MIN_DIRECTION_PX, MIN_DIRECTION_SIGMAS = 0.05, 6.0  # between forward and backward tracking
MAX_MERGED_FRAMES = 2  # between two spans that become one


def repair(
    track: Track,
    recording: Recording | None,
    repairs: Sequence[Mapping[str, Any] | Repair],
    *,
    known: TargetModel | None = None,
) -> Track:
    """Repair frames in which the target was tracked wrongly or lost.

    Parameters
    ----------
    track : Track
        Track of the film, as `track` returns it.
    recording : Recording or None
        The film; None if no frame is tracked again.
    repairs : list of dict
        One table per span of frames: ``{"from": 120, "to": 160, "how": "track", "frame": 130, "target": [x, y, w, h]}``
        (frame numbers, both included). "track" finds the target again from `target`, a rectangle or polygon in px in
        frame `frame`, by default the first one: it tells where the target is, its size and exact place do not matter.
        "interpolate" bridges the frames by the smoothed motion. "leave_out" treats them as lost.
    known : TargetModel, optional
        Model of the target, as `learn_target` returns it; learnt from the film again if it is not given.

    Returns
    -------
    Track
        Frames that were repaired are marked in `repaired`: 1 tracked again, 2 interpolated, 3 left out. Interpolated
        positions count nowhere as data.

    Raises
    ------
    FrictrackError
        For a repair beyond the film, repairs that overlap, or a target that is not recognised.

    Examples
    --------
    >>> import frictrack as ft
    >>> film = ft.open_recording(ft.samples.films_folder() / "fast.avi")
    >>> track = ft.track(film)
    >>> repaired = ft.repair(track, film, [{"from": 60, "to": 69, "how": "interpolate"}])
    >>> int(repaired.found.sum()), bool(abs(repaired.x_px[65] - track.x_px[65]) < 0.1)
    (137, True)

    """
    found = read_repairs(repairs)
    for one in found:
        one.check(len(track), None if recording is None else recording.shape)
    codes, measured = repair_codes(found, len(track)), track.measured
    hidden = np.where(codes > 0, np.nan, 0.0)
    result = replace(measured, **{name: column + hidden for name, column in _columns(measured).items()})
    if again := [one for one in found if one.how == "track"]:
        if recording is None:
            raise FrictrackError('expected the recording of the track for how = "track" but got none')
        with random_access(recording) as film:  # once for all repairs
            model = known or relearn_target(film, measured)
            for one in again:
                result = _tracked_again(film, result, one, model, codes == 0)
    for one in found:
        if one.how == "interpolate":
            result = _interpolated(result, one)
    reason = result.reason.astype(object)
    reason[codes == INTERPOLATED], reason[codes == LEFT_OUT] = REASON_INTERPOLATED, REASON_LEFT_OUT
    result = replace(result, reason=reason.astype(str), repaired=codes if np.any(codes) else None)
    notes = (_describe(found), *(note for one in found for note in _gap_note(result, one))) if found else ()
    return replace(result, notes=(*track.notes, *notes))


def repaired_rows(displacement: Displacement, repairs: Sequence[Repair]) -> Displacement:
    """Leave rows of a table out, which are marked in `repaired`; the smoothed motion bridges them.

    Raises FrictrackError for a repair beyond the table.
    """
    if not repairs:
        return displacement
    for one in repairs:
        one.check(len(displacement))
    codes = repair_codes(repairs, len(displacement))
    hidden = np.where(codes > 0, np.nan, 0.0)
    return replace(
        displacement,
        x=displacement.x + hidden,
        y=displacement.y + hidden,
        valid=displacement.valid & (codes == 0),
        notes=(*displacement.notes, _describe(repairs)),
        repaired=codes,
    )


def _columns(track: Track, *others: str) -> dict[str, Any]:
    """Copies of the measured columns of a track that are there, and of others."""
    return {name: np.array(q) for name in (*MEASURED, *others) if (q := getattr(track, name)) is not None}


def _describe(repairs: Sequence[Repair]) -> str:
    """One sentence that lists the repairs."""
    return "repaired by the user: " + ", ".join(f"{one.frames_text} {MEANINGS[one.how]}" for one in repairs)


def _gap_note(track: Track, one: Repair) -> Iterator[str]:
    """Note that frames are lost again, or that a gap is too long for its positions to be well known."""
    if one.how == "track" and (lost := int(np.count_nonzero(~track.found[one.rows]))):
        yield f"{lost} of the {one.frames_text} that were tracked again are lost"
    if one.how == "interpolate":
        sigma = np.maximum(track.sigma_px, track.sigma_y_px)
        usual, largest = float(np.median(sigma[track.found])), float(np.max(sigma[one.rows]))
        if largest > LONG_GAP_SIGMAS * usual:
            known = f"interpolated positions are known to {largest:.2g} px there, measured ones to {usual:.2g} px"
            yield f"the gap of {one.frames_text} is long: {known}"


def _tracked_again(film: Recording, track: Track, one: Repair, known: TargetModel, untouched: Mask) -> Track:
    """Track the target again in the frames of a repair; no repair changes the frames `untouched` (n,).

    The target is recognised by the template of the whole film. A constant difference from the rest of the track, as a
    template learnt from another film can have, is measured in the frames before and after, and subtracted.
    """
    frames = range(max(0, one.first - CONTEXT_FRAMES), min(film.n_frames, one.last + 1 + CONTEXT_FRAMES))
    try:
        found = track_frames(film, frames, one.box, one.start_frame, known, Areas(obstacles=track.obstacles))
    except FrictrackError as e:
        raise FrictrackError(f"repair of {one.frames_text}: {e}") from e
    context = slice(frames.start, frames.stop)
    old = track.rows(context)
    off = np.stack([found.x_px - old.x_px, found.y_px - old.y_px], axis=1)
    agree = np.max(np.abs(np.nan_to_num(off)), axis=1) < MAX_DISAGREEMENT_PX
    same = untouched[context] & old.found & found.found & agree
    offset = np.median(off[same], axis=0) if np.count_nonzero(same) >= MIN_CONTEXT_FRAMES else np.zeros(2)
    part = slice(one.first - frames.start, one.last + 1 - frames.start)
    columns = _columns(track, "score", "reason")
    columns["reason"] = columns["reason"].astype(object)  # a reason may be longer than those before
    for name, column in columns.items():
        column[one.rows] = getattr(found, name)[part]
    columns["x_px"][one.rows] -= offset[0]
    columns["y_px"][one.rows] -= offset[1]
    return replace(track, **{**columns, "reason": columns["reason"].astype(str)})


def _interpolated(track: Track, one: Repair) -> Track:
    """Bridge lost frames by the smoothed motion of the frames around, with deviations that grow with the gap."""
    before, after = (np.flatnonzero(track.found[part]) for part in (slice(0, one.first), slice(one.last + 1, None)))
    if min(len(before), len(after)) < MIN_SIDE_FRAMES:
        raise FrictrackError(
            f"expected measured frames before and after the interpolated {one.frames_text} but there are "
            f'{len(before)} and {len(after)}; use how = "leave_out" at the ends of a film'
        )
    length = one.last + 1 - one.first
    reach = max(MIN_SMOOTHED_FRAMES, 4 * length)
    start, stop = max(0, one.first - reach), min(len(track), one.last + 1 + reach)
    around, gap = track.rows(slice(start, stop)), slice(one.first - start, one.last + 1 - start)
    columns = _columns(track)
    for name, sigma in (("x_px", "sigma_px"), ("y_px", "sigma_y_px")):
        columns[name][one.rows], columns[sigma][one.rows] = _bridge(around, name, sigma, gap)
    known = track.found & np.isfinite(track.angle)
    columns["angle"][one.rows] = np.interp(track.t[one.rows], track.t[known], track.angle[known])
    if track.sigma_angle is not None:
        near = slice(max(one.first - length, 0), one.last + length + 1)  # as far on either side as the gap is long
        turn = np.ptp(track.angle[near][known[near]])
        columns["sigma_angle"][one.rows] = np.hypot(np.nanmedian(track.sigma_angle[known]), turn)
    return replace(track, **columns)


def _bridge(track: Track, name: str, sigma: str, gap: slice) -> tuple[Array, Array]:
    """Positions and standard deviations in a gap along one axis of the picture, px."""
    nan = np.full(len(track), np.nan)
    known, values, deviations = track.found, getattr(track, name), getattr(track, sigma)
    if np.ptp(values[known]) == 0:  # a smoother has nothing to smooth
        still = np.full(gap.stop - gap.start, values[known][0])
        return still, np.full(len(still), np.nanmedian(deviations))
    # The smoother counts in any unit; it only sees measured frames.
    course = Displacement(track.t, np.where(known, values, np.nan), nan, nan, deviations, nan, known)
    first = int(np.flatnonzero(known)[0])
    motion = differentiate(low_pass(course))
    inside = slice(gap.start - first, gap.stop - first)
    return motion.x[inside], np.hypot(motion.sigma_x[inside], track.systematic)  # which no smoother averages out


@dataclass(frozen=True)
class SuspectSpan:
    """Frames that a user should look at.

    Attributes
    ----------
    first, last
        Numbers of the first and the last frame, both included.
    words
        Why, as one sentence without a full stop.

    """

    first: int
    last: int
    words: str


def suspect_spans(track: Track, backward: Track | None = None) -> tuple[SuspectSpan, ...]:
    """List the spans of frames that a user should look at, in order; repaired frames are none.

    Parameters
    ----------
    track : Track
        Track of the target.
    backward : Track, optional
        The same target tracked from the last frame to the first.

    Returns
    -------
    tuple of SuspectSpan
        Spans in which the target was lost between frames that show it, the match score is low, the position jumps off
        the smooth motion, or backward tracking gives another position.

    Examples
    --------
    >>> import frictrack as ft
    >>> track = ft.track(ft.open_recording(ft.samples.films_folder() / "fast.avi"))
    >>> ft.suspect_spans(track)
    ()

    """
    at = np.flatnonzero(track.found)
    if len(at) < STEP_WINDOW_FRAMES:
        return ()
    poor = scores(track)
    causes = {
        "the target was lost": ~track.found & mask_of_spans([(at[0], at[-1])], len(track)),
        "the match is poor": mask_of_spans(poor.low if poor else (), len(track)),
        "the position jumps off the smooth motion": mask_of_spans(_jumps(track, at), len(track)),
    }
    if backward is not None:
        off = np.hypot(track.x_px - backward.x_px, track.y_px - backward.y_px)
        sigma = np.nan_to_num(np.hypot(track.sigma_px, track.sigma_y_px))
        differs = np.nan_to_num(off) > np.maximum(MIN_DIRECTION_PX, MIN_DIRECTION_SIGMAS * sigma)
        causes["tracking backward gives another position"] = differs
    open_frames = np.ones(len(track), np.bool_) if track.repaired is None else track.repaired == 0
    marked = np.any([mask & open_frames for mask in causes.values()], axis=0)
    for gap in stretches(~marked):
        if gap.start > 0 and gap.stop < len(marked) and gap.stop - gap.start <= MAX_MERGED_FRAMES:
            marked[gap] = True
    return tuple(
        SuspectSpan(part.start, part.stop - 1, "; ".join(why for why, mask in causes.items() if mask[part].any()))
        for part in stretches(marked & open_frames)
    )


def _jumps(track: Track, at: Rows) -> Iterator[tuple[int, int]]:
    """Spans from a jump of the position to the last one that follows soon; of one jump, the frames on both sides."""
    steps = _lone_steps(track.x_px[at], at) | _lone_steps(track.y_px[at], at)
    jumps = np.flatnonzero(steps)  # step k leads from frame at[k] to at[k + 1]
    for group in np.split(jumps, np.flatnonzero(np.diff(at[jumps]) > MAX_JUMP_SPAN_FRAMES) + 1):
        if len(group) == 1:
            yield at[group[0]], at[group[0] + 1]
        elif len(group):
            yield at[group[0] + 1], at[group[-1]]


def _lone_steps(x: Array, at: Rows) -> Mask:
    """Steps (n - 1,) that stand alone: larger than the usual step by far more than the scatter of the steps."""
    step, frames = np.diff(x), np.diff(at)
    usual = median_filter(step / frames, size=STEP_WINDOW_FRAMES, mode="nearest")
    off = np.abs(step - usual * frames)
    scatter = MEDIAN_TO_SIGMA * median_filter(off, size=4 * STEP_WINDOW_FRAMES + 1, mode="nearest")
    # over a gap, the usual step does not say how far the target moves
    return np.asarray((off > np.maximum(MIN_JUMP_PX, MIN_JUMP_SIGMAS * scatter)) & (frames == 1))
