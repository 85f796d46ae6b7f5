"""Rolling shutter: the camera reads its picture line by line, so that places are seen at different times."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase, TestDraw
from frictrack.effects.ranges import Span

MAX_FPS = 1000.0  # Hz: faster cameras expose all lines at once


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """V x, shape (n, 1): m per s/m of tau; a place is seen tau x later than the place 0."""
    return np.asarray((path.v * path.x)[:, None])


def plausible(values: Nonlinear, span: Span) -> str:
    """Return an objection to a camera with a global shutter, and to a readout that takes longer than a frame."""
    if span.fps > MAX_FPS:
        return f"cameras of more than {MAX_FPS:g} frames per second expose all lines at once"
    frames = abs(values["tau"]) * (span.x_max - span.x_min) * span.fps
    if frames <= 1.0:
        return ""
    return f"the camera would read the course for {frames:.2g} frames, expected at most one frame"


acts_on = "measurement"
equation = "y: tau v x"
parameters = (Parameter("tau", "s/m", linear=True, role="amplitude"),)
varies_with = "xv"
of_camera = True
what = "The lines of the picture are read one after the other, along the course: far places are seen later."
looks_like = "a false deceleration that grows with the speed and hardly depends on the mass, in either direction"
mistaken_for = "time base, viscous friction (where all runs have one mass)"
confirm = "Turn the camera by 90 degrees about its axis, so that its lines lie along the course, and film again."
describe = Phrase("{1e5 * abs(tau)} us to read 0.1 m of the course")
invariant = "the readout time belongs to the camera, whatever the speed and the mass"
settled_by = "turn the camera by 90 degrees, so that its lines lie along the course"
test_draw = TestDraw(max_fps=MAX_FPS)
source = "textbook: y(t) = x(t + tau x); Ait-Aider et al. 2006 (rolling-shutter geometry)"
