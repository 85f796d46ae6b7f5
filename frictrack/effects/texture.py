"""Surface texture: friction that varies periodically along the course."""

from __future__ import annotations

import numpy as np

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path, Span, wave
from frictrack.effects.plausibility import repeats_along
from frictrack.records import Array


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """L s sin(2 pi x/period + phase), shape (n, 1): N per N of amplitude."""
    ripple = wave(path.x / nonlinear["period"], nonlinear["phase"])
    return path.load * path.s[:, None] * ripple


def periods(span: Span) -> Array:
    """Periods worth trying, m: equal steps in 1/period, a quarter of a cell of the travelled span apart."""
    travel = span.x_max - span.x_min
    shortest = max(min(0.002, travel / 20), span.v_min / (0.2 * span.fps), travel / 200)
    return 1.0 / np.arange(1.0 / travel, 1.0 / shortest, 0.25 / travel)


texture = Effect(
    name="texture",
    acts_on="force",
    equation="amplitude L s sin(2 pi x/period + phase)",
    parameters=(
        Parameter("amplitude", "N", linear=True, loaded=True, role="amplitude"),
        Parameter("period", "m", scan=periods),
        Parameter("phase", "rad", role="phase"),
    ),
    columns=columns,
    scales_with="load",
    what="Machining marks, joints or waviness of the course.",
    looks_like="ripples at the same places in every run; a chirp in time as the mass slows",
    mistaken_for="vibration, when the speed hardly changes",
    confirm="Film at another speed: the ripples stay at their places and change their frequency.",
    plausible=repeats_along("period"),
    source="textbook; position-dependent friction",
)
