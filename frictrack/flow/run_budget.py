"""Compute the error budget of one run from its displacement, its film and its sensors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from frictrack.error_budget import budget
from frictrack.flow.film_stages import REFERENCE, min_shake_px
from frictrack.flow.track_quality import residual_shake, track_quality
from frictrack.results import to_builtins

if TYPE_CHECKING:
    from frictrack.flow.pipeline import RunPipeline


def run_budget(pipeline: RunPipeline, known: dict[str, Any] | None = None) -> dict[str, Any]:
    """Compute the error budget of the friction force of one run.

    Parameters
    ----------
    pipeline
        The stages of the run.
    known
        `track_quality` of the film, if it was computed already.

    Returns
    -------
    dict
        JSON of the budget; empty without a mass and without measured friction.

    """
    run = pipeline.to_run()
    if run.mass is None and run.friction_N is None:
        return {}
    film = pipeline.get("recording") if pipeline.run.video else None
    if film is not None:
        known = (known or _quality(pipeline)) | _residual_shake(pipeline)
    found = budget(run, pipeline.get("filtered"), known, film, pipeline.get("sensors").clocks)
    made: dict[str, Any] = to_builtins(found.summary())
    return made


def _quality(pipeline: RunPipeline) -> dict[str, Any]:
    pitch = pipeline.get("displacement").pixel_pitch
    return track_quality(pipeline.get("recording"), pipeline.final_track, pipeline.get("tracks"), pitch)


def _residual_shake(pipeline: RunPipeline) -> dict[str, Any]:
    """Return the camera shake that may be left in the displacement, px rms along x."""
    left = residual_shake(pipeline.get("tracks").get(REFERENCE), min_shake_px(pipeline.run))
    return {} if left is None else dict(zip(("shake_Hz", "shake_left_px", "shake_left_told"), left, strict=True))
