"""A local patch on the course: more (or less) friction at one place."""

from __future__ import annotations

import numpy as np

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path, Span, log_grid
from frictrack.effects.plausibility import within_course
from frictrack.records import Array


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """L s exp(-((x - x_c)/w)^2/2), shape (n, 1): N per N of F."""
    bump = np.exp(-(((path.x - nonlinear["x_c"]) / nonlinear["w"]) ** 2) / 2)
    return path.load * (path.s * bump)[:, None]


def places(span: Span) -> Array:
    """Centres worth trying, m."""
    return np.linspace(span.x_min, span.x_max, 61)


def widths(span: Span) -> Array:
    """Widths worth trying, m."""
    travel = span.x_max - span.x_min
    return log_grid(travel / 120, travel / 8, 5)


patch = Effect(
    name="patch",
    acts_on="force",
    equation="F L s exp(-((x - x_c)/w)^2/2)",
    parameters=(
        Parameter("F", "N", linear=True, loaded=True),
        Parameter("x_c", "m", scan=places, signed=True),
        Parameter("w", "m", scan=widths),
    ),
    columns=columns,
    scales_with="load",
    what="Dirt, wear or a repair: one stretch of the course rubs differently.",
    looks_like="a step in velocity at the same place in every run",
    mistaken_for="a collision, a spring when it is wide",
    confirm="Wipe or mark the place and film again; reverse the run.",
    plausible=within_course("x_c", "w"),
    source="textbook; position-dependent friction",
)
