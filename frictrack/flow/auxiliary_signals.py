"""Collect what else was measured during the runs: further targets of a film, and the accelerometer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from frictrack.flow.film_stages import BACKWARD
from frictrack.flow.pipeline import RunPipeline
from frictrack.records import Array, Run, Track

TIME_TOLERANCE_S = 1e-9  # s
MIN_FRAMES = 8  # frames needed to decide whether a target moves with the mass
MIN_GAIN = 0.5  # displacement of the target per displacement of the mass, from which it may be fixed to the mass
MAX_OTHER_MOTION = 0.02  # share of its squared motion that may be independent of the mass


def auxiliary_signals(pipelines: Sequence[RunPipeline]) -> dict[str, dict[str, Array]]:
    """Return the auxiliary signals of all fitted runs.

    A target is scaled like the mass but not rotated into the course axis, because only the shape of its signal is used.

    Parameters
    ----------
    pipelines
        The runs, up to date up to "sensors" and "tracks".

    Returns
    -------
    dict of str to dict of str to ndarray
        By run and by name of the signal: values (n,) at the frames of the displacement, NaN where unknown.

    """
    out: dict[str, dict[str, Array]] = {}
    for pipeline in pipelines:
        record = pipeline.to_run()
        if record.role != "fit":
            continue
        found: dict[str, Array] = {}
        for name, track in (pipeline.get("tracks") if "tracks" in pipeline.stages else {}).items():
            if name != BACKWARD:  # a second track of the mass
                found |= _target_signals(name, track, record)
        felt = pipeline.get("sensors").a
        if felt is not None and len(felt) == len(record.displacement):
            found["accelerometer"] = felt
        out[pipeline.run.name] = found
    return out


def _target_signals(name: str, track: Track, record: Run) -> dict[str, Array]:
    """Return both coordinates of a target, m (px without a scale); empty if it moves with the mass."""
    rows = _rows_of_run(track, record)
    if rows is None or not np.any(track.found[rows]):
        return {}
    pitch = record.pixel_pitch or 1.0
    x, y = pitch * track.x_px[rows], pitch * track.y_px[rows]
    if _moves_with_mass(np.stack([x, y], axis=1), record.displacement.x):
        return {}
    return {f"the {name}, right": x - np.nanmean(x), f"the {name}, up": -(y - np.nanmean(y))}


def _rows_of_run(track: Track, record: Run) -> NDArray[np.int64] | None:
    """Return the rows of a track that are the frames of a run; None if their times differ."""
    t = record.displacement.t
    if len(track) == len(t):
        return np.arange(len(t))
    rows = np.searchsorted(track.t, t - TIME_TOLERANCE_S).clip(0, len(track) - 1)
    return rows if np.allclose(track.t[rows], t, rtol=0, atol=TIME_TOLERANCE_S) else None


def _moves_with_mass(place: Array, x: Array) -> bool:
    """Return whether a target at positions (n, 2) moves with the mass, whose displacement is x (n,)."""
    known = np.isfinite(x) & np.all(np.isfinite(place), axis=1)
    if np.count_nonzero(known) < MIN_FRAMES:
        return False
    moved, own = place[known] - place[known].mean(axis=0), x[known] - x[known].mean()
    gain = own @ moved / max(float(own @ own), 1e-300)  # (2,) least squares
    other = moved - own[:, None] * gain
    return bool(np.linalg.norm(gain) > MIN_GAIN and np.sum(other**2) < MAX_OTHER_MOTION * np.sum(moved**2))
