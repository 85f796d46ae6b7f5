"""A spring: a cable, hose or guide that pulls back in proportion to displacement."""

from __future__ import annotations

import numpy as np

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path, Span
from frictrack.records import Array

FARTHEST = 100.0  # courses to the place where a spring is slack: beyond, its force varies by less than 1 % along one


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """X and 1, shape (n, 2): N per N/m of k, N per N of k x_0."""
    return np.column_stack([path.x, np.ones_like(path.x)])


def quote(own: dict[str, float], model: dict[str, float]) -> dict[str, float]:
    """x_0 is quoted as a length: the constant force over the stiffness."""
    return {"x_0": own["x_0"] / own["k"] if own["k"] else float("nan")}


def pulls_back(own: Nonlinear, span: Span) -> str:
    """Objection to a spring whose force is the same all along the course: a constant force."""
    reach = FARTHEST * (span.x_max - span.x_min)
    if abs(own["x_0"]) <= reach * abs(own["k"]):
        return ""
    return f"it would be slack more than {reach:.2g} m away, {FARTHEST:g} courses: a constant force, and no spring"


spring = Effect(
    name="spring",
    acts_on="force",
    equation="k (x + x_0)",
    parameters=(Parameter("k", "N/m", linear=True), Parameter("x_0", "m", linear=True)),
    columns=columns,
    what="A cable, hose or soft guide pulls the mass back.",
    looks_like="a straight line against x that does not turn round with the direction",
    mistaken_for="viscous friction and drift, in one direction at one speed",
    confirm="Film a reversed run, or take the cable off.",
    plausible=pulls_back,
    source="textbook: F = k x",
    quote=quote,
)
