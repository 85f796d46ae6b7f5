"""Load modulation: the normal load, and with it dry friction, oscillates (contact vibrating vertically)."""

from __future__ import annotations

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path, frequencies, wave
from frictrack.effects.plausibility import all_of, modulates, oscillates
from frictrack.records import Array


def columns(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """Dry-friction columns times 1 + depth sin(2 pi f t + phase), same shape as `inner`."""
    return inner * (1 + nonlinear["depth"] * wave(nonlinear["frequency"] * path.t, nonlinear["phase"]))


load_modulation = Effect(
    name="load_modulation",
    acts_on="force",
    equation="(coulomb + stribeck) depth sin(2 pi frequency t + phase)",
    parameters=(
        Parameter("depth", "1", (-1.0, 1.0), role="depth"),
        Parameter("frequency", "Hz", scan=frequencies),
        Parameter("phase", "rad", per_run=True, role="phase"),
    ),
    columns=columns,
    modifies=frozenset({"coulomb", "stribeck"}),
    scales_with="load",
    what="The beam vibrates vertically: the mass is pressed on harder and lighter in turn.",
    looks_like="a line in time whose size follows the dry friction",
    mistaken_for="vibration (same shape when the dry friction is constant)",
    confirm="Double the mass: the force doubles with the load, a vibration's stays.",
    plausible=all_of(oscillates, modulates),
    source="Teidelt et al.; the physical form of the first paper's ATM2",
)
