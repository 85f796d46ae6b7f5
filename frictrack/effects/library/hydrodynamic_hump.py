"""Hydrodynamic hump: a film that builds up with the speed resists most at one speed, then lifts the mass."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import bend_velocities


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """L s u exp(-u), u = |v|/v_s, shape (n, 1): N per N of F."""
    u = path.speed / nonlinear["v_s"]
    return np.asarray((path.load * path.s * u * np.exp(-u))[:, None])


equation = "F L s (|v|/v_s) exp(-|v|/v_s)"
parameters = (
    Parameter("F", "N", (0.0, np.inf), linear=True, loaded=True),
    Parameter("v_s", "m/s", (1e-9, np.inf), scan=bend_velocities),
)
varies_with = "v"
scales_with = "load"
what = "A film of grease is dragged into the contact, resists, and then carries the mass."
looks_like = "friction that rises to a maximum at one speed and falls beyond it, in proportion to the load"
mistaken_for = "eddy-current brake (with one load), log velocity, power-law viscosity (below the maximum)"
confirm = "Film runs at half, one and three times the speed of the maximum, and one with the double mass."
describe = Phrase("at most {F / exp(1)} N, at {v_s} m/s")
invariant = "the hump keeps its speed and grows with the load"
settled_by = "film runs over a decade of speed around the maximum"
source = "K. Mnich, friction identification of a rack and pinion (form of the law); after Stribeck 1902"
