"""LuGre friction: bristles that bend before they slip, with damping, over a Stribeck curve."""

import numpy as np

from frictrack.effects.definition import Array, Nonlinear, Parameter, Path
from frictrack.effects.memory import (
    direction_changed,
    follow_target,
    mean_per_step,
    remembered,
    slid_per_step,
    state_at_beginning,
)
from frictrack.effects.ranges import ScanValues, Span, breakaway_lengths, stribeck_velocities

CURVE = ("F_s", "v_s", "delta")  # of steady slip


def columns(path: Path, nonlinear: Nonlinear) -> Array:
    """Bristle force per N of F_c and speed of bending per N s/m of sigma_1, shape (n, 2).

    As published, dz/dt = v - sigma_0 |v| z/g(v) and F = sigma_0 z + sigma_1 dz/dt. With w = sigma_0 z/F_c,
    length = F_c/sigma_0 and gamma = g/F_c this is dw/dt = (|v|/(length gamma))(gamma sgn v - w), in which F_c and
    sigma_1 are coefficients: F = F_c w + sigma_1 (v - |v| w/gamma). `sigma_0` is fitted as that length, `F_s`
    as F_s/F_c.
    """
    w, gamma = remembered(path, state, nonlinear)[:, 0], _level(path, *(nonlinear[name] for name in CURVE))
    return np.column_stack([path.load * w, path.load * (path.v - np.abs(path.v) * w / gamma)])


def state(path: Path, nonlinear: Nonlinear) -> Array:
    """Bending of the bristles over F_c, (n, 1)."""
    return _bending(path, *(nonlinear[name] for name in ("sigma_0", *CURVE)))


def _level(path: Path, highest: float | Array, v_s: float | Array, delta: float | Array) -> Array:
    """Level gamma of steady slip over F_c, (n,)."""
    return np.asarray(1.0 + (highest - 1.0) * np.exp(-((path.speed / v_s) ** delta)))


def _bending(path: Path, length: float | Array, *curve: float | Array) -> Array:
    """Bending of the bristles over F_c, (n, 1)."""
    gamma = _level(path, *curve)
    before, after = slid_per_step(path)
    broken, starts = direction_changed(path), list(path.starts)
    between = mean_per_step(1 / gamma, np.where(broken, 0.0, after), broken) / length
    target = (path.s * gamma)[:, None]
    begin = state_at_beginning(path, target[starts], _bending, length, *curve)
    return follow_target(path, target, begin, after * between, before * between)


def speeds(span: Span) -> Array:
    """Stribeck velocities worth trying, m/s."""
    return stribeck_velocities(span, low=1e-3, per_decade=4)


def lengths(span: Span) -> Array:
    """Breakaway lengths worth trying, m."""
    return breakaway_lengths(span)[::2]


def quote(own: dict[str, float], model: dict[str, float]) -> dict[str, float]:
    """F_s in N and sigma_0 in N/m, both from F_c."""
    level = own["F_c"] if "F_c" in own else float("nan")
    of = {"F_s": lambda ratio: level * ratio, "sigma_0": lambda length: level / length}
    return {name: quoted(own[name]) for name, quoted in of.items() if name in own}


equation = "L (sigma_0 z + sigma_1 dz/dt), dz/dt = v - sigma_0 |v| z/(F_c + (F_s - F_c) exp(-(|v|/v_s)^delta))"
parameters = (
    Parameter("F_c", "N", (0.0, np.inf), linear=True, loaded=True),
    Parameter("sigma_1", "N s/m", (0.0, np.inf), linear=True, loaded=True),
    Parameter("sigma_0", "N/m", (1e-9, np.inf), scan=lengths),
    Parameter("F_s", "N", (1.0, 10.0), scan=ScanValues((1.2, 1.6, 2.5))),
    Parameter("v_s", "m/s", scan=speeds),
    Parameter("delta", "1", (0.5, 2.0), fixed=2.0),
)
replaces = frozenset({"coulomb", "stribeck", "presliding"})
scales_with = "load"
memory = True
turns = True
what = "Bristles between the surfaces bend, damp and slip: presliding, the Stribeck effect and a lag in one state."
looks_like = "a loop against x after every reversal and a hook at the slow end"
mistaken_for = "presliding with stribeck, when the speed changes slowly"
confirm = "Reverse the drive slowly (sigma_0), swing it fast within the breakaway length (sigma_1)."
invariant = "LuGre's bristles need a reversal or a slow speed"
source = "Canudas de Wit, Olsson, Astrom & Lischinsky 1995, IEEE Trans. Automatic Control 40, 419"
