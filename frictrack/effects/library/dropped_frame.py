"""A dropped frame: the recording has a frame too few or too many, and its clock does not know."""

import numpy as np

from frictrack.effects.definition import Array, DirectCheck, EffectInStudy, Nonlinear, Parameter, Path, Phrase, TestDraw
from frictrack.effects.ranges import FLASH_STD_FRAMES, WHOLE_FRAME, Span

MAX_MOMENTS = 2000  # moments tried in one run


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """V dt from `time` on, shape (n, 1): m per frame that is missing; it comes in over one frame interval dt."""
    dt = float(np.median(np.diff(path.t[: path.starts[1] if len(path.starts) > 1 else None])))
    after: Array = np.clip((path.t - nonlinear["time"]) / dt + 0.5, 0.0, 1.0)
    return np.asarray((path.v * dt * after)[:, None])


def times(span: Span) -> Array:
    """Moments worth trying, s since release: between any two frames, not too near to either end."""
    n = round(span.duration * span.fps)
    between: Array = np.arange(3.5, max(n - 3, 5))
    return between[:: max(1, len(between) // MAX_MOMENTS)] / span.fps


def plausible(values: Nonlinear, span: Span) -> str:
    """Return an objection to a part of a frame: a camera loses or doubles whole ones."""
    frames = abs(values["frames"])
    if round(frames) >= 1 and abs(frames - round(frames)) <= WHOLE_FRAME:
        return ""
    return f"{values['frames']:.2f} frames are lost, expected a whole number"


def time_stamp_signal(effect: EffectInStudy) -> float:
    """Return chi-squared of the jump of time stamps that would be recorded with every frame."""
    return (effect.rms("frames") / FLASH_STD_FRAMES) ** 2


def one_frame(momentum: float) -> float:
    """Return the size for which a plan is made: one frame, at any momentum."""
    return 1.0


acts_on = "measurement"
equation = "y: frames v dt from time on"
parameters = (
    Parameter("frames", "1", linear=True, per_run=True),
    Parameter("time", "s", per_run=True, scan=times, signed=True),
)
what = "The camera or the computer lost a frame (frames > 0) or stored one twice (frames < 0)."
looks_like = "a jump in displacement of as far as the mass goes in one frame, the velocity before and after the same"
mistaken_for = "a collision (a step in velocity, no jump)"
confirm = "Look at the time stamps and at the frames round that moment: one is missing, or two are alike."
describe = Phrase("in run {study.run} {1e3 * time} ms after release, {frames:2} frames")
invariant = "a lost frame shifts the picture by the way of the mass in one frame"
direct_check = DirectCheck("time stamps", "Keep the camera's time stamps, or film a running counter", time_stamp_signal)
film_fault = True
noted_as = ("found from the motion", "repeats the one before", "repeat the one before")
planned_size = one_frame
test_draw = TestDraw(own_size=True, between_frames="time")
source = "textbook; y(t) = x(t + frames dt) after the loss"
