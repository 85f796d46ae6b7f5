"""One row per run of what `track`, `motion` and `friction` came to: their JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.flow.duplicate_runs import find_duplicate_runs
from frictrack.flow.film_stages import contact_sheet_path, overlay_path
from frictrack.flow.pipeline import RunPipeline
from frictrack.flow.run_budget import run_budget
from frictrack.flow.sensor_stage import sensor_summary
from frictrack.flow.track_quality import track_quality
from frictrack.records import CutoffTradeOff, Displacement, Friction, Motion, RunEvents
from frictrack.results import to_builtins


def run_summaries(pipelines: list[RunPipeline], stage: str) -> list[dict[str, Any]]:
    """The rows of all runs, after they were brought up to the stage; a table has no track and no row there."""
    describe = {"track": _track_summary, "motion": _motion_summary, "friction": _friction_summary}[stage]
    made: list[dict[str, Any]] = to_builtins(
        [{"run": pipeline.run.name, **describe(pipeline)} for pipeline in pipelines if stage in pipeline.stages]
    )
    if stage == "track":  # what cannot be calibrated has no displacement to compare
        return made
    twice = find_duplicate_runs(pipelines)
    return [{**row, "notes": [*row["notes"], *filter(None, [twice.get(row["run"])])]} for row in made]


def _track_summary(pipeline: RunPipeline) -> dict[str, Any]:
    from frictrack.tracking import target_line  # noqa: PLC0415 - loads OpenCV; tables do without

    displacement, notes = _displacement_and_notes(pipeline)
    pitch = displacement.pixel_pitch if displacement else None
    track = pipeline.get("track")
    return {
        **track_quality(pipeline.get("recording"), track, pipeline.get("tracks"), pitch),
        "target": target_line(track),
        "contact_sheet": str(contact_sheet_path(pipeline.study, pipeline.run.name)),
        "overlay": str(overlay_path(pipeline)) if overlay_path(pipeline).exists() else None,
        "notes": notes,
    }


def _displacement_and_notes(pipeline: RunPipeline) -> tuple[Displacement | None, list[str]]:
    """What was found on the way to metres; a track is shown even where it cannot be calibrated."""
    try:
        displacement: Displacement = pipeline.get("displacement")
    except FrictrackError as e:
        return None, [*pipeline.get("track").notes, f"not calibrated: {e}"]
    return displacement, list(displacement.notes)


def _motion_summary(pipeline: RunPipeline) -> dict[str, Any]:
    motion: Motion = pipeline.get("motion")
    displacement: Displacement = pipeline.get("displacement")
    return {
        "frames": len(motion),
        "cutoff_Hz": motion.cutoff,
        "noise_um": 1e6 * float(np.nanmedian(displacement.sigma_x)),
        "sigma_x_um": 1e6 * float(np.median(motion.sigma_x)),
        "v_max": float(motion.v[np.argmax(np.abs(motion.v))]),
        "sigma_v": float(np.median(motion.sigma_v)),
        "sigma_a": float(np.median(motion.sigma_a)),
        "smoothing": pipeline.get("filtered").reason,
        "lines_Hz": list(motion.lines),
        "guard_frames": motion.guard,
        "cutoff": _cutoff_summary(pipeline),
        **_events_summary(pipeline),
        **_sensor_notes(pipeline),
    }


def _cutoff_summary(pipeline: RunPipeline) -> dict[str, Any]:
    """What a plain low-pass would cost, in newtons where the mass is known, and what lies above its cut-off."""
    found: CutoffTradeOff = pipeline.get("cutoff")
    mass = pipeline.run.mass[0] if isinstance(pipeline.run.mass, tuple) else None
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


def _events_summary(pipeline: RunPipeline) -> dict[str, Any]:
    """Release, impacts, stops, starts, reversals; and the noise that a resting mass shows."""
    found: RunEvents = pipeline.get("events")
    noise = found.noise_at_rest
    return {
        "events": [{"kind": kind, "from_s": begins, "to_s": ends} for kind, begins, ends in found.events],
        "noise_at_rest_um": 1e6 * noise if np.isfinite(noise) else None,
    }


def _friction_summary(pipeline: RunPipeline) -> dict[str, Any]:
    friction: Friction = pipeline.get("friction")
    motion: Motion = pipeline.get("motion")
    free = friction.free
    judged = friction.t[free]
    resisting = friction.F * np.sign(motion.v)
    return {
        "free_from_s": float(judged[0]) if len(judged) else None,
        "free_to_s": float(judged[-1]) if len(judged) else None,
        "mean_F_N": float(np.mean(resisting[free])) if len(judged) else None,
        "sigma_F_N": float(np.median(friction.sigma_F[free])) if len(judged) else None,
        "reason": friction.reason,
        **_budget_summary(pipeline),
        **_sensor_notes(pipeline),
    }


def _budget_summary(pipeline: RunPipeline) -> dict[str, Any]:
    """Where the error of the friction force comes from, the total last, and what would make it smaller."""
    found = run_budget(pipeline)
    return {"budget": found["rows"], "budget_says": found["says"]} if found else {}


def _sensor_notes(pipeline: RunPipeline) -> dict[str, Any]:
    """What sensors and the blow say of the run, and all findings in words; no keys where there is nothing."""
    rows = sensor_summary(pipeline)
    notes = [*pipeline.get("displacement").notes, *rows.pop("notes")]
    return {key: row for key, row in rows.items() if row} | {"notes": notes}
