"""Vibration of the beam or course: a sine force in time (the papers' sine terms of ATM1)."""

from frictrack.effects.definition import OSCILLATION, Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import WAVE_IN_TIME, frequencies, oscillates, wave


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """sin(2 pi f t + phase), shape (n, 1): N per N of amplitude."""
    return wave(nonlinear["frequency"] * path.t, nonlinear["phase"])


equation = "amplitude sin(2 pi frequency t + phase)"
parameters = (
    Parameter("amplitude", "N", linear=True, role="amplitude"),
    Parameter("frequency", "Hz", scan=frequencies),
    Parameter("phase", "rad", per_run=True, role="phase"),
)
scan_wave = WAVE_IN_TIME
varies_with = ""
what = "The beam or course vibrates and pushes the mass to and fro at a fixed frequency."
looks_like = "a line at the same frequency in every run, whatever the speed"
mistaken_for = "camera shake (same shape in one run), load modulation, texture at one speed"
confirm = "Film a mark on the frame at rest: if it moves too, the camera shakes. Double the mass: the motion halves."
plausible = oscillates
describe = Phrase(
    OSCILLATION + "; ± {abs(amplitude)} N, which moves the mass by "
    "± {abs(amplitude) / (study.mass * (2 * pi * frequency) ** 2):m}"
)
invariant = "a vibration keeps its frequency in time and its size in newtons"
basic = True
source = "first paper, Eq. 3; second paper, Eq. 2"
