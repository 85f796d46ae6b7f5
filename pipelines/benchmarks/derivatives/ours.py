"""Run frictrack's smoothers through its public stages, with the noise level that a tracker would state."""

from __future__ import annotations

import numpy as np

import frictrack as ft
from frictrack.records import Displacement

from .estimate import Array, Estimate, Method

OTHERS = ("butterworth", "savitzky-golay", "kalman", "gaussian-process", "papers")


def frictrack(noise: float, **options: str) -> Method:
    """low_pass and differentiate with the options given to low_pass."""

    def estimate(t: Array, y: Array) -> Estimate:
        unknown = np.full(len(t), np.nan)
        level = np.full(len(t), noise)
        valid = np.ones(len(t), dtype=bool)
        record = Displacement(t, y, unknown, unknown, level, unknown, valid)
        motion = ft.differentiate(ft.low_pass(record, **options))
        return Estimate(motion.x, motion.v, motion.a, motion.sigma_x, motion.sigma_v, motion.sigma_a)

    return estimate


def methods(noise: float) -> dict[str, Method]:
    """The default, and every other smoother that low_pass offers by name."""
    return {"frictrack": frictrack(noise)} | {f"frictrack {name}": frictrack(noise, method=name) for name in OTHERS}
