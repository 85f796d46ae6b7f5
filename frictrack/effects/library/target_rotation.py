"""Target rotation: the point that is followed is not the centre of mass, and moves as the target turns."""

import numpy as np

from frictrack.effects.definition import Array, DirectCheck, Nonlinear, Parameter, Path, Phrase, picture_shift_signal
from frictrack.effects.ranges import Span


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """Cos(angle) - 1 and -sin(angle), shape (n, 2): m per m of the arm along the course and across it (upward)."""
    assert path.angle is not None
    return np.column_stack([np.cos(path.angle) - 1, -np.sin(path.angle)])


def plausible(values: Nonlinear, span: Span) -> str:
    """Return an objection to an arm that is longer than the course: the point would lie off any target."""
    arm, travel = float(np.hypot(values["along"], values["across"])), span.x_max - span.x_min
    return "" if arm <= travel else f"its arm of {arm:.2g} m is longer than the course ({travel:.2g} m)"


acts_on = "measurement"
equation = "y: along (cos(angle) - 1) - across sin(angle)"
parameters = (Parameter("along", "m", linear=True), Parameter("across", "m", linear=True))
what = "The target turns as it slides, and the followed point lies off the centre of mass (along x, across upward)."
looks_like = "a displacement that copies the angle of the target"
mistaken_for = "vibration (when the target rocks at one frequency), camera shake"
confirm = "Follow a second mark at another height of the target: the two move differently when it rocks."
describe = Phrase("the followed point would lie {along:m} along and {across:m} above the centre of mass")
invariant = "a rotating target moves its mark in proportion to its angle"
direct_check = DirectCheck("second mark", "Follow a second mark at another height of the target", picture_shift_signal)
film_fault = True
source = "textbook: motion of a rigid body"
needs = ("angle",)
