"""A spring: a cable, hose or guide that pulls back in proportion to displacement."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase, TestDraw
from frictrack.effects.ranges import Span

MAX_COURSES = 100.0  # courses to the place where a spring is slack: beyond, its force varies by less than 1 % along one


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """X and 1, shape (n, 2): N per N/m of k, N per N of k x_0."""
    return np.column_stack([path.x, np.ones_like(path.x)])


def quote(own: dict[str, float], model: dict[str, float]) -> dict[str, float]:
    """x_0 is quoted as a length: the constant force over the stiffness."""
    return {"x_0": own["x_0"] / own["k"] if own["k"] else float("nan")}


def plausible(values: Nonlinear, span: Span) -> str:
    """Return an objection to a spring whose force is the same all along the course: a constant force."""
    reach = MAX_COURSES * (span.x_max - span.x_min)
    if abs(values["x_0"]) <= reach * abs(values["k"]):
        return ""
    return f"it would be slack more than {reach:.2g} m away, {MAX_COURSES:g} courses: a constant force, and no spring"


def draw_rest(span: Span, uniform: Array) -> dict[str, float]:
    """Return a constant force k x_0 at k = 1 N/m, with the spring slack at a place of the course."""
    return {"x_0": -(span.x_min + (span.x_max - span.x_min) * float(uniform[0]))}


equation = "k (x + x_0)"
parameters = (Parameter("k", "N/m", linear=True), Parameter("x_0", "m", linear=True))
varies_with = "x"
what = "A cable, hose or soft guide pulls the mass back."
looks_like = "a straight line against x that does not turn round with the direction"
mistaken_for = "viscous friction and drift, in one direction at one speed"
confirm = "Film a reversed run, or take the cable off."
describe = Phrase("{k} N more for every metre toward +x")
invariant = "a spring pulls by place, in either direction of motion"
settled_by = "take the cable off"
in_base_law = True
may_pull = True
test_draw = TestDraw(positive=True, coefficients=draw_rest)
source = "textbook: F = k x"
