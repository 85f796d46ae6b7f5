"""Vibration of the beam or course: a sine force in time (the papers' sine terms of ATM1)."""

from __future__ import annotations

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path, frequencies, wave
from frictrack.effects.plausibility import oscillates
from frictrack.records import Array


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """sin(2 pi f t + phase), shape (n, 1): N per N of amplitude."""
    return wave(nonlinear["frequency"] * path.t, nonlinear["phase"])


vibration = Effect(
    name="vibration",
    acts_on="force",
    equation="amplitude sin(2 pi frequency t + phase)",
    parameters=(
        Parameter("amplitude", "N", linear=True, role="amplitude"),
        Parameter("frequency", "Hz", scan=frequencies),
        Parameter("phase", "rad", per_run=True, role="phase"),
    ),
    columns=columns,
    what="The beam or course vibrates and pushes the mass to and fro at a fixed frequency.",
    looks_like="a line at the same frequency in every run, whatever the speed",
    mistaken_for="camera shake (same shape in one run), load modulation, texture at one speed",
    confirm="Film a mark on the frame at rest: if it moves too, the camera shakes. Double the mass: the motion halves.",
    plausible=oscillates,
    source="first paper, Eq. 3; second paper, Eq. 2",
)
