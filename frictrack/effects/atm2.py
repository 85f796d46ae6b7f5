"""ATM2, the first paper's Eq. 4 as printed, every sum read with t (NOTES 2)."""

from __future__ import annotations

from functools import cache

import numpy as np

from frictrack.effects.base import Effect, Nonlinear, Parameter, Path, frequencies, wave
from frictrack.effects.stribeck import speeds
from frictrack.records import Array


def _sum_of_sines(path: Path, nonlinear: Nonlinear, kind: str, order: int) -> Array:
    waves = (
        wave(nonlinear[f"{kind}_frequency_{i}"] * path.t, nonlinear[f"{kind}_phase_{i}"])[:, 0]
        for i in range(1, order + 1)
    )
    return np.sum(list(waves), axis=0)


@cache
def atm2(order: int) -> Effect:
    """ATM2 with `order` sines in the sliding and in the viscous term (12 parameters at order 2).

    f = S_c f_c + (f_s - S_c f_c) exp(-|v|/v_s) + S_v f_v v, with S_c = sum sin(omega_i t + phi_i) and
    S_v = sum sin(Omega_j t + Phi_j). For v < 0 the dry part carries sgn v.
    """

    def columns(path: Path, nonlinear: Nonlinear) -> Array:
        """f_c, f_s and f_v columns, shape (n, 3)."""
        decay = np.exp(-path.speed / nonlinear["v_s"])
        sliding = _sum_of_sines(path, nonlinear, "sliding", order)
        viscous = _sum_of_sines(path, nonlinear, "viscous", order)
        dry = path.load * path.s
        return np.column_stack([dry * sliding * (1 - decay), dry * decay, viscous * path.v])

    lines = tuple(
        parameter
        for kind in ("sliding", "viscous")
        for i in range(1, order + 1)
        for parameter in (
            Parameter(f"{kind}_frequency_{i}", "Hz", scan=frequencies),
            Parameter(f"{kind}_phase_{i}", "rad", (-np.pi, np.pi), per_run=True, role="phase"),
        )
    )
    return Effect(
        name=f"atm2:{order}",
        acts_on="force",
        equation=(
            "f_c S_c (1 - exp(-|v|/v_s)) + f_s exp(-|v|/v_s) + f_v S_v v, "
            f"S = sum of {order} sines sin(2 pi frequency t + phase)"
        ),
        parameters=(
            Parameter("f_c", "N", linear=True, loaded=True),
            Parameter("f_s", "N", linear=True, loaded=True),
            Parameter("f_v", "N s/m", linear=True),
            Parameter("v_s", "m/s", scan=speeds),
            *lines,
        ),
        columns=columns,
        replaces=frozenset({"coulomb", "stribeck", "viscous"}),
        scales_with="load",
        what="Sliding and viscous friction are each multiplied by a sum of sines in time.",
        looks_like="lines in time whose size follows friction and speed",
        mistaken_for="nearly anything slow: its slow sines and v_s trade places (nearly unidentifiable)",
        confirm="Compare with load_modulation and viscous_modulation, the freer physical forms.",
        source="first paper, Eq. 4, with t restored in the second and third sums",
    )
