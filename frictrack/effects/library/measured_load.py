"""Measured load: dry friction follows the normal load that the mass's own vertical motion tells."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, TestDraw


def columns(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """Dry-friction columns times N over its level at rest, 1 + coefficient y''/g, never below zero; as `inner`."""
    assert path.lift is not None
    pressed = 1 + nonlinear["coefficient"] * (path.lift / path.gravity)[:, None]
    return np.asarray(inner * np.maximum(pressed, 0.0))


equation = "(coulomb + stribeck) N/(m g), N = m (g + coefficient y'') >= 0"
parameters = (Parameter("coefficient", "1", (0.0, 2.0), role="depth"),)
varies_with = ""
modifies = frozenset({"coulomb", "stribeck"})
scales_with = "load"
what = "The mass hops or is carried up and down; it is pressed on by what its vertical motion tells."
looks_like = "a residual that copies the vertical acceleration; none at all while contact is lost"
mistaken_for = "load modulation (when the course vibrates at one frequency), vibration"
confirm = "Fix the beam from below so that nothing moves vertically. A coefficient far from 1 is no measured load."
invariant = "the load follows the vertical motion"
test_draw = TestDraw(positive=True)
source = "N = m (g + y''); Teidelt et al."
needs = ("lift",)
