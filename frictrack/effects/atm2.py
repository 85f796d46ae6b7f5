"""ATM2, the first paper's Eq. 4: as mended, every sum with t, and as printed.

The print drops t in the sums of the exponential's and of the viscous term:

    f = S_c(t) f_c + (f_s - S_c f_c) exp(-|v|/v_s) + S_v f_v v,   S_c(t) = sum sin(omega_i t + phi_i)
                           ^ sum sin(omega_i + phi_i)      ^ sum sin(Omega_j + Phi_j)

A sum without t is the sum with t after one unit of time. The unit is the millisecond: only then are the frequencies of
Tables 3 and 4 those of a vibration. As printed, S_v is one number, which a fit cannot separate from f_v.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np

from frictrack.effects.definition import Effect, Nonlinear, Parameter, Path, RelaxedPart
from frictrack.effects.ranges import frequencies, stribeck_velocities, wave
from frictrack.records import Array

F_C = Parameter("f_c", "N", linear=True, loaded=True)
F_S = Parameter("f_s", "N", linear=True, loaded=True)
F_V = Parameter("f_v", "N s/m", linear=True)
PRINTED_TIME_UNIT_S = 1e-3  # of the printed omega and Omega, rad per millisecond
V_S = Parameter("v_s", "m/s", scan=stribeck_velocities)


def _decay(path: Path, nonlinear: Nonlinear) -> Array:
    return np.asarray(np.exp(-path.speed / nonlinear["v_s"]))


def _sliding(path: Path, nonlinear: Nonlinear) -> Array:
    """What multiplies the sines of the sliding term, (n,)."""
    return path.load * path.s * (1 - _decay(path, nonlinear))


def _static(path: Path, nonlinear: Nonlinear) -> Array:
    return (path.load * path.s * _decay(path, nonlinear))[:, None]


def _sliding_sine(path: Path, own: Nonlinear) -> Array:
    return wave(own["frequency"] * path.t, own["phase"]) * _sliding(path, own)[:, None]


def _printed_sliding_sine(path: Path, own: Nonlinear) -> Array:
    """A sine of the sliding term as printed: constant where the exponential multiplies it."""
    constant = wave(np.full(len(path.t), own["frequency"] * PRINTED_TIME_UNIT_S), own["phase"])
    dry = (path.load * path.s)[:, None]
    return (wave(own["frequency"] * path.t, own["phase"]) - constant * _decay(path, own)[:, None]) * dry


def _viscous_sine(path: Path, own: Nonlinear) -> Array:
    return wave(own["frequency"] * path.t, own["phase"]) * path.v[:, None]


SINE = (
    Parameter("frequency", "Hz", (0.0, np.inf), scan=frequencies),  # printed ones make less than a period in a run
    Parameter("phase", "rad", (-np.pi, np.pi), per_run=True, role="phase"),
)
STATIC = Effect("static", "f_s exp(-|v|/v_s)", (F_S, V_S), _static)
SLIDING = Effect(
    name="sliding",
    equation="f_c sin(2 pi frequency t + phase) (1 - exp(-|v|/v_s))",
    parameters=(replace(F_C, role="amplitude"), V_S, *SINE),
    columns=_sliding_sine,
)
PRINTED_SLIDING = replace(
    SLIDING,
    equation="f_c (sin(2 pi frequency t + phase) - sin(2 pi frequency (1 ms) + phase) exp(-|v|/v_s))",
    columns=_printed_sliding_sine,
)
CONSTANT_VISCOUS = Effect("viscous", "f_v v", (F_V,), lambda path, nonlinear: path.v[:, None])
VISCOUS = Effect(
    name="viscous",
    equation="f_v sin(2 pi frequency t + phase) v",
    parameters=(replace(F_V, role="amplitude"), *SINE),
    columns=_viscous_sine,
)


def _part(effect: Effect, i: int) -> RelaxedPart:
    """One sine of a sum, its amplitude its own."""
    names = (f"{effect.name}_{p.name}_{i}" if p in SINE else p.name for p in effect.parameters)
    return RelaxedPart(effect.called(f"{effect.name}:{i}"), tuple(names))


def _columns(order: int, path: Path, nonlinear: Nonlinear) -> Array:
    """f_c, f_s and f_v columns, shape (n, 3)."""
    sliding, viscous = (
        sum(
            wave(nonlinear[f"{kind}_frequency_{i}"] * path.t, nonlinear[f"{kind}_phase_{i}"])[:, 0]
            for i in range(1, order + 1)
        )
        for kind in ("sliding", "viscous")
    )
    return np.column_stack([sliding * _sliding(path, nonlinear), _static(path, nonlinear), viscous * path.v])


def _printed_columns(order: int, path: Path, nonlinear: Nonlinear) -> Array:
    """f_c, f_s and f_v columns of the printed equation, shape (n, 3)."""
    sines = (
        {"v_s": nonlinear["v_s"]} | {q.name: nonlinear[f"sliding_{q.name}_{i}"] for q in SINE}
        for i in range(1, order + 1)
    )
    return np.column_stack([sum(_printed_sliding_sine(path, own) for own in sines), _static(path, nonlinear), path.v])


def _sines(kind: str, order: int) -> tuple[Parameter, ...]:
    """Frequencies and phases of a sum."""
    return tuple(replace(p, name=f"{kind}_{p.name}_{i}") for i in range(1, order + 1) for p in SINE)


@cache
def atm2(order: int) -> Effect:
    """ATM2 with `order` sines in the sliding and in the viscous term (12 parameters at order 2), every sum with t.

    f = S_c f_c + (f_s - S_c f_c) exp(-|v|/v_s) + S_v f_v v, with S_c = sum sin(omega_i t + phi_i) and
    S_v = sum sin(Omega_j t + Phi_j). For v < 0 the dry part carries sgn v.
    """
    return Effect(
        name=f"atm2:{order}",
        equation=(
            "f_c S_c (1 - exp(-|v|/v_s)) + f_s exp(-|v|/v_s) + f_v S_v v, "
            f"S = sum of {order} sines sin(2 pi frequency t + phase)"
        ),
        parameters=(F_C, F_S, F_V, V_S, *_sines("sliding", order), *_sines("viscous", order)),
        columns=partial(_columns, order),
        varies_with="v",
        relaxed=(
            RelaxedPart(STATIC, ("f_s", "v_s")),
            *(_part(effect, i) for effect in (SLIDING, VISCOUS) for i in range(1, order + 1)),
        ),
        replaces=frozenset({"coulomb", "stribeck", "viscous"}),
        scales_with="load",
        what="Sliding and viscous friction are each multiplied by a sum of sines in time.",
        looks_like="lines in time whose size follows friction and speed",
        mistaken_for="nearly anything slow: its slow sines and v_s can replace each other (nearly unidentifiable)",
        confirm="Compare with load_modulation and viscous_modulation, the freer physical forms.",
        source=f"first paper, Eq. 4, with t restored in the second and third sums; as printed: atm2_printed:{order}",
    )


@cache
def atm2_printed(order: int) -> Effect:
    """ATM2 as printed, with `order` sines in the sliding term; f_v stands for f_v times the constant viscous sum."""
    return replace(
        atm2(order),
        name=f"atm2_printed:{order}",
        equation=(
            "f_c (S(t) - S(1 ms) exp(-|v|/v_s)) + f_s exp(-|v|/v_s) + f_v v, "
            f"S = sum of {order} sines sin(2 pi frequency t + phase)"
        ),
        parameters=(F_C, F_S, F_V, V_S, *_sines("sliding", order)),
        columns=partial(_printed_columns, order),
        relaxed=(
            RelaxedPart(STATIC, ("f_s", "v_s")),
            RelaxedPart(CONSTANT_VISCOUS, ("f_v",)),
            *(_part(PRINTED_SLIDING, i) for i in range(1, order + 1)),
        ),
        what="Sliding friction is multiplied by a sum of sines in time; viscous friction is constant.",
        looks_like="lines in time that grow with the speed",
        source="first paper, Eq. 4 as printed, without t in the second and third sums",
    )
