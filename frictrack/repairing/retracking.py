"""Track the target again in the frames of a repair, in the reference of the whole track."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.recording import Recording
from frictrack.records import MEASURED, Array, Mask, Track
from frictrack.repairs import Repair
from frictrack.tracking import Areas, TargetModel, track_frames

CONTEXT_FRAMES = 512  # to either side of a repair, which are tracked too and tie it to the rest of the track
MAX_DISAGREEMENT_PX = 0.5  # from the rest of the track, in a frame of the context that is used
MIN_CONTEXT_FRAMES = 5  # from which the offset is estimated


def track_again(film: Recording, track: Track, one: Repair, known: TargetModel, untouched: Mask) -> Track:
    """Track the target again in the frames of one repair.

    The target is recognised by the template of the whole film. A constant difference from the rest of the track, as a
    template learnt from another film can have, is measured in the frames before and after, and subtracted.

    Parameters
    ----------
    film : Recording
        Film with random access.
    track : Track
        Track of the film.
    one : Repair
        Repair with how = "track".
    known : TargetModel
        Model of the target.
    untouched : array of bool (n,)
        Frames that no repair changes.

    Returns
    -------
    Track
        The track with new positions in the frames of the repair.

    Raises
    ------
    FrictrackError
        Where the target is not recognised.

    """
    frames = range(max(0, one.first - CONTEXT_FRAMES), min(film.n_frames, one.last + 1 + CONTEXT_FRAMES))
    try:
        found = track_frames(film, frames, one.box, one.start_frame, known, Areas(obstacles=track.obstacles))
    except FrictrackError as e:
        raise FrictrackError(f"repair of {one.frames_text}: {e}") from e
    context = slice(frames.start, frames.stop)
    offset = _offset(track.rows(context), found, untouched[context])
    rows, part = slice(one.first, one.last + 1), slice(one.first - frames.start, one.last + 1 - frames.start)
    names = (*MEASURED, "score", "reason")
    columns: dict[str, Any] = {name: np.array(q) for name in names if (q := getattr(track, name)) is not None}
    columns["reason"] = columns["reason"].astype(object)  # a reason may be longer than those before
    for name, column in columns.items():
        column[rows] = getattr(found, name)[part]
    columns["x_px"][rows] -= offset[0]
    columns["y_px"][rows] -= offset[1]
    return replace(track, **{**columns, "reason": columns["reason"].astype(str)})


def _offset(track: Track, found: Track, untouched: Mask) -> Array:
    """Constant difference (2,) px of a new track from the old one, in frames that both measured alike."""
    off = np.stack([found.x_px - track.x_px, found.y_px - track.y_px], axis=1)
    same = untouched & track.found & found.found & (np.max(np.abs(np.nan_to_num(off)), axis=1) < MAX_DISAGREEMENT_PX)
    return np.median(off[same], axis=0) if np.count_nonzero(same) >= MIN_CONTEXT_FRAMES else np.zeros(2)
