"""Slope: the course is not level, gravity pulls along it."""

from __future__ import annotations

import numpy as np

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path
from frictrack.records import Array


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """m/m_ref, shape (n, 1): N per N of F at the reference mass."""
    return np.full((len(path.t), 1), path.mass_ratio)


slope = Effect(
    name="slope",
    acts_on="force",
    equation="F m/m_ref",
    parameters=(Parameter("F", "N", linear=True),),
    columns=columns,
    scales_with="mass",
    what="The course is tilted, or a constant force pulls one way.",
    looks_like="forward runs slow faster than reversed ones, by the same deceleration whatever the mass",
    mistaken_for="Coulomb friction in one direction, asymmetry, a cable",
    confirm="Lay a level on the course; no film can part a slope from a constant pull.",
    source="textbook: F = m g sin(alpha)",
)
