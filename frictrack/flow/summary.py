"""One row per run of what `track`, `motion` and `friction` came to: their JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.flow.beside import sensor_rows
from frictrack.flow.budgets import budgeted
from frictrack.flow.films import overlay, sheet
from frictrack.flow.quality import quality
from frictrack.flow.stages import RunWork, copied
from frictrack.records import Displacement, Friction, Happenings, Motion, Trade
from frictrack.results import plain


def summary(works: list[RunWork], stage: str) -> list[dict[str, Any]]:
    """The rows of all runs, after they were brought up to the stage; a table has no track and no row there."""
    describe = {"track": _track, "motion": _motion, "friction": _friction}[stage]
    made: list[dict[str, Any]] = plain(
        [{"run": work.run.name, **describe(work)} for work in works if stage in work.stages]
    )
    if stage == "track":  # what cannot be calibrated has no displacement to compare
        return made
    twice = copied(works)
    return [{**row, "notes": [*row["notes"], *filter(None, [twice.get(row["run"])])]} for row in made]


def _track(work: RunWork) -> dict[str, Any]:
    from frictrack.tracking import target_line  # noqa: PLC0415 - loads OpenCV; tables do without

    displacement, notes = _displacement(work)
    pitch = displacement.pixel_pitch if displacement else None
    track = work.get("track")
    return {
        **quality(work.get("recording"), track, work.get("tracks"), pitch),
        "target": target_line(track),
        "contact_sheet": str(sheet(work.study, work.run.name)),
        "overlay": str(overlay(work)) if overlay(work).exists() else None,
        "notes": notes,
    }


def _displacement(work: RunWork) -> tuple[Displacement | None, list[str]]:
    """What was found on the way to metres; a track is shown even where it cannot be calibrated."""
    try:
        displacement: Displacement = work.get("displacement")
    except FrictrackError as e:
        return None, [*work.get("track").notes, f"not calibrated: {e}"]
    return displacement, list(displacement.notes)


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
        "smoothing": work.get("filtered").reason,
        "lines_Hz": list(motion.lines),
        "guard_frames": motion.guard,
        "cutoff": _cutoff(work),
        **_events(work),
        **_beside(work),
    }


def _cutoff(work: RunWork) -> dict[str, Any]:
    """What a plain low-pass would cost, in newtons where the mass is known, and what lies above its cut-off."""
    found: Trade = work.get("cutoff")
    mass = work.run.mass[0] if isinstance(work.run.mass, tuple) else None
    unit, factor = ("m/s^2", 1.0) if mass is None else ("N", mass)
    noise, lost = found.at(found.chosen)
    return {
        "chosen_Hz": found.chosen,
        "least_Hz": found.least,
        "unit": unit,
        "noise": noise * factor,
        "lost": lost * factor,
        "followed_apart": found.structural * factor,
        "warnings": list(found.warnings),
    }


def _events(work: RunWork) -> dict[str, Any]:
    """Release, impacts, stops, starts, reversals; and the noise that a resting mass shows."""
    found: Happenings = work.get("events")
    noise = found.noise_at_rest
    return {
        "events": [{"kind": kind, "from_s": begins, "to_s": ends} for kind, begins, ends in found.events],
        "noise_at_rest_um": 1e6 * noise if np.isfinite(noise) else None,
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
        **_budget(work),
        **_beside(work),
    }


def _budget(work: RunWork) -> dict[str, Any]:
    """Where the error of the friction force comes from, the total last, and what would make it smaller."""
    found = budgeted(work)
    return {"budget": found["rows"], "budget_says": found["says"]} if found else {}


def _beside(work: RunWork) -> dict[str, Any]:
    """What sensors and the blow say of the run, and all findings in words; no keys where there is nothing."""
    rows = sensor_rows(work)
    notes = [*work.get("displacement").notes, *rows.pop("notes")]
    return {key: row for key, row in rows.items() if row} | {"notes": notes}
