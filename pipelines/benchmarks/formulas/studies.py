"""Simulate sealed studies: six runs under Coulomb and viscous friction with one cause more, integrated by scipy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

import frictrack as ft
from formulas.causes import CAUSES, Cause
from frictrack.records import Array, Displacement, Run
from frictrack.validation.blind.ideal_detector import noncentrality_limit

FPS, NOISE, SCATTER, PITCH = 4000.0, 1e-5, 0.02, 5e-4
PLAN = (
    (0.6, 1.0),
    (0.75, 1.0),
    (1.0, 1.0),
    (0.8, 2.0),
    (-0.7, 1.0),
    (-0.95, 1.0),
)  # share of top speed, mass ratio
MAX_DURATION_S, COURSE = 0.12, 0.6
TIMES_LIMIT = 3.0  # size of a cause over the ideal detection limit
FORMS = 60  # independent forms of a scan, for the ideal limit
STEP = 1e-3


@dataclass(frozen=True)
class Bare:
    """The system without the cause: mass kg, friction N and N s/m, start speed m/s and load ratio of every run."""

    mass: float
    dry: float
    viscous: float
    speeds: tuple[float, ...]
    ratios: tuple[float, ...]
    levels: tuple[float, ...]
    times: tuple[Array, ...]


@dataclass(frozen=True)
class Sealed:
    """A study of known truth: name of the cause, its values, and the runs."""

    name: str
    values: dict[str, float]
    runs: list[Run]
    rise: float


def draw(seed: int, name: str | None) -> Sealed:
    """Draw a study that hides the cause of a name, or nothing."""
    rng = np.random.default_rng([seed, 77])
    bare = _bare(rng)
    tracks = [_slide(bare, i) for i in range(len(PLAN))]
    values: dict[str, float] = {}
    rise = 0.0
    if name is not None:
        values, rise = _sized(bare, tracks, CAUSES[name], rng)
        tracks = [_slide(bare, i, CAUSES[name], values) for i in range(len(PLAN))]
    runs = [_measured(bare, i, x, rng) for i, (x, _) in enumerate(tracks)]
    return Sealed(name or "", values, runs, rise)


def _bare(rng: np.random.Generator) -> Bare:
    mass = float(np.exp(rng.uniform(np.log(0.1), np.log(1.0))))
    deceleration = float(rng.uniform(6.0, 20.0))
    top = float(rng.uniform(4.0, 7.0))
    levels = tuple(float(1 + SCATTER * z) for z in rng.standard_normal(len(PLAN)))
    times = []
    for share, _ in PLAN:
        speed = abs(share) * top
        duration = min(MAX_DURATION_S, 0.7 * speed / (1.6 * deceleration), COURSE / speed)
        times.append(np.arange(int(duration * FPS)) / FPS)
    dry = mass * deceleration
    viscous = dry * float(rng.uniform(0.02, 0.15))
    return Bare(mass, dry, viscous, tuple(s * top for s, _ in PLAN), tuple(r for _, r in PLAN), levels, tuple(times))


def _slide(  # noqa: PLR0913 - what may be changed to measure a sensitivity
    bare: Bare,
    i: int,
    cause: Cause | None = None,
    values: dict[str, float] | None = None,
    *,
    dry: float = 1.0,
    viscous: float = 1.0,
    level: float = 1.0,
    start: tuple[float, float] = (0.0, 0.0),
) -> tuple[Array, Array]:
    """Position and velocity of one run, with the law changed by factors and the start by a shift."""
    s = float(np.sign(bare.speeds[i]))
    load = bare.ratios[i] * bare.levels[i] * level

    def change(t: float, z: Array) -> list[float]:
        force = bare.dry * dry * load * s + bare.viscous * viscous * z[1]
        if cause is not None and values is not None:
            force += values["F"] * float(cause.force(z[0], s * z[1], t, s, load, values))
        return [z[1], -force / (bare.mass * bare.ratios[i])]

    begin = [(0.05 if s > 0 else 0.65) + start[0], bare.speeds[i] + start[1]]
    t = bare.times[i]
    x, v = solve_ivp(change, (0, t[-1]), begin, t_eval=t, rtol=1e-10, atol=1e-12, max_step=5e-4).y
    return x, v


def _sized(
    bare: Bare, tracks: list[tuple[Array, Array]], cause: Cause, rng: np.random.Generator
) -> tuple[dict[str, float], float]:
    """Values of a cause at `TIMES_LIMIT` times the ideal detection limit, and the rise of chi-squared they make."""
    reached = {
        "x": np.concatenate([x for x, _ in tracks]),
        "v": np.abs(np.concatenate([v for _, v in tracks])),
        "t": np.concatenate(bare.times),
    }[cause.axis]
    low, high = float(reached.min()), float(reached.max())
    values = {}
    for q, (a, b) in (cause.draws or {}).items():
        share = float(rng.uniform(a, b))
        values[q] = low + share * (high - low) if q == "c" else share * (high - low)
    limit = noncentrality_limit(1, FORMS)
    size = 0.02 * bare.dry
    for _ in range(3):  # the response is not quite linear
        rise = _rise(bare, tracks, cause, values | {"F": size})
        size *= float(np.sqrt(TIMES_LIMIT**2 * limit / rise))
    sign = float(rng.choice([-1.0, 1.0])) if cause.axis != "v" else 1.0
    return values | {"F": sign * size}, TIMES_LIMIT**2 * limit


def _rise(bare: Bare, tracks: list[tuple[Array, Array]], cause: Cause, values: dict[str, float]) -> float:
    """Chi-squared by the cause that starts, law and scattered levels cannot explain."""
    runs = range(len(PLAN))
    sizes = [len(t) for t in bare.times]

    def trace(change: Callable[[int], Array]) -> Array:
        return np.concatenate([(change(i) - tracks[i][0]) / NOISE for i in runs])

    def alone(i: int, part: Array) -> Array:
        return np.concatenate([part if k == i else np.zeros(sizes[k]) for k in runs])

    shared = [
        trace(lambda i: _slide(bare, i, dry=1 + STEP)[0]),
        trace(lambda i: _slide(bare, i, viscous=1 + STEP)[0]),
    ]
    own, levels = [], []
    for i in runs:
        own += [
            alone(i, (_slide(bare, i, start=shift)[0] - tracks[i][0]) / NOISE) for shift in ((1e-4, 0.0), (0.0, 1e-3))
        ]
        levels.append(alone(i, (_slide(bare, i, level=1 + STEP)[0] - tracks[i][0]) / NOISE / STEP))
    columns = np.column_stack([*shared, *own, *levels])
    held = np.zeros((len(PLAN), columns.shape[1]))
    held[:, -len(PLAN) :] = np.eye(len(PLAN)) / SCATTER
    whole = np.vstack([columns, held])
    whole /= np.linalg.norm(whole, axis=0)
    moved = np.append(trace(lambda i: _slide(bare, i, cause, values)[0]), np.zeros(len(PLAN)))
    left = moved - whole @ np.linalg.lstsq(whole, moved, rcond=1e-11)[0]
    return float(left @ left)


def _measured(bare: Bare, i: int, x: Array, rng: np.random.Generator) -> Run:
    """A run seen with white noise."""
    n = len(x)
    nan = np.full(n, np.nan)
    seen = Displacement(
        bare.times[i],
        x + NOISE * rng.standard_normal(n),
        nan,
        nan,
        np.full(n, NOISE),
        nan,
        np.ones(n, dtype=bool),
        pixel_pitch=PITCH,
    )
    motion = ft.differentiate(ft.low_pass(seen, method="kalman"))
    return Run(seen, motion, mass=bare.mass * bare.ratios[i], name=f"r{i + 1}")
