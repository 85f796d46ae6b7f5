"""Eddy-current brake: a magnet near a moving conductor brakes most at one speed, and less beyond it."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import bend_velocities


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """Return v/(1 + (v/v_0)^2), shape (n, 1): N per N s/m of c."""
    return np.asarray((path.v / (1 + (path.v / nonlinear["v_0"]) ** 2))[:, None])


equation = "c v/(1 + (v/v_0)^2)"
parameters = (
    Parameter("c", "N s/m", (0.0, np.inf), linear=True, passive=True),
    Parameter("v_0", "m/s", (1e-9, np.inf), scan=bend_velocities),
)
varies_with = "v"
special_cases = {"viscous": {"v_0": np.inf}}
what = "A magnet moves past a conductor: eddy currents brake it, and push its field out at high speed."
looks_like = "a force against v that rises to a maximum and falls again, whatever the load"
mistaken_for = "viscous friction (well below the maximum), a hydrodynamic hump (with one load), power-law viscosity"
confirm = "Take the magnet away, or film it with an insulator in place of the conductor."
describe = Phrase("at most {c * v_0 / 2} N, at {v_0} m/s")
invariant = "an eddy-current brake depends on the speed and not on the load"
settled_by = "take the magnet away"
source = "Wouterse 1991, IEE Proc. B 138, 153; Smythe 1942"
