"""Drift of the load cell: its zero moves steadily while it records, as a cell or an amplifier that warms up does."""

import numpy as np

from frictrack.effects.definition import Array, DirectCheck, EffectInStudy, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.ranges import ZERO_STD_N


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """t, shape (n, 1): N per N/s of k; t since the beginning of the run; where no cell measures, nothing."""
    return (np.zeros_like(path.t) if path.friction is None else path.t)[:, None]


def zero_signal(effect: EffectInStudy) -> float:
    """Return chi-squared of the zero at the end of the longest run."""
    return float((effect.rms("k") * np.ptp(effect.longest.t) / ZERO_STD_N) ** 2)


equation = "k t"
parameters = (Parameter("k", "N/s", linear=True),)
varies_with = ""
what = "The zero of the load cell moves while it records: it or its amplifier warms up, or its mount creeps."
looks_like = "both directions move the same way with the time, by as much in newtons whatever the load and the speed"
mistaken_for = "drift and thermal (runs of one direction), slope (whose force is constant), run_in"
confirm = (
    "Record the cell unloaded before and after a run: its zero has moved. Runs in both directions tell it from "
    "friction that drifts."
)
describe = Phrase("its zero moves by {k} N/s")
invariant = "the zero of a cell moves with the time in the same direction whichever way the mass slides"
settled_by = "record the cell unloaded before and after a run"
direct_check = DirectCheck("zero of the cell", "Record the cell unloaded before and after a run", zero_signal)
source = "textbook: zero drift of a strain gauge bridge"
needs = ("friction",)
