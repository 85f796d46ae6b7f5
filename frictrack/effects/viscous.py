"""Viscous friction: proportional to velocity."""

from __future__ import annotations

import numpy as np

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path
from frictrack.records import Array


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """v, shape (n, 1): N per N s/m of F_v."""
    return path.v[:, None]


viscous = Effect(
    name="viscous",
    acts_on="force",
    equation="F_v v",
    parameters=(Parameter("F_v", "N s/m", (-np.inf, np.inf), linear=True, passive=True),),
    columns=columns,
    what="A lubricant or a guide sheared by the motion.",
    looks_like="a straight line against v",
    mistaken_for="drift in time, a spring (over one run of one speed)",
    confirm="Double the mass: a viscous force stays, its deceleration halves.",
    source="first paper, Eq. 1",
)
