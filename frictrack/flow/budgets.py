"""What is known of one run beside its motion, brought together for the error budget."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from frictrack.budget import budget
from frictrack.flow.films import REFERENCE, least_shake
from frictrack.flow.quality import left_of_shake, quality
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
    left = left_of_shake(work.get("tracks").get(REFERENCE), least_shake(work.run))
    return {} if left is None else dict(zip(("shake_Hz", "shake_left_px", "shake_left_told"), left, strict=True))
