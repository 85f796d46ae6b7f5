"""One row per run of what `track`, `motion` and `friction` came to: their JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from frictrack.flow.stages import RunWork, sheet
from frictrack.records import Displacement, Friction, Motion, Track
from frictrack.results import plain


def summary(works: list[RunWork], stage: str) -> list[dict[str, Any]]:
    """The rows of all runs, after they were brought up to the stage; a table has no track and no row there."""
    describe = {"track": _track, "motion": _motion, "friction": _friction}[stage]
    rows = []
    for work in works:
        if stage in work.stages:
            notes = getattr(work.get("track" if stage == "track" else "displacement"), "notes", ())
            rows.append({"run": work.run.name, **describe(work), "notes": list(notes)})
    made: list[dict[str, Any]] = plain(rows)
    return made


def _track(work: RunWork) -> dict[str, Any]:
    from frictrack.tracking import target_line  # noqa: PLC0415 - loads OpenCV; tables do without

    track: Track = work.get("track")
    found = track.found
    return {
        "frames": len(track),
        "found": int(np.sum(found)),
        "travel_px": float(np.ptp(track.x_px[found])) if np.any(found) else None,
        "sigma_px": float(np.median(track.sigma_px[found])) if np.any(found) else None,
        "score": float(np.median(track.score[found])) if np.any(found) else None,
        "target": target_line(track),
        "contact_sheet": str(sheet(work)),
    }


def _motion(work: RunWork) -> dict[str, Any]:
    motion: Motion = work.get("motion")
    displacement: Displacement = work.get("displacement")
    return {
        "frames": len(motion),
        "cutoff_Hz": motion.cutoff,
        "noise_um": 1e6 * float(np.nanmedian(displacement.sigma_x)),
        "sigma_x_um": 1e6 * float(np.median(motion.sigma_x)),
        "v_max": float(motion.v[np.argmax(np.abs(motion.v))]),
        "sigma_v": float(np.median(motion.sigma_v)),
        "sigma_a": float(np.median(motion.sigma_a)),
    }


def _friction(work: RunWork) -> dict[str, Any]:
    friction: Friction = work.get("friction")
    motion: Motion = work.get("motion")
    free = friction.free
    judged = friction.t[free]
    resisting = friction.F * np.sign(motion.v)
    return {
        "free_from_s": float(judged[0]) if len(judged) else None,
        "free_to_s": float(judged[-1]) if len(judged) else None,
        "mean_F_N": float(np.mean(resisting[free])) if len(judged) else None,
        "sigma_F_N": float(np.median(friction.sigma_F[free])) if len(judged) else None,
        "reason": friction.reason,
    }
