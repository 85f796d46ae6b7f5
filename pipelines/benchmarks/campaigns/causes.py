"""The hidden effects, written without frictrack's library: a force in N, or a shift of the picture in m."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Values = dict[str, float]
MIDDLE_SPEED = 5.0  # m/s, at which a force that grows with speed has its size


@dataclass(frozen=True)
class Motion:
    """Motion at one moment: place m, velocity m/s, time s since release, distance m, load ratio, mass ratio."""

    x: float
    v: float
    t: float
    distance: float
    load: float
    mass: float

    @property
    def s(self) -> float:
        """Direction of motion."""
        return 1.0 if self.v >= 0 else -1.0


@dataclass(frozen=True)
class HiddenEffect:
    """Force N of unit size (rms 1 N, about), its drawn values, and whether it shifts the picture instead."""

    force: Callable[[Motion, Values], float]
    draw: Callable[[np.random.Generator], Values]
    is_shift: bool = False
    phase_per_run: bool = False


def _wave(frequency: float, phase: float, at: float) -> float:
    return float(np.sqrt(2) * np.sin(2 * np.pi * frequency * at + phase))


def _patch(m: Motion, q: Values) -> float:
    return 3.0 * m.load * m.s * float(np.exp(-(((m.x - q["x_c"]) / q["w"]) ** 2) / 2))


def _thermal(m: Motion, q: Values) -> float:
    return -2.0 * m.load * m.s * (1 - float(np.exp(-m.distance / q["length"])))


def _phase(rng: np.random.Generator) -> float:
    return float(rng.uniform(-np.pi, np.pi))


EFFECTS = {
    "drag": HiddenEffect(lambda m, q: m.v * abs(m.v) / MIDDLE_SPEED**2, lambda rng: {}),
    "texture": HiddenEffect(
        lambda m, q: m.load * m.s * _wave(1 / q["period"], q["phase"], m.x),
        lambda rng: {"period": float(rng.uniform(0.015, 0.1)), "phase": _phase(rng)},
    ),
    "patch": HiddenEffect(
        _patch, lambda rng: {"x_c": float(rng.uniform(0.15, 0.45)), "w": float(rng.uniform(0.015, 0.04))}
    ),
    "vibration": HiddenEffect(
        lambda m, q: _wave(q["frequency"], q["phase"], m.t),
        lambda rng: {"frequency": float(rng.uniform(30.0, 200.0))},
        phase_per_run=True,
    ),
    "thermal": HiddenEffect(_thermal, lambda rng: {"length": float(rng.uniform(0.08, 0.3))}),
    "drift": HiddenEffect(lambda m, q: m.load * m.s * m.t / 0.06, lambda rng: {}),
    "spring": HiddenEffect(lambda m, q: (m.x - q["x_0"]) / 0.2, lambda rng: {"x_0": float(rng.uniform(0.1, 0.6))}),
    "slope": HiddenEffect(lambda m, q: m.mass, lambda rng: {}),
    "camera_shake": HiddenEffect(
        lambda m, q: _wave(q["frequency"], q["phase"], m.t),
        lambda rng: {"frequency": float(rng.uniform(30.0, 200.0))},
        is_shift=True,
        phase_per_run=True,
    ),
}
