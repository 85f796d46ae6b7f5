"""The papers' friction laws as functions of measured speed and time, for many parameter sets p (P, d) at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.effects import models
from frictrack.effects.models import Model, Values
from frictrack.records import Array
from frictrack.validation.reproduce.printed import PrintedLaw

Real = NDArray[np.floating[Any]]
PER_SECOND, PER_MILLISECOND = 1.0, 1e3  # 1/s: the papers' "rad/s" may mean per second, per millisecond or per sample
PER_FRAME = 4000.0
UNITS = {"second": PER_SECOND, "millisecond": PER_MILLISECOND, "sample": PER_FRAME}
STATIC = ("F_c", "F_s", "F_v", "v_s")


@dataclass(frozen=True)
class PaperLaw:
    """An equation of the papers.

    Attributes
    ----------
    name, names
        Name of the law, and names of its d parameters.
    force
        Function of parameter sets p (P, d), v (n,), m/s, and t (n,), s, that returns the force (P, n), N.

    """

    name: str
    names: tuple[str, ...]
    force: Callable[[Real, Real, Real], Real]  # p (P, d), v (n,), t (n,) -> N, (P, n)


def tustin() -> PaperLaw:
    """Tustin model, Eq. 2 for v > 0: F_c + (F_s - F_c) exp(-v/v_s) + F_v v.

    Examples
    --------
    >>> float(tustin().force(np.array([[3.0, 5.0, 1.5, 0.5]]), np.array([0.0]), np.array([0.0]))[0, 0])
    5.0

    """
    return PaperLaw("tustin", STATIC, _tustin)


def atm1(n: int) -> PaperLaw:
    """First augmented Tustin model, Eq. 3: Tustin plus n sines in time; frequencies in Hz."""
    names = STATIC + tuple(f"{k}_{i}" for i in range(1, n + 1) for k in ("F", "f", "phi"))
    return PaperLaw(f"atm1:{n}", names, _atm1)


def atm2(n: int) -> PaperLaw:
    """Second augmented Tustin model, Eq. 4 with the missing t in each sum; frequencies in Hz, sliding sines first."""
    pairs = tuple(f"{k}_{i}" for kind in ("", "v") for i in range(1, n + 1) for k in (f"f{kind}", f"phi{kind}"))
    names = ("f_c", "f_s", "f_v", "v_s", *pairs)
    return PaperLaw(f"atm2:{n}", names, _atm2)


def atm2_printed(n: int) -> PaperLaw:
    """Second augmented Tustin model, Eq. 4 as printed: t in the first sum only; frequencies in Hz.

    f_v stands for f_v times the viscous sum, which is one number.
    """
    names = ("f_c", "f_s", "f_v", "v_s", *(f"{k}_{i}" for i in range(1, n + 1) for k in ("f", "phi")))
    return PaperLaw(f"atm2_printed:{n}", names, _atm2_printed)


def read_as_printed(source: PrintedLaw) -> Array:
    """Convert the printed parameters of ATM2 for `atm2_printed`: the viscous sum without t goes into f_v."""
    values = np.array(source.values)
    static, (sliding, viscous) = values[:4].copy(), np.split(values[4:], 2)
    static[2] *= np.sin(viscous[::2] + viscous[1::2]).sum()
    sliding[::2] *= PER_MILLISECOND / (2 * np.pi)
    return np.concatenate([static, sliding])


def law_by_name(name: str) -> PaperLaw:
    """Get a law by name.

    Examples
    --------
    >>> law_by_name("atm1:1").names
    ('F_c', 'F_s', 'F_v', 'v_s', 'F_1', 'f_1', 'phi_1')

    """
    kind, _, order = name.partition(":")
    makers: dict[str, Callable[[int], PaperLaw]] = {"atm1": atm1, "atm2": atm2, "atm2_printed": atm2_printed}
    if name == "tustin":
        return tustin()
    if kind not in makers or not order.isdigit():
        raise FrictrackError(f'expected a law of the papers (tustin, atm1:2, atm2:2) but got "{name}"', usage=True)
    return makers[kind](int(order))


def read_printed(printed: PrintedLaw, unit: str) -> Array:
    """Convert printed parameters."""
    out = np.array(printed.values)
    for i, name in enumerate(law_by_name(printed.law).names):
        if name.startswith("f") and name[-1].isdigit():
            out[i] *= UNITS[unit] / (2 * np.pi)
    return out


def to_effects(law: PaperLaw, p: Array) -> tuple[Model, Values]:
    """Express a law of the papers by effects of frictrack, for the simulator."""
    kind, _, order = law.name.partition(":")
    q = dict(zip(law.names, map(float, p), strict=True))
    n = int(order or 0)
    if kind.startswith("atm2"):
        own = models.parse(law.name)
        return own, {law.name: dict(zip((e.name for e in own.effects[0].parameters), map(float, p), strict=True))}
    values = {
        "coulomb": {"F_c": q["F_c"]},
        "stribeck": {"F_s": q["F_s"] - q["F_c"], "v_s": q["v_s"], "delta": 1.0},
        "viscous": {"F_v": q["F_v"]},
    }
    for i in range(1, n + 1):
        effect = "vibration" if i == 1 else f"vibration:{i}"
        values[effect] = {"amplitude": q[f"F_{i}"], "frequency": q[f"f_{i}"], "phase": q[f"phi_{i}"]}
    return (models.atm1(n) if n else models.tustin()), values


def _tustin(p: Real, v: Real, t: Real) -> Real:
    F_c, F_s, F_v, v_s = (p[:, i, None] for i in range(4))
    return F_c + (F_s - F_c) * np.exp(-v / v_s) + F_v * v


def _atm1(p: Real, v: Real, t: Real) -> Real:
    total = _tustin(p, v, t)
    for i in range(4, p.shape[1], 3):
        total += p[:, i, None] * _sine(p, i + 1, t)
    return total


def _atm2(p: Real, v: Real, t: Real) -> Real:
    f_c, f_s, f_v, v_s = (p[:, i, None] for i in range(4))
    middle = 4 + (p.shape[1] - 4) // 2
    sliding = sum(_sine(p, i, t) for i in range(4, middle, 2)) * f_c
    viscous = sum(_sine(p, i, t) for i in range(middle, p.shape[1], 2))
    return sliding + (f_s - sliding) * np.exp(-v / v_s) + viscous * f_v * v


def _atm2_printed(p: Real, v: Real, t: Real) -> Real:
    """The exponential's sum has no t as printed: it is that after one unit of time, 1 ms."""
    f_c, f_s, f_v, v_s = (p[:, i, None] for i in range(4))
    unit = np.full(1, effects.PRINTED_TIME_UNIT_S, dtype=t.dtype)
    with_t, constant = (sum(_sine(p, i, at) for i in range(4, p.shape[1], 2)) for at in (t, unit))
    return f_c * with_t + (f_s - f_c * constant) * np.exp(-v / v_s) + f_v * v


def _sine(p: Real, i: int, t: Real) -> Real:
    """sin(2 pi f t + phi) with f, phi = p[:, i], p[:, i + 1], (P, n)."""
    return np.sin((2 * np.pi) * p[:, i, None] * t + p[:, i + 1, None])
