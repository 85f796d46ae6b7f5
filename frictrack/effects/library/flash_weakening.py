"""Flash weakening: dry friction falls at high speed, because asperities heat up while they touch."""

from functools import partial

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import bend_velocities


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """-L s u/(1 + u), u = |v|/v_w, shape (n, 1): N per N of dF."""
    u = path.speed / nonlinear["v_w"]
    return -(path.load * path.s * u / (1 + u))[:, None]


equation = "-dF L s (|v|/v_w)/(1 + |v|/v_w)"
parameters = (
    Parameter("dF", "N", (0.0, np.inf), linear=True, loaded=True),
    Parameter("v_w", "m/s", (1e-9, np.inf), scan=partial(bend_velocities, above=3.0)),
)
varies_with = "v"
scales_with = "load"
what = "Asperities that touch at high speed heat up and soften before they part."
looks_like = "dry friction that falls with the speed, steeply at first and then slowly, in proportion to the load"
mistaken_for = "a negative viscous coefficient, drag (both curve upward), a wide Stribeck effect"
confirm = "Film runs at 1, 3 and 9 m/s, and one with the double mass: the fall doubles with the load, drag stays."
describe = Phrase("the dry friction falls by {dF} N at very high speed, by half of that at {v_w} m/s")
invariant = "flash weakening depends on the speed and grows with the load"
source = "Rice 2006, J. Geophys. Res. 111, B05311; Beeler et al. 2008; Goldsby & Tullis 2011, Science 334, 216"
