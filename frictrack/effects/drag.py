"""Aerodynamic drag: proportional to the square of velocity."""

from __future__ import annotations

import numpy as np

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path
from frictrack.records import Array


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """V |v|, shape (n, 1): N per N s^2/m^2 of c = rho C_d A / 2."""
    return (path.v * np.abs(path.v))[:, None]


drag = Effect(
    name="drag",
    acts_on="force",
    equation="c v |v|",
    parameters=(Parameter("c", "N s^2/m^2", linear=True, passive=True),),
    columns=columns,
    what="Air pushed aside by the moving mass.",
    looks_like="a curve against v that bends upward at the fast end",
    mistaken_for="viscous friction, wear along the path",
    confirm="Film at twice the speed, or change the frontal area with a card.",
    source="textbook: F = rho C_d A v^2 / 2",
)
