"""Target rotation: the point that is followed is not the centre of mass, and moves as the target turns."""

from __future__ import annotations

import numpy as np

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path, Span
from frictrack.records import Array


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """Cos(angle) - 1 and -sin(angle), shape (n, 2): m per m of the arm along the course and across it (upward)."""
    assert path.angle is not None
    return np.column_stack([np.cos(path.angle) - 1, -np.sin(path.angle)])


def on_target(own: Nonlinear, span: Span) -> str:
    """Objection to an arm that is longer than the course: the point would lie off any target."""
    arm, travel = float(np.hypot(own["along"], own["across"])), span.x_max - span.x_min
    return "" if arm <= travel else f"its arm of {arm:.2g} m is longer than the course ({travel:.2g} m)"


target_rotation = Effect(
    name="target_rotation",
    acts_on="measurement",
    equation="y: along (cos(angle) - 1) - across sin(angle)",
    parameters=(Parameter("along", "m", linear=True), Parameter("across", "m", linear=True)),
    columns=columns,
    what="The target turns as it slides, and the followed point lies off the centre of mass (along x, across upward).",
    looks_like="a displacement that copies the angle of the target",
    mistaken_for="vibration (when the target rocks at one frequency), camera shake",
    confirm="Follow a second mark at another height of the target: the two move differently when it rocks.",
    source="textbook: motion of a rigid body",
    plausible=on_target,
    needs=("angle",),
)
