"""Elastic joint: a part of the mass hangs on a spring, and swings after every jolt."""

import numpy as np

from frictrack.base.number_format import format_number
from frictrack.effects.definition import Array, EffectInStudy, Nonlinear, Parameter, Path
from frictrack.effects.memory import Complexes, follow_target, remembered, state_at_beginning, time_steps
from frictrack.effects.ranges import ScanValues, Span, frequency_range, oscillates

DAMPINGS = (0.04, 0.2)  # damping ratios worth trying


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """Acceleration du/dt of the part on the spring, shape (n, 1): N per kg of it, against the direction of x."""
    omega, damping = 2 * np.pi * nonlinear["frequency"], nonlinear["damping"]
    z, u = remembered(path, state, nonlinear).T
    return np.asarray((-(omega**2) * z - 2 * damping * omega * (u - path.v))[:, None])


def state(path: Path, nonlinear: Nonlinear) -> Array:
    """How far the spring is stretched, m, and the velocity of the part on it, m/s, (n, 2)."""
    return swing(path, nonlinear["frequency"], nonlinear["damping"])


def swing(path: Path, frequency: float | Array, damping: float | Array) -> Array:
    """State (n, 2), z and u, of dz/dt = u - v, du/dt = -omega^2 z - 2 damping omega (u - v).

    With the eigenvalue l of the part on its spring, q = u - conj(l) z obeys dq/dt = -l (v - q): it follows the velocity
    of the mass at a complex rate.
    """
    omega, ratio = (np.broadcast_to(np.asarray(q, dtype=float), path.t.shape) for q in (frequency, damping))
    omega = 2 * np.pi * omega
    rate = ratio * omega - 1j * np.sqrt(1 - ratio**2) * omega  # -l
    starts = list(path.starts)
    # where nothing is known before, the part was at rest at release, and the mass has kept its first velocity since
    unknown = -path.v[starts] * np.expm1(-rate[starts] * np.maximum(path.t[starts], 0.0))
    z, u = state_at_beginning(path, _stretch_and_velocity(unknown, rate[starts]), swing, frequency, damping).T
    begin = u + rate[starts].conj() * z
    q = follow_target(path, path.v[:, None], begin[:, None], rate * time_steps(path))[:, 0]
    return _stretch_and_velocity(q, rate)


def _stretch_and_velocity(q: Array | Complexes, rate: Complexes) -> Array:
    """State (n, 2), z and u, of q = u + conj(rate) z."""
    z = -q.imag / rate.imag
    return np.column_stack([z, q.real - rate.real * z])


def frequencies(span: Span) -> Array:
    """Frequencies worth trying, Hz: half a Rayleigh cell apart, and higher up half the width of a damped line."""
    cell, width = 0.5 / span.duration, DAMPINGS[0]
    lowest, highest = frequency_range(span)
    knee = min(max(cell / width, lowest), highest)
    count = int(np.log(highest / knee) / width) + 2
    return np.unique(np.append(np.arange(lowest, knee, cell), np.geomspace(knee, highest, count)))


def describe(effect: EffectInStudy) -> str:
    """Mass of the part, its frequency, and how fast it comes to rest."""
    mass, frequency, damping = (effect.value(name) for name in ("mass", "frequency", "damping"))
    fading = f", down to a third after {format_number(1e3 / (2 * np.pi * frequency * damping))} ms" if damping else ""
    return f"{format_number(1e3 * mass)} g swing at {format_number(frequency)} Hz{fading}"


equation = "mass du/dt, du/dt = -(2 pi frequency)^2 z - 4 pi frequency damping (u - v), dz/dt = u - v"
parameters = (
    Parameter("mass", "kg", (0.0, np.inf), linear=True),
    Parameter("frequency", "Hz", (1e-3, np.inf), scan=frequencies),
    Parameter("damping", "1", (0.0, 0.99), scan=ScanValues(DAMPINGS)),
)
replaces = frozenset({"decaying_vibration"})
memory = True
what = "A part of the mass, such as a cable or the arm of the target, is held softly and swings after a jolt."
looks_like = "ringing after every jolt (release, blow, reversal), as strong as the jolt, always beginning alike"
mistaken_for = "decaying vibration (where every run has one jolt of the same strength); presliding near reversals"
confirm = "Double the speed of the blow: the ringing doubles. Hold the part fast, or tap it and film it at rest."
plausible = oscillates
invariant = "the ringing of a joint follows the jolts of its own mass"
settled_by = "fasten the part, or film it beside the target"
may_pull = True
source = "textbook: two masses on a spring; frequency and damping are those of the part while the mass is held fast"
