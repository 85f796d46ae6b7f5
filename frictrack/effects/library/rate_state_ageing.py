"""Rate-and-state friction with the ageing law: contacts grow with the logarithm of the time that they last."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path, Phrase
from frictrack.effects.memory import follow_linear, remembered, slid_per_step, state_at_beginning
from frictrack.effects.ranges import breakaway_lengths

REFERENCE_SPEED = 1e-4  # m/s, v_0: below it the direct effect bends to a constant
MIN_AGE = 1e-300  # v_0 theta/D_c, whose logarithm is still finite
MIN_STEP = 1e-9  # of a distance over D_c, below which a step is one of time alone


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """Level, direct effect and contact age, shape (n, 3): N per N of F_0, A and B, in the direction of motion."""
    age = remembered(path, state, nonlinear)[:, 0]
    made = [np.ones_like(age), np.log1p(path.speed / nonlinear["v_0"]), np.log(np.maximum(age, MIN_AGE))]
    return np.asarray((path.load * path.s)[:, None] * np.column_stack(made))


def state(path: Path, nonlinear: Nonlinear) -> Array:
    """Age of the contacts, v_0 theta/D_c, (n, 1)."""
    return contact_age(path, nonlinear["D_c"], nonlinear["v_0"])[:, None]


def contact_age(path: Path, length: float | Array, v_0: float | Array) -> Array:
    """U = v_0 theta/D_c (n,) of the ageing law, du/dt = v_0/D_c - u |v|/D_c.

    The speed of a step enters where the contacts that last to its end are made: with a constant speed a step is exact.
    A path begins as the motion before it has left the contacts, in the steady state where nothing is known of it.
    """
    v_0s, lengths = (np.broadcast_to(np.asarray(q, dtype=float), path.t.shape) for q in (v_0, length))
    slid, dt, speed = np.sum(slid_per_step(path), axis=0), np.diff(path.t, prepend=path.t[:1]), np.abs(path.v)
    step = np.maximum(slid / lengths, MIN_STEP)
    before = np.concatenate([speed[:1], speed[:-1]])
    back = 1.0 / step - 1.0 / np.expm1(np.minimum(step, 500.0))  # share of the way back to where they are made
    back = np.where(step < 1e-4, 0.5, back)
    at, mean = speed - (speed - before) * back, (speed + before) / 2
    ratio = np.where(mean > 0, mean / np.maximum(at, 1e-3 * mean + 1e-300), 1.0)
    gained = v_0s / lengths * dt * -np.expm1(-step) / step * ratio
    starts = list(path.starts)
    steady = v_0s[starts] / np.maximum(speed[starts], v_0s[starts])
    begin = state_at_beginning(path, steady[:, None], contact_age, length, v_0)[:, 0]
    return follow_linear(path, np.exp(-step), gained, begin)


equation = "L s (F_0 + A ln(1 + |v|/v_0) + B ln(v_0 theta/D_c)), d theta/dt = 1 - |v| theta/D_c"
parameters = (
    Parameter("F_0", "N", (0.0, np.inf), linear=True, loaded=True),
    Parameter("A", "N", linear=True, loaded=True),
    Parameter("B", "N", linear=True, loaded=True),
    Parameter("D_c", "m", (1e-9, np.inf), scan=breakaway_lengths),
    Parameter("v_0", "m/s", (1e-12, np.inf), fixed=REFERENCE_SPEED),
)
replaces = frozenset({"coulomb", "stribeck", "presliding", "rate_state_slip"})
scales_with = "load"
memory = True
what = "The contacts creep and grow while they last, also at rest; sliding renews them over a distance."
looks_like = "a peak after a rest that grows with the logarithm of its length; a double answer to a step of speed"
mistaken_for = "stribeck, if the speed changes slowly and never rests; rate_state_slip, without rests"
confirm = "Slide, hold for 1, 10 and 100 s, slide: the peak grows by the same amount per decade."
describe = Phrase("{A} N at once and {B} N late per factor e of the speed, within {D_c:m}")
invariant = "the age of the contacts needs rests, or steps of the speed"
source = (
    "Dieterich 1979, J. Geophys. Res. 84, 2161; Ruina 1983, J. Geophys. Res. 88, 10359; direct effect cut "
    "off below v_0 as in Okubo & Dieterich 1986"
)
