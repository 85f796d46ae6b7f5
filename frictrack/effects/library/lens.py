"""Lens distortion: the picture's scale changes away from the optical axis."""

import numpy as np

from frictrack.effects.definition import Array, DirectCheck, EffectInStudy, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import Span, within_picture


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """(x - x_c)^3, shape (n, 1): m per 1/m^2 of k."""
    away = path.x - nonlinear["x_c"]
    return np.asarray(away * away * away)[:, None]  # ten times faster than a power


def centres(span: Span) -> Array:
    """Optical axes worth trying, m: the travelled span and half of it beyond either end."""
    reach = (span.x_max - span.x_min) / 2
    return np.linspace(span.x_min - reach, span.x_max + reach, 17)


def distortion(values: Nonlinear, span: Span) -> float:
    """Largest error in the picture once its scale is fitted, m: a cubic less its best line leaves 1/4 at the ends."""
    return values["k"] * max(abs(span.x_min - values["x_c"]), abs(span.x_max - values["x_c"])) ** 3 / 4


def rule_signal(effect: EffectInStudy) -> float:
    """Return chi-squared of the marks of a rule along the course; a line through them is its scale and place."""
    record = effect.longest
    shift, x, rows = record.contribution, record.x, record.marks
    line = np.polyfit(x[rows], shift[rows], 1)
    return float(np.sum(((shift - np.polyval(line, x)) / record.noise)[rows] ** 2))


acts_on = "measurement"
equation = "y: k (x - x_c)^3"
parameters = (
    Parameter("k", "1/m^2", linear=True, role="amplitude"),
    Parameter("x_c", "m", scan=centres, signed=True),
)
what = "The lens magnifies the middle and the edge of the picture differently."
looks_like = "a cubic in x that is the same in every run, whatever the speed"
mistaken_for = "a spring or drag, at one speed"
confirm = "Film a ruler along the course, or another speed: a force's trace changes with time, the lens's does not."
plausible = within_picture(distortion)
describe = Phrase("no error at x = {x_c:.3f} m, growing with the cube of the distance from there")
invariant = "the lens bends the picture by place, equally at every speed"
settled_by = "film a rule along the course"
direct_check = DirectCheck(
    "rule", "Film a rule that lies along the course: its marks stand equally far apart everywhere", rule_signal
)
film_fault = True
of_camera = True
source = "Brown 1966, radial term"
