"""Thermal softening or running-in: friction falls with the distance slid, toward a new level."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import Span, log_grid


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """-L s (1 - exp(-distance/length)), shape (n, 1): N per N of dF; the distance is slid since release."""
    gone = -np.expm1(-path.distance / nonlinear["length"])
    return -(path.load * path.s * gone)[:, None]


def lengths(span: Span) -> Array:
    """Distances worth trying, m: much longer than the travel, the fall is a straight line in x."""
    travel = span.x_max - span.x_min
    return log_grid(travel / 30, travel, 4)


equation = "-dF L s (1 - exp(-distance/length))"
parameters = (
    Parameter("dF", "N", linear=True, loaded=True),
    Parameter("length", "m", scan=lengths),
)
varies_with = "x"
scales_with = "load"
what = "The surfaces warm up, soften or run in (dF > 0), or tear up (dF < 0), as they slide."
looks_like = "dry friction that moves from one level to another over the first stretch of every run, however fast"
mistaken_for = "drift (the same at one speed), a spring (in one direction), viscous friction (as the mass slows)"
confirm = "Repeat without a pause, then after a long one: heat fades between runs, running-in stays."
describe = Phrase("{abs(dF)} N {'less' if dF > 0 else 'more'} in the end, two thirds of it within {length:m} slid")
invariant = "warming and running-in depend on the distance slid"
source = "Ettles 1986 (thermal control of friction); Blau 1989 (running-in)"
