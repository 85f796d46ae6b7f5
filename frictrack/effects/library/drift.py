"""Drift: dry friction rises or falls steadily with time."""

import numpy as np

from frictrack.base.number_format import format_number
from frictrack.effects.definition import Array, EffectInStudy, Nonlinear, Parameter, Path


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """L s t, shape (n, 1): N per N/s of k; t since release."""
    return np.asarray((path.load * path.s * path.t)[:, None])


def describe(effect: EffectInStudy) -> str:
    """Force at the end of the run that lasts longest."""
    name, end = effect.last_run
    force, when = format_number(effect.value("k") * end), format_number(1e3 * end)
    return f"{force} N by the end of run {name}, {when} ms after release"


equation = "k L s t"
parameters = (Parameter("k", "N/s", linear=True, loaded=True),)
varies_with = ""
scales_with = "load"
what = "Dry friction changes steadily during a run: lubricant is squeezed out (k > 0), surfaces warm up (k < 0)."
looks_like = "a slow change of deceleration that follows the clock, whatever the place and the speed"
mistaken_for = "viscous friction (as the mass slows steadily), thermal, a spring in one direction"
confirm = "Film slow and fast runs over the same course: the change per second stays, that per metre does not."
invariant = "drift depends on the time since release"
source = "textbook: linear drift"
