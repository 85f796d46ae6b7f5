"""Simulate sliding masses of known law, independently of frictrack, as a camera of white noise records them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from derivatives.signals import MASS, MAX_FRAMES, MIN_SPEED, RATE, SLIDE, Array, slide

import frictrack as ft
from frictrack.records import Displacement, Run

LAW = {name: SLIDE[name] for name in ("fc", "fs", "fv", "vs")}  # N, N, N s/m, m/s
LINES = {"F0": 2.0, "f0": 60.0, "phase0": 0.5, "F1": 1.2, "f1": 134.0, "phase1": 2.1}  # N, Hz, rad
DRY_FRICTION = ("fc", "fs")  # what the friction level of a run multiplies
PITCH = 5e-4  # m


@dataclass(frozen=True, eq=False)
class Scene:
    """A law (fc, fs, fv, vs and lines F0, f0, phase0, ...) and runs under it from `speeds` (m/s) down to 0.06 m/s.

    `scatter` is the relative standard deviation of the dry friction from run to run, `model` what frictrack fits.
    """

    name: str
    model: str
    law: Mapping[str, float]
    speeds: tuple[float, ...] = (5.6,)
    scatter: float = 0.0

    def motion(self, run: int, law: Mapping[str, float], start: tuple[float, float], level: float, t: Array) -> Array:
        """Displacement (n,) of a run under any law, start (x m, v m/s) and friction level."""
        dry = {name: level * law[name] for name in DRY_FRICTION}
        moved: Array = slide(dict(law) | dry | {"x": start[0], "v": start[1]}, t)[0]
        return moved

    def frames(self, run: int, level: float = 1.0) -> Array:
        """Times (n,) of the frames until the run is slower than 0.06 m/s."""
        t = np.arange(MAX_FRAMES) / RATE
        dry = {name: level * self.law[name] for name in DRY_FRICTION}
        v = slide(dict(self.law) | dry | {"x": 0.0, "v": self.speeds[run]}, t)[1]
        return t[: int(np.argmax(v < MIN_SPEED))]


SCENES = {
    s.name: s
    for s in (
        Scene("tustin", "tustin", LAW),
        Scene("five", "tustin", LAW, (5.6, 4.9, 4.2, 3.5, 2.8), scatter=0.03),
        Scene("atm1:1", "atm1:1", LAW | {k: v for k, v in LINES.items() if k.endswith("0")}),
        Scene("atm1:2", "atm1:2", LAW | LINES),
    )
}


def films(scene: Scene, noise: float, seed: int, smoother: str = "structural") -> list[Run]:
    """Measured runs of a scene, white noise of `noise` m, smoothed by one of the methods of `low_pass`."""
    rng = np.random.default_rng([seed, sum(map(ord, scene.name)), round(1e9 * noise)])
    levels = 1.0 + scene.scatter * rng.standard_normal(len(scene.speeds))
    return [_film(scene, i, float(level), noise, smoother, rng) for i, level in enumerate(levels)]


@lru_cache(maxsize=64)
def _truth(scene: Scene, run: int, level: float) -> tuple[Array, Array]:
    """Frames (n,) and displacement (n,) of a run."""
    t = scene.frames(run, level)
    return t, scene.motion(run, scene.law, (0.0, scene.speeds[run]), level, t)


def _film(scene: Scene, run: int, level: float, noise: float, smoother: str, rng: np.random.Generator) -> Run:
    t, x = _truth(scene, run, level)
    nan, one = np.full(len(t), np.nan), np.ones(len(t))
    y = x + noise * rng.standard_normal(len(t))
    seen = Displacement(t, y, nan, nan, noise * one, nan, one.astype(bool), pixel_pitch=PITCH)
    return Run(seen, ft.differentiate(ft.low_pass(seen, method=smoother)), mass=MASS, name=f"r{run}")
