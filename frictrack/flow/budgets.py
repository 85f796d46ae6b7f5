"""What is known of one run beside its motion, brought together for the error budget."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from frictrack.budget import budget
from frictrack.calibration import shake
from frictrack.flow.films import LEAST_SHAKE, REFERENCE
from frictrack.flow.quality import quality
from frictrack.records import Track
from frictrack.results import plain

if TYPE_CHECKING:
    from frictrack.flow.stages import RunWork


def budgeted(work: RunWork, known: dict[str, Any] | None = None) -> dict[str, Any]:
    """The error budget of a run as JSON, nothing for a run whose mass nobody knows.

    `known` is what the film says of its own measurement, where that is at hand.
    """
    run = work.record()
    if run.mass is None and run.friction_N is None:
        return {}
    film = work.get("recording") if work.run.video else None
    if film is not None:
        known = (known or _quality(work)) | _left(work)
    found = budget(run, work.get("filtered"), known, film, work.get("sensors").clocks)
    made: dict[str, Any] = plain(found.summary())
    return made


def _quality(work: RunWork) -> dict[str, Any]:
    pitch = work.get("displacement").pixel_pitch
    return quality(work.get("recording"), work.get("track"), work.get("tracks"), pitch)


def _left(work: RunWork) -> dict[str, Any]:
    """How much of a camera shake may still be in the displacement, px rms along x."""
    reference: Track | None = work.get("tracks").get(REFERENCE)
    if reference is None:
        return {}
    used = shake(reference, LEAST_SHAKE if work.run.reference == "auto" else 0.0)
    if used.seen:
        told = "error of the reference's movement, which was subtracted"
        return {"shake_left_px": float(used.sigma[0]), "shake_Hz": used.frequency, "shake_left_told": told}
    if used.left_in:
        told = "too small to be subtracted, left in"
        return {"shake_left_px": used.left_in, "shake_Hz": shake(reference).frequency, "shake_left_told": told}
    return {}
