"""Decaying vibration: a blow at release sets the beam or course ringing, and the ringing dies away."""

from functools import partial

import numpy as np

from frictrack.effects.definition import OSCILLATION, Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import WAVE_IN_TIME, Span, all_of, frequencies, oscillates, rings, wave


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """exp(-t/tau) sin(2 pi f t + phase), shape (n, 1): N at release per N of amplitude."""
    fading = np.exp(-path.t / nonlinear["tau"])
    return np.asarray(fading[:, None] * wave(nonlinear["frequency"] * path.t, nonlinear["phase"]))


def decays(span: Span) -> Array:
    """Decay times worth trying, s: one longer than the run is a vibration that lasts."""
    return span.duration * np.array([1 / 16, 1 / 6, 1 / 2.25])


equation = "amplitude exp(-t/tau) sin(2 pi frequency t + phase)"
parameters = (
    Parameter("amplitude", "N", linear=True, role="amplitude"),
    Parameter("frequency", "Hz", scan=partial(frequencies, cells=0.5)),  # a line that dies away is a wide one
    Parameter("tau", "s", scan=decays),
    Parameter("phase", "rad", per_run=True, role="phase"),
)
scan_wave = WAVE_IN_TIME
varies_with = ""
special_cases = {"vibration": {"tau": np.inf}}
what = "The blow or push that starts the run sets the beam or course ringing; damping takes it away."
looks_like = "a line that is strong just after release and gone at the end of the run"
mistaken_for = (
    "vibration (when the damping is weak), elastic joint (when every run has one jolt), Stribeck effect "
    "(when it is gone within a period or two)"
)
confirm = "Release more gently, or wait before release: the ringing follows the blow, a driven vibration does not."
plausible = all_of(oscillates, rings)
describe = Phrase(OSCILLATION + ", down to a third after {1e3 * tau} ms")
invariant = "a ringing decays with the time since release, wherever the mass is"
source = "textbook: free vibration with damping"
