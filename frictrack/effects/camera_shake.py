"""Camera shake: the camera moves, the mass does not."""

from __future__ import annotations

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path, frequencies, wave
from frictrack.effects.plausibility import all_of, oscillates, within_picture
from frictrack.records import Array


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """sin(2 pi f t + phase), shape (n, 1): m per m of amplitude."""
    return wave(nonlinear["frequency"] * path.t, nonlinear["phase"])


camera_shake = Effect(
    name="camera_shake",
    acts_on="measurement",
    equation="y: amplitude sin(2 pi frequency t + phase)",
    parameters=(
        Parameter("amplitude", "m", linear=True, role="amplitude"),
        Parameter("frequency", "Hz", scan=frequencies),
        Parameter("phase", "rad", per_run=True, role="phase"),
    ),
    columns=columns,
    what="The camera or its stand vibrates.",
    looks_like="a line in time of the same size in x whatever the mass; the background moves too",
    mistaken_for="vibration of the course (same shape in one run)",
    confirm="Track a fixed mark in the same film and give it as `reference`.",
    plausible=all_of(oscillates, within_picture(lambda own, span: own["amplitude"])),
    source="textbook",
)
