"""Gravity along a circle that stands upright: a pendulum, a bead on a ring, a car in a loop."""

import numpy as np

from frictrack.effects.definition import Nonlinear, Parameter, Path, Phrase
from frictrack.records import GRAVITY, Array


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """Mass times sin((x - x_low)/R), shape (n, 1): N per m/s^2 of g."""
    assert path.mass is not None
    return np.asarray(path.mass * np.sin(path.curvature * (path.x - path.lowest)))[:, None]


equation = "m g sin((x - x_low)/R)"
parameters = (Parameter("g", "m/s^2", (0.0, np.inf), linear=True, fixed=GRAVITY),)
varies_with = "x"
scales_with = "mass"
what = "Gravity pulls back to the lowest place of a circle that stands upright."
looks_like = "a sine of the angle; near the lowest place a straight line against x"
mistaken_for = "spring (at small angles), a wrong clock (it changes the period of the swing)"
confirm = "Measure the radius and the lowest place; free g for a body whose mass is spread out."
describe = Phrase("gravity of {g} m/s^2")
invariant = "gravity pulls by place, with the same acceleration on every mass"
may_pull = True
needs = ("upright",)
source = "textbook: m g sin(angle)"
