"""Simulate the study on which limits are compared: five runs, 3 % scatter, 10 um, and one effect or none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import frictrack as ft
from frictrack.effects import LIBRARY
from frictrack.records import Displacement, Run
from frictrack.validation.blind import run_table
from frictrack.validation.blind.ideal_detector import IdealDetector, unit_values
from frictrack.validation.blind.truth import RunTruth, Truth, effect_named

BASE = ("coulomb", "stribeck", "viscous")
SPEEDS = ((2.2, 1.0), (4.0, 1.0), (5.5, 1.0), (4.0, 2.0), (-3.0, 1.0))  # m/s, mass over the reference
BARE = Truth(
    seed=0,
    kind="none",
    model=BASE,
    law={
        "coulomb": {"F_c": 2.8},
        "stribeck": {"F_s": 1.6, "v_s": 0.35, "delta": 1.0},
        "viscous": {"F_v": 0.3},
    },
    mass=0.35,
    fps=4000.0,
    pitch=5e-4,
    noise=1e-5,
    scatter=0.03,
    course=0.7,
    runs=tuple(
        RunTruth(f"r{i + 1}", v, ratio, 1.0, int(min(0.72 / abs(v), 0.22) * 4000))
        for i, (v, ratio) in enumerate(SPEEDS)
    ),
)
EFFECTS = [  # with one size, told by such runs: not by a drive, a lift, a clamp, an angle, nor event by event
    e.name
    for e in LIBRARY.values()
    if e.name not in BASE
    and not (e.replaces or e.memory or e.needs not in ((), ("pixel_pitch",)))
    and e.sized
    and not any(p.per_run and p.scan is not None for p in e.parameters)
]


def detector() -> IdealDetector:
    """The ideal detector of the study."""
    return IdealDetector(BARE)


def holding(name: str, at: dict[str, float], size: float, rng: np.random.Generator) -> Truth:
    """The study with one effect of a size at a setting, and new levels; phases and scatter as they come."""
    effect = effect_named(name)
    phases = [p for p in effect.parameters if p.role == "phase"]
    shared = {p.name: float(rng.uniform(-np.pi, np.pi)) for p in phases}
    runs = []
    for run in BARE.runs:
        own = {p.name: float(rng.uniform(-np.pi, np.pi)) if p.per_run else shared[p.name] for p in phases}
        values = unit_values(effect, at, own, 1)[0] if size else {}
        for key in [p.name for p in effect.parameters if p.role in ("amplitude", "depth") or p.linear][:1]:
            if size:
                values[name][key] = size
        level = 1 + BARE.scatter * float(rng.standard_normal())
        runs.append(replace(run, values=values, level=level))
    return replace(BARE, runs=tuple(runs))


def recorded(truth: Truth, rng: np.random.Generator) -> list[Run]:
    """What a camera of white noise recorded of it."""
    return [_recorded(truth, run, rng) for run in truth.runs]


def _recorded(truth: Truth, run: RunTruth, rng: np.random.Generator) -> Run:
    data = run_table(truth, run, rng)
    n = len(data)
    nan, noise = np.full(n, np.nan), np.full(n, truth.noise)
    given = {name: data[name].to_numpy() for name in data}
    displacement = Displacement(
        given["t_s"],
        given["x_m"],
        given.get("y_m", nan),
        nan,
        given.get("sigma_m", noise),
        nan,
        np.ones(n, dtype=bool),
        pixel_pitch=truth.pitch,
    )
    motion = ft.differentiate(ft.low_pass(displacement))
    return Run(
        displacement,
        motion,
        mass=truth.mass * run.mass_ratio,
        name=run.name,
        drive=given.get("drive_N"),
        clamp_x=truth.clamp,
    )
