"""Time base: the frame rate drifts during a run, so that the recorded clock is not the true one."""

from __future__ import annotations

import numpy as np

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path, Span
from frictrack.effects.plausibility import MAX_CLOCK_DRIFT
from frictrack.records import Array


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """V t^2/2, shape (n, 1): m per 1/s of k; the true time is t + k t^2/2."""
    return np.asarray((path.v * path.t**2 / 2)[:, None])


def steady(own: Nonlinear, span: Span) -> str:
    """Objection to a clock that drifts more than any camera's does."""
    drift = abs(own["k"]) * span.duration / 2
    if drift <= MAX_CLOCK_DRIFT:
        return ""
    return f"the clock would be off by {100 * drift:.2g} % at the end, expected at most {100 * MAX_CLOCK_DRIFT:g} %"


timebase = Effect(
    name="timebase",
    acts_on="measurement",
    equation="y: k v t^2/2",
    parameters=(Parameter("k", "1/s", linear=True, role="amplitude"),),
    columns=columns,
    what="The camera's clock runs faster or slower as it goes: at the end of a run every frame comes late or early.",
    looks_like="a false deceleration that grows with the speed and hardly depends on the mass",
    mistaken_for="viscous friction and drag, unless runs of two masses are there",
    confirm="Film a counter, a flashing diode or a second clock in the same picture.",
    plausible=steady,
    source="textbook: a clock with a linear rate; y(t) = x(t + k t^2/2)",
)
