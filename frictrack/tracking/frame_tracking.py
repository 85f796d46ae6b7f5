"""Track a known target in some frames of a film, from a place that the user drew."""

from __future__ import annotations

import cv2
import numpy as np

from frictrack.errors import FrictrackError
from frictrack.recording import FrameRange, Recording
from frictrack.records import Array, Track
from frictrack.tracking.areas import Areas
from frictrack.tracking.batch_tracker import MIN_SCORE
from frictrack.tracking.correlation import correlate, parabola_vertex
from frictrack.tracking.driver import follow_known
from frictrack.tracking.followed_target import Followed, measure_track
from frictrack.tracking.segments import Work
from frictrack.tracking.target_model import TargetModel

SEARCH_SHARE = 0.5  # of the target's sides, round the drawn place


def track_frames(
    film: Recording,
    frames: range,
    box: tuple[float, float, float, float],
    frame: int,
    known: TargetModel,
    obstacles: Areas | None = None,
) -> Track:
    """Track a known target through some frames, both ways from the frame in which its place was drawn.

    Parameters
    ----------
    film : Recording
        Film with random access.
    frames : range
        Numbers of neighbouring frames.
    box : tuple of float
        Rectangle (x, y, w, h) px that tells where the target is; its own size and place do not change the result.
    frame : int
        Number of the frame in which it was drawn.
    known : TargetModel
        Model of the target, as `learn_target` returns it.
    obstacles : Areas, optional
        Obstacles before the target.

    Returns
    -------
    Track
        One row for each of `frames`.

    Raises
    ------
    FrictrackError
        Where the target is not recognised near `box`, or found in fewer than two frames.

    """
    part = FrameRange(film, frames.start, frames.stop)
    drawn = obstacles or Areas()
    start = _locate(part, box, frame - frames.start, known)
    if start is None:
        raise FrictrackError(
            f"expected the target near its drawn place in frame {frame} but it is not recognised "
            "there; draw it in a frame that shows it well"
        )
    at = frame - frames.start
    raw_track = follow_known(part, known, drawn.obstacle_mask(film.shape), start, at, Work())
    rows = np.flatnonzero(raw_track.found & (not known.rotates))
    h, w = known.template.weight.shape
    rectangle = (round(float(start[0])), round(float(start[1])), w, h)
    return measure_track(part, part, Areas(), Followed(rectangle, at, raw_track, known, rows), "target", Work())


def _locate(film: Recording, box: tuple[float, float, float, float], frame: int, known: TargetModel) -> Array | None:
    """Corner (2,) px of the best match of the target near a drawn rectangle; None where nothing matches."""
    size = np.array(known.template.weight.shape[::-1])
    middle = np.array(box[:2]) + np.array(box[2:]) / 2
    if known.rotates:  # its angle in this frame is unknown: the tracker searches it
        return np.asarray(middle + 0.5 - size / 2)
    reach = np.ceil(np.maximum(SEARCH_SHARE * size, np.array(box[2:]) / 2 - size / 2))
    room = np.array(film.shape[::-1])
    low = np.clip(np.floor(middle - size / 2 - reach), 0, room - size).astype(int)
    high = np.clip(np.ceil(middle + size / 2 + reach), low + size, room).astype(int)
    window = film.frame(frame)[low[1] : high[1], low[0] : high[0]]
    scores = correlate(window.astype(np.float32), known.template.image.astype(np.float32), known.template.mask)
    _, best, _, (i, j) = cv2.minMaxLoc(scores)
    if best < MIN_SCORE:
        return None
    return np.array([low[0] + i + parabola_vertex(scores[j], i), low[1] + j + parabola_vertex(scores[:, i], j)])
