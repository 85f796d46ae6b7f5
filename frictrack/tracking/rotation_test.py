"""Decide whether a target turns too far for small rotations, before it is followed as one that turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frictrack.errors import FrictrackError
from frictrack.recording import Recording
from frictrack.records import Array
from frictrack.tracking.batch_tracker import FLAT, LEAVES, MIN_SCORE_SHARE, UNREAD, RawTrack
from frictrack.tracking.pose import Pose, RotatableTemplate
from frictrack.tracking.pose_tracker import search_pose

SAME_COUNT_RATIO, CLEARLY_MORE_RATIO = 0.98, 2.0  # times the frames of a target that does not turn
MIN_LARGE_ROTATION_SHARE = 0.1  # of the frames, in which small rotations are no longer linear
MAX_CORNER_MOTION_PX = 1.0  # px that small rotations may move the target's corners: beyond, they are no longer linear
N_SAMPLED_FRAMES = 8  # lost frames in which a turned target is looked for before all are gone through
CLEARLY_BETTER_SCORE = (
    0.15  # by this much must a turned picture match better than the upright one, for the target to have turned ...
)
MAX_UNEXPLAINED_RATIO = 0.25  # ... or leave this share of the variance that the upright one does not explain


def min_frames_if_rotating(
    film: Recording, raw_track: RawTrack, rotatable: RotatableTemplate, start: Array, first: int
) -> float | None:
    """In how many frames a turning target must be seen to be followed as one; None where it does not turn.

    It turns farther than small rotations tell: seen in the angles, or in the frames lost first. What is seen only after
    it was lost must bring back as many frames as were seen: a mass that slides and then falls off the course has
    turned, too, and its slide is what matters.
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
    """Whether enough of the lost frames may show a turned target for it to be seen in `min_frames` frames of the film.

    It is looked for in a few of them, spread over the film. One frame by itself tells less than all, one after the
    other: half of the share that is needed is enough.
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
    """Corner (2,) of the target in the nearest of the frames in which it was found, px."""
    return np.asarray(raw_track.position[found[np.argmin(np.abs(found - i))]])


def _is_found(film: Recording, i: int, near: Pose, rotatable: RotatableTemplate, typical_score: float) -> bool:
    """Whether a turned picture matches frame `i` anywhere, as well as the target is usually matched."""
    try:
        frame = film.frame(i)
    except FrictrackError:
        return False
    pose = None if frame.min() == frame.max() else search_pose(frame, near, rotatable, typical_score)
    return pose is not None and pose.converged and pose.score >= MIN_SCORE_SHARE * typical_score


def _rotated_where_lost(
    film: Recording, raw_track: RawTrack, rotatable: RotatableTemplate, start: Array, first: int
) -> bool:
    """Whether a turned picture matches clearly better where the target was lost first."""
    lost_frames = [i for i in _first_lost_frames(raw_track, first) if raw_track.reason[i] not in (LEAVES, UNREAD, FLAT)]
    return any(_has_rotated(film, raw_track, rotatable, i, first, start) for i in lost_frames)


def _first_lost_frames(raw_track: RawTrack, first: int) -> list[int]:
    """The frames at which the target was lost for the first time, on the way forward and backward."""
    found = raw_track.found
    after, before = np.flatnonzero(~found[first:]) + first, np.flatnonzero(~found[:first])
    return [*after[:1].tolist(), *before[-1:].tolist()]


def _has_rotated(
    film: Recording, raw_track: RawTrack, rotatable: RotatableTemplate, i: int, first: int, start: Array
) -> bool:
    """Whether a turned picture matches frame `i` clearly better than the upright one."""
    near = i - 1 if i > first else i + 1
    at = raw_track.position[near] if raw_track.found[near] else np.asarray(start, dtype=np.float64)
    frame = film.frame(i)
    found = search_pose(frame, Pose(at + rotatable.middle, 0.0), rotatable, 1.0)
    upright = float(np.nan_to_num(raw_track.fit.score[i]))
    if found is None or not found.converged or found.score < MIN_SCORE_SHARE:
        return False
    return found.score > upright + CLEARLY_BETTER_SCORE or 1 - found.score**2 < MAX_UNEXPLAINED_RATIO * (1 - upright**2)
