"""Drive error: the force that drives the mass is not the one that was measured."""

from __future__ import annotations

import numpy as np

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path, Span
from frictrack.records import Array

LONGEST = 0.02  # s by which an amplifier, a valve or a wrong clock may be late
MAX_ERROR = 0.5  # of the drive: more is another drive


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """-D(t - tau), shape (n, 1): N per unit of e; e > 0 means that the true drive is larger."""
    t = path.t - nonlinear["tau"]
    if path.drive_at is not None:
        return -path.drive_at(t)[:, None]
    assert path.drive is not None
    return -np.interp(t, path.t, path.drive)[:, None]


def delays(span: Span) -> Array:
    """Delays worth trying, s, early as well as late."""
    most = min(LONGEST, span.duration / 8)
    return np.linspace(-most, most, 17)


def modest(own: Nonlinear, span: Span) -> str:
    """Objection to a drive that would be wrong by half."""
    error = abs(own["e"])
    return "" if error <= MAX_ERROR else f"the drive would be {100 * error:.0f} % wrong"


drive_error = Effect(
    name="drive_error",
    acts_on="force",
    equation="-e D(t - tau)",
    parameters=(
        Parameter("e", "1", linear=True),
        Parameter("tau", "s", scan=delays, signed=True),
    ),
    columns=columns,
    scales_with="drive",
    what="Gain of the force sensor, area of the piston or constant of the motor are off, or the drive comes late.",
    looks_like="a residual force of the shape of the drive, in every run, whatever the speed",
    mistaken_for="a wrong mass (at tau = 0; exactly so where the mass is fitted); Coulomb friction (steady drive)",
    confirm="Hang a known weight on the drive; drive with another shape: this residual follows it, friction does not.",
    plausible=modest,
    source="Janot, Gautier & Brunot 2019 (EMPS: gain and offset of the drive)",
    needs=("drive",),
)
