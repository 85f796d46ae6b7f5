"""The papers' laws as plain functions of speed and time, for a whole population of parameter sets at once.

This is the papers' objective to the letter: friction along the *measured* v and t. Parameters are rows p (P, d).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack import models
from frictrack.errors import FrictrackError
from frictrack.models import Model, Values
from frictrack.records import Array
from frictrack.reproduce.printed import Printed

Real = NDArray[np.floating[Any]]
SECOND, MILLISECOND = 1.0, 1e3  # 1/s: the papers' "rad/s" may be per second, per millisecond or per sample
PER_FRAME = 4000.0
UNITS = {"second": SECOND, "millisecond": MILLISECOND, "sample": PER_FRAME}
STATIC = ("F_c", "F_s", "F_v", "v_s")


@dataclass(frozen=True)
class Reduction:
    """A law with its coefficients left to least squares: what remains to be searched."""

    nonlinear: tuple[int, ...]  # their places among the parameters
    columns: Callable[[Real, Real, Real], Real]  # nonlinear q (P, k), v, t -> N per coefficient, (P, c, n)
    full: Callable[[Array, Array], Array]  # q (k,), coefficients (c,) -> p (d,)


@dataclass(frozen=True)
class Law:
    """An equation of the papers: its parameters by name and its force."""

    name: str
    names: tuple[str, ...]
    force: Callable[[Real, Real, Real], Real]  # p (P, d), v (n,), t (n,) -> N, (P, n)
    reductions: tuple[Reduction, ...]


def tustin() -> Law:
    """Eq. 2 with |v| and sgn(v) read into it (v > 0 here): F_c + (F_s - F_c) exp(-v/v_s) + F_v v."""
    return Law("tustin", STATIC, _tustin, (Reduction((3,), lambda q, v, t: _static_columns(q, v), _full_atm1),))


def atm1(n: int) -> Law:
    """Eq. 3: Tustin plus n sines in time; frequencies in Hz."""
    names = STATIC + tuple(f"{k}_{i}" for i in range(1, n + 1) for k in ("F", "f", "phi"))
    return Law(f"atm1:{n}", names, _atm1, (Reduction((3, *range(5, 4 + 3 * n, 3)), _atm1_columns, _full_atm1),))


def atm2(n: int) -> Law:
    """Eq. 4 with t restored in every sum; sliding sines first, then viscous ones; frequencies in Hz.

    Reduced twice: with the phases searched too, and as a freer law in which every sine has an amplitude of its own.
    """
    pairs = tuple(f"{k}_{i}" for kind in ("", "v") for i in range(1, n + 1) for k in (f"f{kind}", f"phi{kind}"))
    names = ("f_c", "f_s", "f_v", "v_s", *pairs)
    strict = Reduction(tuple(range(3, 4 + 4 * n)), _atm2_columns, lambda q, c: np.concatenate([c, q]))
    freer = Reduction((3, *range(4, 4 + 4 * n, 2)), _freer_columns, _full_freer)
    return Law(f"atm2:{n}", names, _atm2, (strict, freer))


def named(name: str) -> Law:
    """The law of a name such as "tustin" or "atm1:2"."""
    kind, _, order = name.partition(":")
    makers: dict[str, Callable[[int], Law]] = {"atm1": atm1, "atm2": atm2}
    if name == "tustin":
        return tustin()
    if kind not in makers or not order.isdigit():
        raise FrictrackError(f'expected a law of the papers (tustin, atm1:2, atm2:2) but got "{name}"', usage=True)
    return makers[kind](int(order))


def read(printed: Printed, unit: str) -> Array:
    """Printed parameters (d,) with frequencies in Hz, their "rad/s" read as rad per `unit` (a key of `UNITS`)."""
    out = np.array(printed.values)
    for i, name in enumerate(named(printed.law).names):
        if name.startswith("f") and name[-1].isdigit():
            out[i] *= UNITS[unit] / (2 * np.pi)
    return out


def library(law: Law, p: Array) -> tuple[Model, Values]:
    """The same law in frictrack's own effects, for the simulator; F_s there is the rise over F_c."""
    kind, _, order = law.name.partition(":")
    q = dict(zip(law.names, map(float, p), strict=True))
    n = int(order or 0)
    if kind == "atm2":
        own = {k: q[k] for k in ("f_c", "f_s", "f_v", "v_s")}
        for i in range(1, n + 1):
            own |= {f"sliding_frequency_{i}": q[f"f_{i}"], f"sliding_phase_{i}": q[f"phi_{i}"]}
            own |= {f"viscous_frequency_{i}": q[f"fv_{i}"], f"viscous_phase_{i}": q[f"phiv_{i}"]}
        return models.atm2(n), {law.name: own}
    values = {
        "coulomb": {"F_c": q["F_c"]},
        "stribeck": {"F_s": q["F_s"] - q["F_c"], "v_s": q["v_s"], "delta": 1.0},
        "viscous": {"F_v": q["F_v"]},
    }
    for i in range(1, n + 1):
        line = "vibration" if i == 1 else f"vibration:{i}"
        values[line] = {"amplitude": q[f"F_{i}"], "frequency": q[f"f_{i}"], "phase": q[f"phi_{i}"]}
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


def _sine(p: Real, i: int, t: Real) -> Real:
    """sin(2 pi f t + phi) with f, phi = p[:, i], p[:, i + 1]."""
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


def _freer_columns(q: Real, v: Real, t: Real) -> Real:
    middle = 1 + (q.shape[1] - 1) // 2
    decay = np.exp(-v / q[:, :1])[:, None]
    angle = (2 * np.pi) * q[:, 1:, None] * t
    weight = np.concatenate(
        [np.repeat(1 - decay, middle - 1, axis=1), np.broadcast_to(v, (len(q), middle - 1, len(v)))], axis=1
    )
    return np.concatenate([decay, weight * np.sin(angle), weight * np.cos(angle)], axis=1)


def _polar(c: Array) -> tuple[Array, Array]:
    """Amplitudes and phases of coefficients of sines, then of cosines."""
    along, across = np.split(c, 2)
    return np.hypot(along, across), np.arctan2(across, along)


def _full_atm1(q: Array, c: Array) -> Array:
    lines = np.column_stack([*_polar(c[3:]), q[1:]])[:, [0, 2, 1]]
    return np.concatenate([c[:3], q[:1], lines.ravel()])


def _full_freer(q: Array, c: Array) -> Array:
    size, phase = _polar(c[1:])
    sliding, viscous = np.split(size, 2)
    static = [sliding.mean(), c[0], viscous.mean(), q[0]]
    return np.concatenate([static, np.column_stack([q[1:], phase]).ravel()])
