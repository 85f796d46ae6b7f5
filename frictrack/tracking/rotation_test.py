"""Decide whether a target rotates too far for small angles, before it is tracked as rotating."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frictrack.errors import FrictrackError
from frictrack.recording import Recording
from frictrack.records import Array
from frictrack.tracking.batch_tracker import MIN_SCORE_SHARE
from frictrack.tracking.pose import Pose, RotatableTemplate
from frictrack.tracking.pose_search import search_pose
from frictrack.tracking.raw_track import FLAT, LEAVES, UNREAD, RawTrack

SAME_COUNT_RATIO, CLEARLY_MORE_RATIO = 0.98, 2.0  # finds of a rotating target over those of one that does not rotate
MIN_LARGE_ROTATION_SHARE = 0.1  # of the frames
MAX_CORNER_MOTION_PX = 1.0  # beyond it the linear model of small rotations is invalid
N_SAMPLED_FRAMES = 8  # lost frames that are searched before all of them are
CLEARLY_BETTER_SCORE = 0.15  # by which a rotated template must match better than the upright one ...
MAX_UNEXPLAINED_RATIO = 0.25  # ... or unexplained variance of the rotated template over that of the upright one


def min_frames_if_rotating(
    film: Recording, raw_track: RawTrack, rotatable: RotatableTemplate, start: Array, first: int
) -> float | None:
    """Compute in how many frames a rotating target must be found to be tracked as rotating.

    Large angles show in the fit, or a rotated template matches where the target was lost first. In the second case
    tracking
    must recover as many frames as were found. A mass that slides and then falls off the course has also rotated, but
    only
    its slide matters.

    Parameters
    ----------
    film : Recording
        Film with random access.
    raw_track : RawTrack
        Track for small angles.
    rotatable : RotatableTemplate
        Template of the target.
    start : array (2,)
        Corner of the target's rectangle in frame `first`, px.
    first : int
        Number of that frame.

    Returns
    -------
    float or None
        None where the target does not rotate.

    """
    angle = raw_track.fit.angle[raw_track.found]
    found = float(np.sum(raw_track.found))
    if np.mean(np.abs(angle - np.median(angle)) * rotatable.radius > MAX_CORNER_MOTION_PX) > MIN_LARGE_ROTATION_SHARE:
        return SAME_COUNT_RATIO * found
    rotates = _rotated_where_lost(film, raw_track, rotatable, start, first)
    return (
        CLEARLY_MORE_RATIO * found
        if rotates and _may_recover(film, raw_track, rotatable, CLEARLY_MORE_RATIO * found)
        else None
    )


def _may_recover(film: Recording, raw_track: RawTrack, rotatable: RotatableTemplate, min_frames: float) -> bool:
    """Whether enough of the lost frames may show a rotated target to reach `min_frames` finds.

    A few of them, spread over the film, are searched. A single frame is less certain than all in sequence, therefore
    half
    of the required share is enough.
    """
    lost_frames, found = np.flatnonzero(~raw_track.found), np.flatnonzero(raw_track.found)
    share = (min_frames - len(found)) / max(len(lost_frames), 1)
    if share > 1 or len(lost_frames) <= 2 * N_SAMPLED_FRAMES:
        return share <= 1
    typical_score = float(np.median(raw_track.fit.score[found]))
    misses_left = (1 - 0.5 * share) * N_SAMPLED_FRAMES
    for i in np.random.default_rng(0).permutation(
        lost_frames[np.linspace(0, len(lost_frames) - 1, N_SAMPLED_FRAMES).astype(int)]
    ):
        misses_left -= not _is_found(
            film, int(i), Pose(_nearest(raw_track, found, i) + rotatable.middle, 0.0), rotatable, typical_score
        )
        if misses_left < 0:
            return False
    return True


def _nearest(raw_track: RawTrack, found: NDArray[np.int64], i: int) -> Array:
    """Corner (2,) px of the target in the nearest frame in which it was found."""
    return np.asarray(raw_track.position[found[np.argmin(np.abs(found - i))]])


def _is_found(film: Recording, i: int, near: Pose, rotatable: RotatableTemplate, typical_score: float) -> bool:
    """Whether a rotated template matches frame `i` anywhere, as well as the target typically does."""
    try:
        frame = film.frame(i)
    except FrictrackError:
        return False
    pose = None if frame.min() == frame.max() else search_pose(frame, near, rotatable, typical_score)
    return pose is not None and pose.converged and pose.score >= MIN_SCORE_SHARE * typical_score


def _rotated_where_lost(
    film: Recording, raw_track: RawTrack, rotatable: RotatableTemplate, start: Array, first: int
) -> bool:
    """Whether a rotated template matches clearly better where the target was lost first."""
    lost_frames = [i for i in _first_lost_frames(raw_track, first) if raw_track.reason[i] not in (LEAVES, UNREAD, FLAT)]
    return any(_has_rotated(film, raw_track, rotatable, i, first, start) for i in lost_frames)


def _first_lost_frames(raw_track: RawTrack, first: int) -> list[int]:
    """Frames in which the target was lost first, forward and backward."""
    found = raw_track.found
    after, before = np.flatnonzero(~found[first:]) + first, np.flatnonzero(~found[:first])
    return [*after[:1].tolist(), *before[-1:].tolist()]


def _has_rotated(
    film: Recording, raw_track: RawTrack, rotatable: RotatableTemplate, i: int, first: int, start: Array
) -> bool:
    """Whether a rotated template matches frame `i` clearly better than the upright one."""
    near = i - 1 if i > first else i + 1
    at = raw_track.position[near] if raw_track.found[near] else np.asarray(start, dtype=np.float64)
    frame = film.frame(i)
    found = search_pose(frame, Pose(at + rotatable.middle, 0.0), rotatable, 1.0)
    upright = float(np.nan_to_num(raw_track.fit.score[i]))
    if found is None or not found.converged or found.score < MIN_SCORE_SHARE:
        return False
    return found.score > upright + CLEARLY_BETTER_SCORE or 1 - found.score**2 < MAX_UNEXPLAINED_RATIO * (1 - upright**2)
