"""List the spans of frames that a user should look at: lost, poorly matched, off the smooth motion, or in doubt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from frictrack.distributions import MEDIAN_TO_SIGMA
from frictrack.records import Array, Mask, Track, stretches
from frictrack.tracking.checks import scores

MIN_JUMP_PX = 0.5  # of a step from frame to frame beyond the usual one
MIN_JUMP_SIGMAS = 8.0  # of the scatter of the steps
STEP_WINDOW_FRAMES = 15  # whose median step is the usual one: it follows a release or an impact, which change the speed
MAX_JUMP_SPAN_FRAMES = 100  # between jumps that belong to one mistrack: to another object and back
MIN_DIRECTION_PX, MIN_DIRECTION_SIGMAS = 0.05, 6.0  # between forward and backward tracking
MAX_MERGED_FRAMES = 2  # between two spans that become one
LOST, POOR, JUMP, DIRECTION = (
    "the target was lost",
    "the match is poor",
    "the position jumps off the smooth motion",
    "tracking backward gives another position",
)


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
    if np.count_nonzero(track.found) < STEP_WINDOW_FRAMES:
        return ()
    causes = {
        LOST: _lost(track),
        POOR: _poor(track),
        JUMP: _jumps(track),
        DIRECTION: np.zeros(len(track), np.bool_) if backward is None else _directions(track, backward),
    }
    open_frames = np.ones(len(track), np.bool_) if track.repaired is None else track.repaired == 0
    marked = np.any([mask & open_frames for mask in causes.values()], axis=0)
    return tuple(
        SuspectSpan(part.start, part.stop - 1, "; ".join(why for why, mask in causes.items() if mask[part].any()))
        for part in stretches(_bridged(marked) & open_frames)
    )


def _lost(track: Track) -> Mask:
    """Frames (n,) without a position between the first and the last frame that show the target."""
    at = np.flatnonzero(track.found)
    inside = np.zeros(len(track), np.bool_)
    inside[at[0] : at[-1] + 1] = True
    return np.asarray(inside & ~track.found)


def _poor(track: Track) -> Mask:
    """Frames (n,) with a low match score."""
    out = np.zeros(len(track), np.bool_)
    found = scores(track)
    for first, last in found.low if found else ():
        out[first : last + 1] = True
    return out


def _jumps(track: Track) -> Mask:
    """Frames (n,) from a jump of the position to the last one that follows soon; of one jump, those on both sides."""
    at = np.flatnonzero(track.found)
    steps = _lone_steps(track.x_px[at], at) | _lone_steps(track.y_px[at], at)
    out = np.zeros(len(track), np.bool_)
    jumps = np.flatnonzero(steps)  # step k leads from frame at[k] to at[k + 1]
    for group in np.split(jumps, np.flatnonzero(np.diff(at[jumps]) > MAX_JUMP_SPAN_FRAMES) + 1):
        if len(group) == 1:
            out[at[group[0]] : at[group[0] + 1] + 1] = True
        elif len(group):
            out[at[group[0] + 1] : at[group[-1]] + 1] = True
    return out


def _lone_steps(x: Array, at: np.ndarray) -> Mask:
    """Steps (n - 1,) that stand alone: larger than the usual step by far more than the scatter of the steps."""
    step = np.diff(x)
    per_frame = step / np.diff(at)
    usual = median_filter(per_frame, size=STEP_WINDOW_FRAMES, mode="nearest")
    off = np.abs(step - usual * np.diff(at))
    scatter = MEDIAN_TO_SIGMA * median_filter(off, size=4 * STEP_WINDOW_FRAMES + 1, mode="nearest")
    curved = np.diff(at) > 1  # over a gap, the usual step does not say how far the target moves
    return np.asarray((off > np.maximum(MIN_JUMP_PX, MIN_JUMP_SIGMAS * scatter)) & ~curved)


def _directions(track: Track, backward: Track) -> Mask:
    """Frames (n,) in which tracking forward and backward found different positions."""
    off = np.hypot(track.x_px - backward.x_px, track.y_px - backward.y_px)
    sigma = np.hypot(track.sigma_px, track.sigma_y_px)
    return np.asarray(np.nan_to_num(off) > np.maximum(MIN_DIRECTION_PX, MIN_DIRECTION_SIGMAS * np.nan_to_num(sigma)))


def _bridged(marked: Mask) -> Mask:
    """The same mask with short gaps between marked frames filled."""
    out = marked.copy()
    for gap in stretches(~marked):
        if gap.start > 0 and gap.stop < len(marked) and gap.stop - gap.start <= MAX_MERGED_FRAMES:
            out[gap] = True
    return out
