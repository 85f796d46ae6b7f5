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
class Reduction:
    """A law whose linear coefficients are solved by least squares.

    Attributes
    ----------
    nonlinear
        Indices of the non-linear parameters.
    columns
        Function of those q (P, k), of v (n,) and t (n,) that returns force per coefficient, (P, c, n).
    full
        Function of q (k,) and the coefficients (c,) that returns all parameters (d,).

    """

    nonlinear: tuple[int, ...]  # their places among the parameters
    columns: Callable[[Real, Real, Real], Real]  # nonlinear q (P, k), v, t -> N per coefficient, (P, c, n)
    full: Callable[[Array, Array], Array]  # q (k,), coefficients (c,) -> p (d,)


@dataclass(frozen=True)
class PaperLaw:
    """An equation of the papers.

    Attributes
    ----------
    name, names
        Name of the law, and names of its d parameters.
    force
        Function of parameter sets p (P, d), v (n,), m/s, and t (n,), s, that returns the force (P, n), N.
    reductions
        Ways to solve for its linear coefficients.

    """

    name: str
    names: tuple[str, ...]
    force: Callable[[Real, Real, Real], Real]  # p (P, d), v (n,), t (n,) -> N, (P, n)
    reductions: tuple[Reduction, ...]


def tustin() -> PaperLaw:
    """Tustin model, Eq. 2 for v > 0: F_c + (F_s - F_c) exp(-v/v_s) + F_v v.

    Examples
    --------
    >>> float(tustin().force(np.array([[3.0, 5.0, 1.5, 0.5]]), np.array([0.0]), np.array([0.0]))[0, 0])
    5.0

    """
    return PaperLaw("tustin", STATIC, _tustin, (Reduction((3,), lambda q, v, t: _static_columns(q, v), _full_atm1),))


def atm1(n: int) -> PaperLaw:
    """First augmented Tustin model, Eq. 3: Tustin plus n sines in time; frequencies in Hz."""
    names = STATIC + tuple(f"{k}_{i}" for i in range(1, n + 1) for k in ("F", "f", "phi"))
    return PaperLaw(f"atm1:{n}", names, _atm1, (Reduction((3, *range(5, 4 + 3 * n, 3)), _atm1_columns, _full_atm1),))


def atm2(n: int) -> PaperLaw:
    """Second augmented Tustin model, Eq. 4 with the missing t in each sum; frequencies in Hz.

    Sliding sines come first, then viscous ones. It has two reductions: one with phases among the non-linear parameters,
    and one that gives each sine a free amplitude.
    """
    pairs = tuple(f"{k}_{i}" for kind in ("", "v") for i in range(1, n + 1) for k in (f"f{kind}", f"phi{kind}"))
    names = ("f_c", "f_s", "f_v", "v_s", *pairs)
    with_phases = Reduction(tuple(range(3, 4 + 4 * n)), _atm2_columns, lambda q, c: np.concatenate([c, q]))
    free_amplitudes = Reduction((3, *range(4, 4 + 4 * n, 2)), _free_amplitude_columns, _full_free_amplitude)
    return PaperLaw(f"atm2:{n}", names, _atm2, (with_phases, free_amplitudes))


def atm2_printed(n: int) -> PaperLaw:
    """Second augmented Tustin model, Eq. 4 as printed: t in the first sum only; frequencies in Hz.

    f_v stands for f_v times the viscous sum, which is one number.
    """
    names = ("f_c", "f_s", "f_v", "v_s", *(f"{k}_{i}" for i in range(1, n + 1) for k in ("f", "phi")))
    with_phases = Reduction(tuple(range(3, 4 + 2 * n)), _printed_columns, lambda q, c: np.concatenate([c, q]))
    return PaperLaw(f"atm2_printed:{n}", names, _atm2_printed, (with_phases,))


def read_as_printed(source: PrintedLaw) -> Array:
    """Convert the printed parameters of ATM2 for `atm2_printed`: the viscous sum without t goes into f_v."""
    values = np.array(source.values)
    static, (sliding, viscous) = values[:4].copy(), np.split(values[4:], 2)
    static[2] *= np.sin(viscous[::2] + viscous[1::2]).sum()
    sliding[::2] *= PER_MILLISECOND / (2 * np.pi)
    return np.concatenate([static, sliding])


def law_by_name(name: str) -> PaperLaw:
    """Get a law by name.

    Raises
    ------
    FrictrackError
        If the name is not "tustin", "atm1:n" or "atm2:n" (usage).

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
    """Convert printed parameters.

    Parameters
    ----------
    printed
        A printed law.
    unit
        Time unit of its angular frequencies, a key of `UNITS`.

    Returns
    -------
    Array
        Parameters with frequencies in Hz, (d,).

    """
    out = np.array(printed.values)
    for i, name in enumerate(law_by_name(printed.law).names):
        if name.startswith("f") and name[-1].isdigit():
            out[i] *= UNITS[unit] / (2 * np.pi)
    return out


def to_effects(law: PaperLaw, p: Array) -> tuple[Model, Values]:
    """Express a law of the papers by effects of frictrack, for the simulator.

    Parameters
    ----------
    law, p
        The law and its parameters (d,), frequencies in Hz.

    Returns
    -------
    tuple
        Model, and values by effect; there F_s is the rise above F_c.

    """
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
    q = np.concatenate([p[:, 3:4], p[:, 4:]], axis=1)
    columns = _printed_columns(q, v, t)
    return np.einsum("pc,pcn->pn", p[:, :3], columns)


def _sine(p: Real, i: int, t: Real) -> Real:
    """sin(2 pi f t + phi) with f, phi = p[:, i], p[:, i + 1], (P, n)."""
    return np.sin((2 * np.pi) * p[:, i, None] * t + p[:, i + 1, None])


def _static_columns(q: Real, v: Real) -> Real:
    decay = np.exp(-v / q[:, :1])
    return np.stack([1 - decay, decay, np.broadcast_to(v, decay.shape)], axis=1)


def _atm1_columns(q: Real, v: Real, t: Real) -> Real:
    angle = (2 * np.pi) * q[:, 1:, None] * t
    return np.concatenate([_static_columns(q, v), np.sin(angle), np.cos(angle)], axis=1)


def _atm2_columns(q: Real, v: Real, t: Real) -> Real:
    middle = 1 + (q.shape[1] - 1) // 2
    decay = np.exp(-v / q[:, :1])
    sliding = sum(_sine(q, i, t) for i in range(1, middle, 2))
    viscous = sum(_sine(q, i, t) for i in range(middle, q.shape[1], 2))
    return np.stack([sliding * (1 - decay), decay, viscous * v], axis=1)


def _printed_columns(q: Real, v: Real, t: Real) -> Real:
    """Columns of f_c, f_s and f_v as printed: the exponential's sum is that after one unit of time, 1 ms."""
    decay = np.exp(-v / q[:, :1])
    unit = np.full(1, effects.PRINTED_TIME_UNIT_S, dtype=t.dtype)
    with_t, constant = (sum(_sine(q, i, at) for i in range(1, q.shape[1], 2)) for at in (t, unit))
    return np.stack([with_t - constant * decay, decay, np.broadcast_to(v, decay.shape)], axis=1)


def _free_amplitude_columns(q: Real, v: Real, t: Real) -> Real:
    middle = 1 + (q.shape[1] - 1) // 2
    decay = np.exp(-v / q[:, :1])[:, None]
    angle = (2 * np.pi) * q[:, 1:, None] * t
    weight = np.concatenate(
        [np.repeat(1 - decay, middle - 1, axis=1), np.broadcast_to(v, (len(q), middle - 1, len(v)))], axis=1
    )
    return np.concatenate([decay, weight * np.sin(angle), weight * np.cos(angle)], axis=1)


def _polar(c: Array) -> tuple[Array, Array]:
    """Amplitudes and phases from coefficients of sines, then of cosines."""
    sine, cosine = np.split(c, 2)
    return np.hypot(sine, cosine), np.arctan2(cosine, sine)


def _full_atm1(q: Array, c: Array) -> Array:
    lines = np.column_stack([*_polar(c[3:]), q[1:]])[:, [0, 2, 1]]
    return np.concatenate([c[:3], q[:1], lines.ravel()])


def _full_free_amplitude(q: Array, c: Array) -> Array:
    size, phase = _polar(c[1:])
    sliding, viscous = np.split(size, 2)
    static = [sliding.mean(), c[0], viscous.mean(), q[0]]
    return np.concatenate([static, np.column_stack([q[1:], phase]).ravel()])
