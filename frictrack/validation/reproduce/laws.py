"""The papers' friction laws as functions of measured speed and time, and the values that the papers print."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack import effects
from frictrack.base.errors import UsageError
from frictrack.effects import models
from frictrack.effects.models import Model, Values
from frictrack.records import Array

PAPERS = {
    "first": "Research on parameter identification of nonlinear friction on cantilever beam",
    "second": "Research on friction parameter identification under the influence of vibration and collision",
}


@dataclass(frozen=True)
class PrintedLaw:
    """One printed law.

    Attributes
    ----------
    law
        "tustin", "atm1:2" or "atm2:2".
    where
        Table or section.
    values
        Parameters in the order of `laws.PaperLaw.names`: forces (N), speeds (m/s), angular frequencies ("rad/s"),
        phases (rad).
    speed
        Start speed of the group, m/s.
    error
        Printed error, without a unit.

    """

    law: str
    where: str
    values: tuple[float, ...]
    speed: float | None
    error: float | None = None


# First paper, section 3.1: F_c, F_s, F_v, v_s.
TM = {
    "low": PrintedLaw("tustin", "section 3.1 (1)", (13.5698, 57.2303, 8.376, 0.5712), 5.0),
    "high": PrintedLaw("tustin", "section 3.1 (2)", (12.9804, 37.2733, 12.306, 0.862), 8.0),
}
# Tables 1 and 2: F_c, F_s, F_v, v_s, then F_i, omega_i, phi_i of either sine.
ATM1 = {
    "low": PrintedLaw(
        "atm1:2",
        "Table 1",
        (29.9773, 43.6321, 4.7892, 0.2881, 38.2913, 0.0198, -0.4921, 151.2731, 0.0548, 1.0582),
        5.0,
        4.22e3,
    ),
    "high": PrintedLaw(
        "atm1:2",
        "Table 2",
        (32.3294, 45.1892, 6.8931, 0.4219, 42.3214, 0.2031, -0.5391, 182.3912, 0.0612, 2.0103),
        8.0,
        8.06e2,
    ),
}
# Tables 3 and 4: f_c, f_s, f_v, v_s, then omega_i, phi_i (sliding), then Omega_j, Phi_j (viscous).
ATM2 = {
    "low": PrintedLaw(
        "atm2:2",
        "Table 3",
        (35.7298, 42.7981, 22.3214, 0.6042, 2.1302, 0.7092, 0.4902, 1.1932, 1.1021, 1.4128, 1.9037, 0.0653),
        5.0,
        1.37e3,
    ),
    "high": PrintedLaw(
        "atm2:2",
        "Table 4",
        (37.5031, 47.3242, 8.9972, 0.5310, 1.5021, 0.2910, 0.5921, 2.4532, 0.3402, 0.0324, 0.9935, 0.3801),
        8.0,
        3.42e2,
    ),
}
# Second paper, Tables 1 and 2 (the second is captioned "without" but is the result with the sine filter).
WITHOUT_FILTER = PrintedLaw("tustin", "second paper, Table 1", (10.0, 17.8104, 5.0, 0.2512), None)
WITH_FILTER = PrintedLaw(
    "atm1:2",
    "second paper, Table 2",
    (4.0266, 12.7125, 14.7817, 1.9551, 1.5971, 2.8556, 0.3363, 0.2665, 0.7038, 0.8242),
    None,
)
IMPACT_ENERGY = 2.0  # J, second paper

GAIN_ATM1, GAIN_ATM2 = 0.09, 3.0  # "the identification accuracy raises by" 9 % and 300 % from n = 2 to 3

EQ8_MAXIMUM, EQ8_PLACE = 3.8503, 1.8505
TABLE_5 = {"GA": (34.14, 0.315051), "MGA": (29.86, 0.316321)}  # generations, seconds
TABLE_6 = {"10 bits": (3.6792, 0.184956), "20 bits": (3.8503, 0.294762), "adaptive": (3.8503, 0.210445)}
TABLE_7 = {"GA": (689.22, 15.2982, 0.30), "MGA": (479.86, 9.3094, 0.06)}  # iterations, seconds, local optima
RUNS = 50  # simulations behind Tables 5 and 7


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
        raise UsageError(f'expected a law of the papers (tustin, atm1:2, atm2:2) but got "{name}"')
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
