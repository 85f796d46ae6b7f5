"""Lens distortion: the picture's scale changes away from the optical axis."""

from __future__ import annotations

import numpy as np

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path, Span
from frictrack.effects.plausibility import within_picture
from frictrack.records import Array


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """(x - x_c)^3, shape (n, 1): m per 1/m^2 of k."""
    return ((path.x - nonlinear["x_c"]) ** 3)[:, None]


def centres(span: Span) -> Array:
    """Optical axes worth trying, m: the travelled span and half of it beyond either end."""
    reach = (span.x_max - span.x_min) / 2
    return np.linspace(span.x_min - reach, span.x_max + reach, 17)


def distortion(own: Nonlinear, span: Span) -> float:
    """Largest error in the picture once its scale is fitted, m: a cubic less its best line leaves 1/4 at the ends."""
    return own["k"] * max(abs(span.x_min - own["x_c"]), abs(span.x_max - own["x_c"])) ** 3 / 4


lens = Effect(
    name="lens",
    acts_on="measurement",
    equation="y: k (x - x_c)^3",
    parameters=(
        Parameter("k", "1/m^2", linear=True, role="amplitude"),
        Parameter("x_c", "m", scan=centres, signed=True),
    ),
    columns=columns,
    what="The lens magnifies the middle and the edge of the picture differently.",
    looks_like="a cubic in x that is the same in every run, whatever the speed",
    mistaken_for="a spring or drag, at one speed",
    confirm="Film a ruler along the course, or another speed: a force's trace changes with time, the lens's does not.",
    plausible=within_picture(distortion),
    source="Brown 1966, radial term",
)
