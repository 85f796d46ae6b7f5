"""What else was seen of the runs: further targets of a film, and the accelerometer, at the frames of the mass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictrack.flow.stages import RunWork
from frictrack.records import Array, Run, Track


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
            found |= _of_target(name, track, record)
        felt = work.get("sensors").a
        if felt is not None and len(felt) == len(record.displacement):
            found["accelerometer"] = felt
        out[work.run.name] = found
    return out


def _of_target(name: str, track: Track, record: Run) -> dict[str, Array]:
    """Both directions of a target's picture, m (px where no scale is known)."""
    if len(track) != len(record.displacement) or not np.any(track.found):
        return {}
    pitch = record.pixel_pitch or 1.0
    return {
        f"the {name}, right": pitch * (track.x_px - np.nanmean(track.x_px)),
        f"the {name}, up": -pitch * (track.y_px - np.nanmean(track.y_px)),
    }
