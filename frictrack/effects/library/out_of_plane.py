"""Inclined course: the course is not parallel to the picture, so that the scale changes along it."""

import numpy as np

from frictrack.effects.definition import Array, DirectCheck, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.library.lens import rule_signal
from frictrack.effects.ranges import Span, within_picture


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """x^2, shape (n, 1): m per 1/m of k; the scale is right at x = 0."""
    return np.asarray((path.x**2)[:, None])


def bow(values: Nonlinear, span: Span) -> float:
    """Largest error in the picture once its scale is fitted, m: a parabola less its best line leaves 1/8."""
    return values["k"] * (span.x_max - span.x_min) ** 2 / 8


acts_on = "measurement"
equation = "y: k x^2"
parameters = (Parameter("k", "1/m", linear=True, role="amplitude"),)
varies_with = "x"
what = "The course leads toward the camera or away from it: the mass grows or shrinks in the picture."
looks_like = "a false force in proportion to the mass and the square of the speed, the same in either direction"
mistaken_for = "drag (where all runs have one mass and one direction), lens, rolling shutter"
confirm = "Film a reversed run: drag turns round with the motion, this force does not. Or film a rule."
plausible = within_picture(bow)
describe = Phrase("the scale changes by {20 * k:2} % in every 0.1 m of the course")
invariant = "the scale belongs to the place in the picture, whatever the speed and the mass"
settled_by = "film a rule along the course"
direct_check = DirectCheck(
    "rule", "Film a rule that lies along the course: its marks stand equally far apart everywhere", rule_signal
)
film_fault = True
of_camera = True
source = "pinhole camera, to second order: Hartley & Zisserman 2004, section 8.1"
