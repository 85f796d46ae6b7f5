"""Delay of the load cell: its clock is behind that of the positions, or ahead of it."""

import numpy as np

from frictrack.effects.definition import EVERY_FORCE, Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.library.drive_error import delays


def columns(path: Path, nonlinear: Nonlinear, inner: Array) -> Array:
    """Columns of the force at t - tau, same shape as `inner`; where no cell measures, nothing is late.

    Before the record the force was what it is at its first sample, after it what it is at the last.
    """
    if path.friction is None:
        return inner
    first = list(path.starts)
    last = [*(row - 1 for row in first[1:]), len(path.t) - 1]
    begins, ends = path.each(path.t[first]), path.each(path.t[last])
    apart = path.each(2 * np.arange(len(first)) * np.max(ends - begins, initial=1.0)) - begins  # lays them end to end
    t = np.clip(path.t - nonlinear["tau"], begins, ends) + apart
    return np.column_stack([np.interp(t, path.t + apart, column) for column in inner.T])


equation = "F(t) -> F(t - tau)"
parameters = (Parameter("tau", "s", scan=delays, signed=True),)
modifies = EVERY_FORCE
memory = True
rank = 2
what = "The clocks of the load cell and of the positions differ, or a filter of either is made up for in part."
looks_like = "jumps where the direction turns: the force turns before the motion does, or after it"
mistaken_for = "cell_lag (which rounds off, too), presliding and friction_lag (loops against v)"
confirm = "Tap the slider: both records show the tap."
describe = Phrase("{1e3 * tau} ms late")
invariant = "a delay of a cell is the same for every force"
settled_by = "tap the slider and look for the tap in both records"
source = "a pure delay; Franklin, Powell & Emami-Naeini, Feedback Control of Dynamic Systems, section 5.6"
needs = ("friction",)
