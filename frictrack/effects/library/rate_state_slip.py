"""Rate-and-state friction with the slip law: contacts change only while they slide, toward a level of the speed."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Path
from frictrack.effects.library import rate_state_ageing
from frictrack.effects.memory import follow_target, remembered, slid_per_step, state_at_beginning


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """Level, direct effect and state, shape (n, 3): N per N of F_0, A and B, in the direction of motion."""
    w = remembered(path, state, nonlinear)[:, 0]
    made = [np.ones_like(w), np.log1p(path.speed / nonlinear["v_0"]), w]
    return np.asarray((path.load * path.s)[:, None] * np.column_stack(made))


def state(path: Path, nonlinear: Nonlinear) -> Array:
    """State w = ln(v_0 theta/D_c), (n, 1), which follows -ln(1 + |v|/v_0) over the distance D_c."""
    return _logarithm(path, nonlinear["D_c"], nonlinear["v_0"])[:, None]


def _logarithm(path: Path, length: float | Array, v_0: float | Array) -> Array:
    """State (n,). A path begins as the motion before it has left it, steady where nothing is known of it."""
    target = -np.log1p(path.speed / v_0)[:, None]
    begin = state_at_beginning(path, target[list(path.starts)], _logarithm, length, v_0)
    return follow_target(path, target, begin, np.sum(slid_per_step(path), axis=0) / length)[:, 0]


equation = "L s (F_0 + A ln(1 + |v|/v_0) + B w), dw/dt = -(|v|/D_c) (w + ln(1 + |v|/v_0))"
parameters = rate_state_ageing.parameters
replaces = frozenset({"coulomb", "stribeck", "presliding", "rate_state_ageing"})
scales_with = "load"
memory = True
what = "Sliding renews the contacts over a distance; a rest leaves them as they are."
looks_like = "a step of speed that is answered at once and, over a distance, the other way; the same up and down"
mistaken_for = "stribeck, if the speed changes slowly; rate_state_ageing, without rests"
confirm = "Step the speed up and down by the same factor: both answers have the same length; a rest adds no peak."
invariant = "the state of the contacts needs steps of the speed"
source = "Ruina 1983, J. Geophys. Res. 88, 10359, with w = ln(v_0 theta/D_c) and the logarithm cut off below v_0"
describe = rate_state_ageing.describe
