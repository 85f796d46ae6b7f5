"""Coulomb friction: dry friction that does not depend on speed."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """L s, shape (n, 1): N per N of F_c."""
    return (path.load * path.s)[:, None]


equation = "F_c L s"
parameters = (Parameter("F_c", "N", (0.0, np.inf), linear=True, loaded=True),)
varies_with = ""
scales_with = "load"
what = "Dry friction of the sliding pair at its steady level."
looks_like = "a constant deceleration; a parabola in displacement"
mistaken_for = "slope (in one direction), a wrong mass"
confirm = "Film the same course in both directions: dry friction turns round with the motion, a slope does not."
invariant = "Coulomb friction keeps its size and turns round with the motion"
in_base_law = True
source = "Coulomb 1785; first paper, Eq. 1"
