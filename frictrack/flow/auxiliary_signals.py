"""What else was seen of the runs: further targets of a film, and the accelerometer, at the frames of the mass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from frictrack.flow.film_stages import BACKWARD
from frictrack.flow.pipeline import RunPipeline
from frictrack.records import Array, Run, Track

TIME_TOLERANCE_S = 1e-9  # s
MIN_FRAMES = 8  # frames from which it is told what rides on the mass
MIN_GAIN = 0.5  # of the way of the mass: what goes farther with it rides on it
MAX_OTHER_MOTION = 0.02  # of its motion that may be another one


def auxiliary_signals(pipelines: Sequence[RunPipeline]) -> dict[str, dict[str, Array]]:
    """By run and name: series (n,) at the frames of the displacement, NaN where unknown.

    A target's picture is brought to metres by the scale of the mass, and not turned along the course: only its
    likeness counts.
    """
    out: dict[str, dict[str, Array]] = {}
    for pipeline in pipelines:
        record = pipeline.to_run()
        if record.role != "fit":
            continue
        found: dict[str, Array] = {}
        for name, track in (pipeline.get("tracks") if "tracks" in pipeline.stages else {}).items():
            if name != BACKWARD:  # the mass once more
                found |= _target_signals(name, track, record)
        felt = pipeline.get("sensors").a
        if felt is not None and len(felt) == len(record.displacement):
            found["accelerometer"] = felt
        out[pipeline.run.name] = found
    return out


def _target_signals(name: str, track: Track, record: Run) -> dict[str, Array]:
    """Both directions of a target's picture, m (px where no scale is known); nothing of what rides on the mass."""
    rows = _rows_of_run(track, record)
    if rows is None or not np.any(track.found[rows]):
        return {}
    pitch = record.pixel_pitch or 1.0
    x, y = pitch * track.x_px[rows], pitch * track.y_px[rows]
    if _moves_with_mass(np.stack([x, y], axis=1), record.displacement.x):
        return {}
    return {f"the {name}, right": x - np.nanmean(x), f"the {name}, up": -(y - np.nanmean(y))}


def _rows_of_run(track: Track, record: Run) -> NDArray[np.int64] | None:
    """Rows of a track that are the frames of a run; None where the run's times are others."""
    t = record.displacement.t
    if len(track) == len(t):
        return np.arange(len(t))
    rows = np.searchsorted(track.t, t - TIME_TOLERANCE_S).clip(0, len(track) - 1)
    return rows if np.allclose(track.t[rows], t, rtol=0, atol=TIME_TOLERANCE_S) else None


def _moves_with_mass(place: Array, x: Array) -> bool:
    """Whether what is seen at `place` (n, 2) goes along with the mass at x (n,): its motion is that of the mass."""
    known = np.isfinite(x) & np.all(np.isfinite(place), axis=1)
    if np.count_nonzero(known) < MIN_FRAMES:
        return False
    moved, own = place[known] - place[known].mean(axis=0), x[known] - x[known].mean()
    along = own @ moved / max(float(own @ own), 1e-300)  # of the way of the mass, in both directions
    left = moved - own[:, None] * along
    return bool(np.linalg.norm(along) > MIN_GAIN and np.sum(left**2) < MAX_OTHER_MOTION * np.sum(moved**2))
