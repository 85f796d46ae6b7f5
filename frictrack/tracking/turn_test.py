"""Decide whether a target turns too far for small rotations, before it is followed as one that turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frictrack.errors import FrictrackError
from frictrack.recording import Recording
from frictrack.records import Array
from frictrack.tracking.follow import FLAT, LEAVES, SHARE, UNREAD, Followed
from frictrack.tracking.pose import Pose, TurnedPicture
from frictrack.tracking.turned import search_pose

AS_MANY, CLEARLY_MORE = 0.98, 2.0  # times the frames of a target that does not turn
OFTEN = 0.1  # of the frames, in which small rotations are no longer linear
LARGEST_SWING = 1.0  # px that small rotations may move the target's corners: beyond, they are no longer linear
SAMPLED = 8  # lost frames in which a turned target is looked for before all are gone through
BETTER = 0.15  # by this much must a turned picture match better than the upright one, for the target to have turned ...
LEFT = 0.25  # ... or leave this share of the variance that the upright one does not explain


def frames_to_beat(
    film: Recording, followed: Followed, picture: TurnedPicture, start: Array, first: int
) -> float | None:
    """In how many frames a turning target must be seen to be followed as one; None where it does not turn.

    It turns farther than small rotations tell: seen in the angles, or in the frames lost first. What is seen only after
    it was lost must bring back as many frames as were seen: a mass that slides and then falls off the course has
    turned, too, and its slide is what matters.
    """
    angle = followed.fine.angle[followed.found]
    found = float(np.sum(followed.found))
    if np.mean(np.abs(angle - np.median(angle)) * picture.radius > LARGEST_SWING) > OFTEN:
        return AS_MANY * found
    worth = _turns_where_lost(film, followed, picture, start, first)
    return CLEARLY_MORE * found if worth and _brings_back(film, followed, picture, CLEARLY_MORE * found) else None


def _brings_back(film: Recording, followed: Followed, picture: TurnedPicture, least: float) -> bool:
    """Whether enough of the lost frames may show a turned target for it to be seen in `least` frames of the film.

    It is looked for in a few of them, spread over the film. One frame by itself tells less than all, one after the
    other: half of the share that is needed is enough.
    """
    lost, found = np.flatnonzero(~followed.found), np.flatnonzero(followed.found)
    share = (least - len(found)) / max(len(lost), 1)
    if share > 1 or len(lost) <= 2 * SAMPLED:
        return share <= 1
    usual = float(np.median(followed.fine.score[found]))
    missable = (1 - 0.5 * share) * SAMPLED
    for i in np.random.default_rng(0).permutation(lost[np.linspace(0, len(lost) - 1, SAMPLED).astype(int)]):
        missable -= not _is_seen(film, int(i), Pose(_nearest(followed, found, i) + picture.middle, 0.0), picture, usual)
        if missable < 0:
            return False
    return True


def _nearest(followed: Followed, found: NDArray[np.int64], i: int) -> Array:
    """Corner (2,) of the target in the nearest of the frames in which it was found, px."""
    return np.asarray(followed.at[found[np.argmin(np.abs(found - i))]])


def _is_seen(film: Recording, i: int, near: Pose, picture: TurnedPicture, usual: float) -> bool:
    """Whether a turned picture matches frame `i` anywhere, as well as the target is usually matched."""
    try:
        frame = film.frame(i)
    except FrictrackError:
        return False
    pose = None if frame.min() == frame.max() else search_pose(frame, near, picture, usual)
    return pose is not None and pose.settled and pose.score >= SHARE * usual


def _turns_where_lost(film: Recording, followed: Followed, picture: TurnedPicture, start: Array, first: int) -> bool:
    """Whether a turned picture matches clearly better where the target was lost first."""
    lost = [i for i in _lost_first(followed, first) if followed.reason[i] not in (LEAVES, UNREAD, FLAT)]
    return any(_has_turned(film, followed, picture, i, first, start) for i in lost)


def _lost_first(followed: Followed, first: int) -> list[int]:
    """The frames at which the target was lost for the first time, on the way forward and backward."""
    found = followed.found
    after, before = np.flatnonzero(~found[first:]) + first, np.flatnonzero(~found[:first])
    return [*after[:1].tolist(), *before[-1:].tolist()]


def _has_turned(film: Recording, followed: Followed, picture: TurnedPicture, i: int, first: int, start: Array) -> bool:
    """Whether a turned picture matches frame `i` clearly better than the upright one."""
    near = i - 1 if i > first else i + 1
    at = followed.at[near] if followed.found[near] else np.asarray(start, dtype=np.float64)
    frame = film.frame(i)
    found = search_pose(frame, Pose(at + picture.middle, 0.0), picture, 1.0)
    upright = float(np.nan_to_num(followed.fine.score[i]))
    if found is None or not found.settled or found.score < SHARE:
        return False
    return found.score > upright + BETTER or 1 - found.score**2 < LEFT * (1 - upright**2)
