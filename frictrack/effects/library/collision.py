"""Collision: a short blow that takes (or gives) momentum at one moment of a run."""

import numpy as np

from frictrack.effects.definition import Array, Mask, Nonlinear, Parameter, Path, Phrase, TestDraw
from frictrack.effects.ranges import N_STD_ACTIVE, PLANNED_SHARE, Span

MAX_SHARE, MAX_FRAMES = 0.02, 8.0  # of a record, and frames: the standard deviation of a blow at most


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """Pulse of unit area at `time`, standard deviation `width`, shape (n, 1): N per N s of J."""
    z = (path.t - nonlinear["time"]) / nonlinear["width"]
    return (np.exp(-(z**2) / 2) / (np.sqrt(2 * np.pi) * nonlinear["width"]))[:, None]


def times(span: Span) -> Array:
    """Moments worth trying, s since release."""
    edge = 8.0 / span.fps  # closer to either end a blow is only another start or end speed
    return np.linspace(edge, max(span.duration - edge, 2 * edge), 121)


def widths(span: Span) -> Array:
    """Durations worth trying, s: below a few frames the film cannot tell them apart."""
    return np.array([1.0, 3.0]) / span.fps


def plausible(values: Nonlinear, span: Span) -> str:
    """Return an objection to a blow that lasts: then it is a force of time, and no impact."""
    longest = max(MAX_SHARE * span.duration, MAX_FRAMES / span.fps)
    if values["width"] <= longest:
        return ""
    return f"it would last {values['width']:.2g} s, expected at most {longest:.2g} s of a blow"


def acts_within(t: Array, x: Array, values: Nonlinear, half_width: float) -> Mask:
    """Return the frames within two standard deviations of the blow, and the half width of a low-pass, (n,)."""
    return np.asarray(np.abs(t - values["time"]) <= N_STD_ACTIVE * values["width"] + half_width)


def planned_impulse(momentum: float) -> float:
    """Return the impulse for which a plan is made, N s."""
    return PLANNED_SHARE * momentum


equation = "J exp(-((t - time)/width)^2/2)/(width sqrt(2 pi))"
parameters = (
    Parameter("J", "N s", linear=True, per_run=True),
    Parameter("time", "s", per_run=True, scan=times, signed=True),
    Parameter("width", "s", scan=widths),
)
varies_with = ""
what = "The mass strikes a joint, an edge or the course itself."
looks_like = "a kink in displacement, a step in velocity, a spike in force"
mistaken_for = "a dropped frame (a jump in x), a narrow patch (if at the same place in every run)"
confirm = "Look at the frames round that moment; change the speed: a joint stays at its place."
fine = 3
describe = Phrase(
    "in run {study.run} {1e3 * time} ms after release, of {abs(J)} N s: {abs(J) / study.mass:2} m/s at once"
)
invariant = "a blow comes at a moment of its own"
planned_size = planned_impulse
test_draw = TestDraw(impulse=True)
source = "Hunt & Crossley 1975 for the shape inside; second paper for the cause"
