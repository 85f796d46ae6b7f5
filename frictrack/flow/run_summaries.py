"""Summarise each run after `track`, `motion` or `friction`: one row of their JSON, with its error budget."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.flow.film_stages import BACKWARD, REFERENCE, contact_sheet_path, min_shake_px, overlay_path
from frictrack.flow.pipeline import RunPipeline
from frictrack.flow.plausibility_checks import find_duplicate_runs
from frictrack.flow.sensor_stage import sensor_summary
from frictrack.flow.summaries import CutoffSummary, Events
from frictrack.flow.track_quality import residual_shake, track_quality
from frictrack.measure.error_budget import budget
from frictrack.records import CutoffTradeOff, Displacement, Friction, Motion, RunEvents
from frictrack.results import to_builtins

if TYPE_CHECKING:
    from frictrack.flow.pipeline import RunPipeline


def run_budget(pipeline: RunPipeline, known: dict[str, Any] | None = None) -> dict[str, Any]:
    """Compute the error budget of the friction force of one run."""
    run = pipeline.to_run()
    if run.mass is None and run.friction_N is None:
        return {}
    film = pipeline.get("recording") if pipeline.run.video else None
    if film is not None:
        known = (known or film_quality(pipeline)) | _residual_shake(pipeline)
    found = budget(run, pipeline.get("filtered"), known, film, pipeline.get("sensors").clocks)
    made: dict[str, Any] = to_builtins(found.summary())
    return made


def film_quality(pipeline: RunPipeline) -> dict[str, Any]:
    """Return `track_quality` of a film as JSON; empty for a table of positions."""
    if not pipeline.run.video:
        return {}
    pitch = pipeline.get("displacement").pixel_pitch
    found = track_quality(pipeline.get("recording"), pipeline.final_track, pipeline.get("tracks"), pitch)
    return dict(to_builtins(found))


def _residual_shake(pipeline: RunPipeline) -> dict[str, Any]:
    """Return the camera shake that may be left in the displacement, px rms along x."""
    left = residual_shake(pipeline.get("tracks").get(REFERENCE), min_shake_px(pipeline.run))
    return {} if left is None else dict(zip(("shake_Hz", "shake_left_px", "shake_left_told"), left, strict=True))


def run_summaries(pipelines: list[RunPipeline], stage: str) -> list[dict[str, Any]]:
    """Return the rows of all runs for one stage.

    Parameters
    ----------
    pipelines
        The runs, brought up to date up to the stage.
    stage
        ``"track"``, ``"motion"`` or ``"friction"``.

    Returns
    -------
    list of dict
        One row per run, as JSON; a table of positions has no row for ``"track"``.

    """
    describe = {"track": _track_summary, "motion": _motion_summary, "friction": _friction_summary}[stage]
    made: list[dict[str, Any]] = to_builtins(
        [{"run": pipeline.run.name, **describe(pipeline)} for pipeline in pipelines if stage in pipeline.stages]
    )
    if stage == "track":  # a track that cannot be calibrated has no displacement to compare
        return made
    twice = find_duplicate_runs(pipelines)
    return [{**row, "notes": [*row["notes"], *filter(None, [twice.get(row["run"])])]} for row in made]


def _track_summary(pipeline: RunPipeline) -> dict[str, Any]:
    """Describe how well a film was measured, and where its pictures are."""
    from frictrack.measure.repairing import suspect_spans  # noqa: PLC0415 - loads OpenCV; tables do without
    from frictrack.tracking import target_line  # noqa: PLC0415

    displacement, notes = _displacement_and_notes(pipeline)
    pitch = displacement.pixel_pitch if displacement else None
    track, tracks = pipeline.final_track, pipeline.get("tracks")
    return {
        **track_quality(pipeline.get("recording"), track, tracks, pitch),
        "suspects": [vars(span) for span in suspect_spans(track, tracks.get(BACKWARD))],
        "target": target_line(track),
        "contact_sheet": str(contact_sheet_path(pipeline.study, pipeline.run.name)),
        "overlay": str(overlay_path(pipeline)) if overlay_path(pipeline).exists() else None,
        "notes": notes,
    }


def _displacement_and_notes(pipeline: RunPipeline) -> tuple[Displacement | None, list[str]]:
    """Return the displacement and its notes; a track that cannot be calibrated is described without displacement."""
    try:
        displacement: Displacement = pipeline.get("displacement")
    except FrictrackError as e:
        return None, [*pipeline.final_track.notes, f"not calibrated: {e}"]
    return displacement, list(displacement.notes)


def _motion_summary(pipeline: RunPipeline) -> dict[str, Any]:
    """Describe the motion: noise, cut-off, largest speed, vibrations, events."""
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
        "cutoff": _cutoff_summary(pipeline) if "cutoff" in pipeline.stages else None,
        **_events_summary(pipeline),
        **_sensor_notes(pipeline),
    }


def _cutoff_summary(pipeline: RunPipeline) -> CutoffSummary:
    """Describe what a plain low-pass would cost, in N if the mass is known, else in m/s^2."""
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


def _events_summary(pipeline: RunPipeline) -> Events:
    """List release, impacts, stops, starts and reversals, and the noise while the mass rests."""
    found: RunEvents = pipeline.get("events")
    noise = found.noise_at_rest
    return {
        "events": [{"kind": kind, "from_s": begins, "to_s": ends} for kind, begins, ends in found.events],
        "noise_at_rest_um": 1e6 * noise if np.isfinite(noise) else None,
    }


def _friction_summary(pipeline: RunPipeline) -> dict[str, Any]:
    """Describe the friction force and the free section."""
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
    """Return the error budget of the friction force, the total last, and what would make it smaller."""
    found = run_budget(pipeline)
    return {"budget": found["rows"], "budget_says": found["says"]} if found else {}


def _sensor_notes(pipeline: RunPipeline) -> dict[str, Any]:
    """Return the summaries of sensors and impact, and all notes; empty summaries are left out."""
    rows: dict[str, Any] = {**sensor_summary(pipeline)}
    notes = [*pipeline.get("displacement").notes, *rows.pop("notes")]
    return {key: row for key, row in rows.items() if row} | {"notes": notes}
