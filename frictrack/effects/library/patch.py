"""A local patch on the course: more (or less) friction at one place."""

import numpy as np

from frictrack.effects.definition import Array, EffectInStudy, Mask, Nonlinear, Parameter, Path
from frictrack.effects.ranges import N_STD_ACTIVE, Span, log_grid, within_course

N_STD_CLEAR = 3.0  # standard deviations from its middle beyond which the course is as everywhere


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """L s exp(-((x - x_c)/w)^2/2), shape (n, 1): N per N of F."""
    bump = np.exp(-(((path.x - nonlinear["x_c"]) / nonlinear["w"]) ** 2) / 2)
    return (path.load * path.s * bump)[:, None]


def places(span: Span) -> Array:
    """Centres worth trying, m."""
    return np.linspace(span.x_min, span.x_max, 61)


def widths(span: Span) -> Array:
    """Widths worth trying, m."""
    travel = span.x_max - span.x_min
    return log_grid(travel / 480, travel / 8, 7)


def describe(effect: EffectInStudy) -> str:
    """Place, width, when the first runs pass it, and whether they show the course on both sides of it."""
    centre, width = effect.value("x_c"), effect.value("w")
    reach = N_STD_ACTIVE * width
    passes = effect.passes(centre) or "no run"
    where = f"from x = {centre - reach:.3f} to {centre + reach:.3f} m, the middle passed by {passes}"
    begin, end = effect.course
    if begin + N_STD_CLEAR * width <= centre <= end - N_STD_CLEAR * width:
        return where
    side = "smaller" if centre - begin < end - centre else "larger"
    return (
        f"{where}; the runs hardly show the course at {side} x, so that the friction may as well change only once, as "
        "at a joint"
    )


def acts_within(t: Array, x: Array, values: Nonlinear, half_width: float) -> Mask:
    """Return the frames within two standard deviations of the centre, (n,)."""
    return np.asarray(np.abs(x - values["x_c"]) <= N_STD_ACTIVE * values["w"])


equation = "F L s exp(-((x - x_c)/w)^2/2)"
parameters = (
    Parameter("F", "N", linear=True, loaded=True),
    Parameter("x_c", "m", scan=places, signed=True),
    Parameter("w", "m", scan=widths),
)
varies_with = "x"
scales_with = "load"
what = "Dirt, wear or a repair: one stretch of the course rubs differently."
looks_like = "a step in velocity at the same place in every run"
mistaken_for = "a collision, a spring when it is wide"
confirm = "Wipe or mark the place and film again; reverse the run."
plausible = within_course("x_c", "w")
invariant = "a patch keeps its place on the course"
source = "textbook; position-dependent friction"
