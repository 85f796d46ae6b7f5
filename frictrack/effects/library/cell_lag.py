"""Lag of the load cell: its amplifier or its filter answers late, and rounds off what changes fast."""

import numpy as np

from frictrack.effects.definition import EVERY_FORCE, Array, Nonlinear, Parameter, Path, Phrase, TestDraw
from frictrack.effects.memory import follow_target, time_steps
from frictrack.effects.ranges import Span, log_grid, shorter_than_record


def columns(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """Columns u of the force that the cell shows, of those c on the mass: du/dt = (c - u)/tau, same shape as `inner`.

    Before the record the force was what it is at its first sample. Where no cell measures, nothing is late.
    """
    if path.friction is None:
        return inner
    return follow_target(path, inner, inner[list(path.starts)], time_steps(path) / nonlinear["tau"])


def lags(span: Span) -> Array:
    """Lags worth trying, s: from half a sample up to a quarter of the longest run."""
    return log_grid(0.5 / span.fps, max(span.duration / 4.0, 2.0 / span.fps), 6)


equation = "F -> u, du/dt = (F - u)/tau"
parameters = (Parameter("tau", "s", (1e-7, np.inf), scan=lags),)
modifies = EVERY_FORCE
memory = True
rank = 2
what = "The amplifier or a filter of the load cell is slow: it shows the force of a moment ago, and smooths it."
looks_like = "a loop against v where the speed changes to and fro; slow steps at a start, a stop and a reversal"
mistaken_for = "friction_lag (where dry friction alone changes); a wrong clock of the cell"
confirm = "Read the filter of the amplifier, or tap the cell: the pulse that it shows fades with tau."
plausible = shorter_than_record("tau", 0.5)
describe = Phrase("{1e3 * tau} ms late, as behind a low-pass of first order at {1 / (2 * pi * tau)} Hz")
invariant = "the lag of a cell is the same for every force"
settled_by = "tap the load cell and look at the pulse that it shows"
test_draw = TestDraw(positive=True)
source = "a low-pass of first order; Doebelin, Measurement Systems, chapter 3"
needs = ("friction",)
