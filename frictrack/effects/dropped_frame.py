"""A dropped frame: the recording has a frame too few or too many, and its clock does not know."""

from __future__ import annotations

import numpy as np

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path, Span
from frictrack.effects.plausibility import WHOLE_FRAME
from frictrack.records import Array

MOST = 2000  # moments tried in one run


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """V dt from `time` on, shape (n, 1): m per frame that is missing; it comes in over one frame interval dt."""
    dt = float(np.median(np.diff(path.t)))
    after: Array = np.clip((path.t - nonlinear["time"]) / dt + 0.5, 0.0, 1.0)
    return np.asarray((path.v * dt * after)[:, None])


def times(span: Span) -> Array:
    """Moments worth trying, s since release: between any two frames, not too near to either end."""
    n = round(span.duration * span.fps)
    between: Array = np.arange(3.5, max(n - 3, 5))
    return between[:: max(1, len(between) // MOST)] / span.fps


def whole(own: Nonlinear, span: Span) -> str:
    """Objection to a part of a frame: a camera loses or doubles whole ones."""
    frames = abs(own["frames"])
    if round(frames) >= 1 and abs(frames - round(frames)) <= WHOLE_FRAME:
        return ""
    return f"{own['frames']:.2f} frames are lost, expected a whole number"


dropped_frame = Effect(
    name="dropped_frame",
    acts_on="measurement",
    equation="y: frames v dt from time on",
    parameters=(
        Parameter("frames", "1", linear=True, per_run=True),
        Parameter("time", "s", per_run=True, scan=times, signed=True),
    ),
    columns=columns,
    what="The camera or the computer lost a frame (frames > 0) or stored one twice (frames < 0).",
    looks_like="a jump in displacement of as far as the mass goes in one frame, the velocity before and after the same",
    mistaken_for="a collision (a step in velocity, no jump)",
    confirm="Look at the time stamps and at the frames round that moment: one is missing, or two are alike.",
    plausible=whole,
    source="textbook; y(t) = x(t + frames dt) after the loss",
)
