"""Viscous friction: proportional to velocity."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """v, shape (n, 1): N per N s/m of F_v."""
    return path.v[:, None]


equation = "F_v v"
parameters = (Parameter("F_v", "N s/m", (-np.inf, np.inf), linear=True, passive=True),)
varies_with = "v"
what = "A lubricant or a guide sheared by the motion."
looks_like = "a straight line against v"
mistaken_for = "drift in time, a spring (over one run of one speed)"
confirm = "Double the mass: a viscous force stays, its deceleration halves."
invariant = "viscous friction is proportional to the speed"
in_base_law = True
basic = True
source = "first paper, Eq. 1"
