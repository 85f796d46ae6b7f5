"""Aerodynamic drag: proportional to the square of velocity."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase, TestDraw


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """V |v|, shape (n, 1): N per N s^2/m^2 of c = rho C_d A / 2."""
    return (path.v * np.abs(path.v))[:, None]


equation = "c v |v|"
parameters = (Parameter("c", "N s^2/m^2", linear=True, passive=True),)
varies_with = "v"
what = "Air pushed aside by the moving mass."
looks_like = "a curve against v that bends upward at the fast end"
mistaken_for = "viscous friction, wear along the path"
confirm = "Film at twice the speed, or change the frontal area with a card."
describe = Phrase("{c} N at 1 m/s, four times that at 2 m/s")
invariant = "drag is proportional to the square of the speed"
in_base_law = True
basic = True
test_draw = TestDraw(positive=True)
source = "textbook: F = rho C_d A v^2 / 2"
