"""Vibration of the beam or course: a sine force in time (the papers' sine terms of ATM1)."""

import numpy as np

from frictrack.base.number_format import format_length, format_number
from frictrack.effects.definition import EffectInStudy, Parameter, oscillation
from frictrack.effects.path import Array, Nonlinear, Path, ScanWave, over_time, wave
from frictrack.effects.ranges import frequencies, oscillates


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """sin(2 pi f t + phase), shape (n, 1): N per N of amplitude."""
    return wave(nonlinear["frequency"] * path.t, nonlinear["phase"])


def describe(effect: EffectInStudy) -> str:
    """Frequency, force, and the motion of the mass that goes with it."""
    force = effect.value("amplitude")
    moved = force / (effect.mass * (2 * np.pi * effect.value("frequency")) ** 2)
    return (
        f"{oscillation(effect)}; ± {format_number(abs(force))} N, which moves the mass by ± {format_length(abs(moved))}"
    )


equation = "amplitude sin(2 pi frequency t + phase)"
parameters = (
    Parameter("amplitude", "N", linear=True, role="amplitude"),
    Parameter("frequency", "Hz", scan=frequencies),
    Parameter("phase", "rad", per_run=True, role="phase"),
)
scan_wave = ScanWave("frequency", over_time)
varies_with = ""
what = "The beam or course vibrates and pushes the mass to and fro at a fixed frequency."
looks_like = "a line at the same frequency in every run, whatever the speed"
mistaken_for = "camera shake (same shape in one run), load modulation, texture at one speed"
confirm = "Film a mark on the frame at rest: if it moves too, the camera shakes. Double the mass: the motion halves."
plausible = oscillates
invariant = "a vibration keeps its frequency in time and its size in newtons"
basic = True
source = "first paper, Eq. 3; second paper, Eq. 2"
