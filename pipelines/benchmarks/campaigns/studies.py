"""Simulate the runs of a campaign on demand: a sliding mass of hidden law and effect, integrated by scipy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

import frictrack as ft
from campaigns.causes import EFFECTS, Motion, Values
from frictrack.records import GRAVITY, Array, Displacement, Run

FPS, NOISE, PITCH, SCATTER = 4000.0, 1e-5, 5e-4, 0.02
COURSE = (0.05, 0.65)  # m
SPEEDS = (2.0, 8.0)  # m/s, that the set-up reaches
MAX_DURATION_S = 0.25
MIN_SPEED = 0.02  # m/s; a slower mass has stopped
SIZE = (0.05, 0.2)  # rms of a hidden force over dry friction
SHAKE = (1.0, 4.0)  # rms of a hidden shift over the noise
LAWS = (["coulomb", "viscous"], ["coulomb", "stribeck", "viscous"])


@dataclass(frozen=True)
class Settings:
    """What a person sets before a film: velocity m/s with its sign, mass over the first one, incline rad."""

    velocity: float
    mass: float = 1.0
    incline: float = 0.0


@dataclass(frozen=True)
class Campaign:
    """The truth: law, mass kg, hidden effect with its values and size (N, or m)."""

    seed: int
    model: tuple[str, ...]
    mass: float
    dry: float
    viscous: float
    rise: float
    stribeck_velocity: float
    hidden: str
    values: Values
    size: float

    @property
    def stopping_speed(self) -> float:
        """Start speed at which the mass stops after the whole course, m/s."""
        return float(np.sqrt(2 * self.dry / self.mass * (COURSE[1] - COURSE[0])))

    def fixed_design(self) -> list[Settings]:
        """Six runs as a laboratory plans them beforehand: slow to a stop, two faster, heavier, and two back."""
        low = float(np.clip(0.85 * self.stopping_speed, SPEEDS[0], 4.5))
        middle, high = (low + 7.0) / 2, 7.0
        return [
            Settings(low),
            Settings(middle),
            Settings(high),
            Settings(middle, mass=2.0),
            Settings(-middle),
            Settings(-high),
        ]

    def film(self, settings: Settings, number: int) -> Run:
        """Film one run; its noise, friction level and phase depend on its number in the campaign alone."""
        rng = np.random.default_rng([self.seed, 31, number])
        level, phase = 1 + SCATTER * float(rng.standard_normal()), float(rng.uniform(-np.pi, np.pi))
        t, x = self._slide(settings, level, phase)
        n, nan = len(t), np.full(len(t), np.nan)
        y = x + NOISE * rng.standard_normal(n)
        seen = Displacement(t, y, nan, nan, np.full(n, NOISE), nan, np.ones(n, dtype=bool), pixel_pitch=PITCH)
        motion = ft.differentiate(ft.low_pass(seen, method="kalman"))
        mass = self.mass * settings.mass
        return Run(seen, motion, mass=mass, name=f"r{number}", incline=settings.incline)

    def _slide(self, settings: Settings, level: float, phase: float) -> tuple[Array, Array]:
        """Times and recorded places of one run until it stops or leaves the course."""
        s, mass = float(np.sign(settings.velocity)), self.mass * settings.mass
        load = settings.mass * float(np.cos(settings.incline)) * level
        values = self.values | ({"phase": phase} if self.hidden and EFFECTS[self.hidden].phase_per_run else {})
        effect = EFFECTS.get(self.hidden)

        def hidden(t: float, x: float, v: float) -> float:
            if effect is None:
                return 0.0
            return self.size * effect.force(Motion(x, v, t, abs(x - begin), load, settings.mass), values)

        def change(t: float, z: Array) -> list[float]:
            x, v = z
            dry = self.dry + self.rise * float(np.exp(-abs(v) / self.stribeck_velocity))
            force = s * load * dry + self.viscous * v
            if effect is not None and not effect.is_shift:
                force += hidden(t, x, v)
            return [v, -force / mass - GRAVITY * float(np.sin(settings.incline))]

        def stopped(t: float, z: Array) -> float:
            return s * z[1] - MIN_SPEED

        def gone(t: float, z: Array) -> float:
            return min(z[0] - COURSE[0], COURSE[1] - z[0]) + 1e-6

        for event in (stopped, gone):
            event.terminal = True  # type: ignore[attr-defined]
        begin = COURSE[0] if s > 0 else COURSE[1]
        frames = np.arange(int(MAX_DURATION_S * FPS)) / FPS
        found = solve_ivp(
            change, (0, frames[-1]), [begin, settings.velocity], t_eval=frames, events=[stopped, gone],
            rtol=1e-10, atol=1e-12, max_step=5e-4,
        )  # fmt: skip
        t, x = found.t, found.y[0]
        if effect is not None and effect.is_shift:
            x = x + np.array([hidden(*row) for row in zip(t, x, found.y[1], strict=True)])
        return t, x


def draw(seed: int, hidden: str) -> Campaign:
    """Draw a campaign that hides an effect, or nothing ("")."""
    rng = np.random.default_rng([seed, 30])
    mass = float(np.exp(rng.uniform(np.log(0.1), np.log(1.0))))
    dry = mass * float(rng.uniform(6.0, 20.0))
    model = LAWS[int(rng.integers(2))]
    rise = dry * float(rng.uniform(0.2, 1.0)) if "stribeck" in model else 0.0
    low, high = SHAKE if hidden and EFFECTS[hidden].is_shift else SIZE
    size = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    size *= NOISE if hidden and EFFECTS[hidden].is_shift else dry
    return Campaign(
        seed=seed,
        model=tuple(model),
        mass=mass,
        dry=dry,
        viscous=dry * float(rng.uniform(0.02, 0.15)),
        rise=rise,
        stribeck_velocity=float(np.exp(rng.uniform(np.log(0.1), np.log(0.8)))),
        hidden=hidden,
        values=EFFECTS[hidden].draw(rng) if hidden else {},
        size=size,
    )
