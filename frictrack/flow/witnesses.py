"""What else was seen of the runs: further targets of a film, and the accelerometer, at the frames of the mass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from frictrack.flow.films import BACKWARD
from frictrack.flow.stages import RunWork
from frictrack.records import Array, Run, Track

SAME_TIME = 1e-9  # s
FEWEST = 8  # frames from which it is told what rides on the mass
HALF = 0.5  # of the way of the mass: what goes farther with it rides on it
ALIKE = 0.02  # of its motion that may be another one


def seen_beside(works: Sequence[RunWork]) -> dict[str, dict[str, Array]]:
    """By run and name: series (n,) at the frames of the displacement, NaN where unknown.

    A target's picture is brought to metres by the scale of the mass, and not turned along the course: only its
    likeness counts.
    """
    out: dict[str, dict[str, Array]] = {}
    for work in works:
        record = work.record()
        if record.role != "fit":
            continue
        found: dict[str, Array] = {}
        for name, track in (work.get("tracks") if "tracks" in work.stages else {}).items():
            if name != BACKWARD:  # the mass once more
                found |= _of_target(name, track, record)
        felt = work.get("sensors").a
        if felt is not None and len(felt) == len(record.displacement):
            found["accelerometer"] = felt
        out[work.run.name] = found
    return out


def _of_target(name: str, track: Track, record: Run) -> dict[str, Array]:
    """Both directions of a target's picture, m (px where no scale is known); nothing of what rides on the mass."""
    rows = _frames(track, record)
    if rows is None or not np.any(track.found[rows]):
        return {}
    pitch = record.pixel_pitch or 1.0
    x, y = pitch * track.x_px[rows], pitch * track.y_px[rows]
    if _rides(np.stack([x, y], axis=1), record.displacement.x):
        return {}
    return {f"the {name}, right": x - np.nanmean(x), f"the {name}, up": -(y - np.nanmean(y))}


def _frames(track: Track, record: Run) -> NDArray[np.int64] | None:
    """Rows of a track that are the frames of a run; None where the run's times are others."""
    t = record.displacement.t
    if len(track) == len(t):
        return np.arange(len(t))
    rows = np.searchsorted(track.t, t - SAME_TIME).clip(0, len(track) - 1)
    return rows if np.allclose(track.t[rows], t, rtol=0, atol=SAME_TIME) else None


def _rides(place: Array, x: Array) -> bool:
    """Whether what is seen at `place` (n, 2) goes along with the mass at x (n,): its motion is that of the mass."""
    known = np.isfinite(x) & np.all(np.isfinite(place), axis=1)
    if np.count_nonzero(known) < FEWEST:
        return False
    moved, own = place[known] - place[known].mean(axis=0), x[known] - x[known].mean()
    along = own @ moved / max(float(own @ own), 1e-300)  # of the way of the mass, in both directions
    left = moved - own[:, None] * along
    return bool(np.linalg.norm(along) > HALF and np.sum(left**2) < ALIKE * np.sum(moved**2))
