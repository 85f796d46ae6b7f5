"""Draw the truth of a study: law, mass, speeds and camera from ranges that do not depend on the hidden effects."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from frictrack import effects
from frictrack.blind.effect_placement import SIZE_RANGE, PlacedEffect, place_effect
from frictrack.blind.foreign_effects import FOREIGN
from frictrack.blind.ideal_detector import IdealDetector, unexplained_part
from frictrack.blind.truth import EffectValues, RunTruth, Truth, effect_named
from frictrack.errors import FrictrackError
from frictrack.friction import after_run
from frictrack.records import Array, EarlierRuns

KINDS = ("one", "none", "two", "three", "foreign", "fault")
N_HIDDEN = {"none": 0, "two": 2, "three": 3}  # effects of a study, by kind; one in all others
LAWS = (  # base laws, and the share of each
    (("coulomb", "stribeck", "viscous"), 0.6),
    (("coulomb", "viscous"), 0.25),
    (("coulomb", "drag"), 0.15),
)
PAUSES_S = (5.0, 600.0)  # shortest and longest pause between two runs
UNUSED_SENSOR_SHARE = 0.15  # of the studies measure a drive, a vertical motion or a clamp that no effect needs
PUSH_S = 0.012  # duration of a measured push
MAX_DURATION_S, MAX_FRAMES = 0.25, 900  # of a run
FRAMES_AFTER_STOP = 8
MIN_FRAMES = 80  # of a run
MAX_DRAWS, MAX_DRAWS_MEMORY = 60, 6  # per effect; fewer with memory, because its simulation is slow
MAX_EFFECTS_TRIED = 8  # until one is visible
FILM_CAMERA = {"pitch": 5e-4, "noise_px": 0.0047}  # m; px, as measured on such films


def candidates(kind: str, law: tuple[str, ...], *, film: bool = False) -> list[str]:
    """List the effects that a study can hide, in a fixed order.

    Parameters
    ----------
    kind
        Kind of the study, one of `KINDS`.
    law
        Effects of the base law.
    film
        Whether the study consists of films.

    Returns
    -------
    list of str
        Names of effects.

    """
    if kind == "foreign":
        return list(FOREIGN)
    if kind == "fault":
        return sorted(e.name for e in effects.LIBRARY.values() if e.film_fault)
    kinds = set(law)
    return [
        e.name
        for e in effects.LIBRARY.values()
        if e.name not in law
        and not e.replaces
        and not (e.memory and not e.modifies)  # a model of its own memory needs a drive to show
        and not (e.modifies and not kinds & e.modifies)
        and e.clock is None  # a setting of a run, not an effect of the motion
        and not (e.test_draw.only_with and not kinds & e.test_draw.only_with)
        and "angle" not in e.needs
        and not (film and (e.acts_on == "measurement" or e.needs or e.memory))
    ]


def draw_truth(
    seed: int, kind: str, turn: int = 0, *, film: bool = False, sizes: tuple[float, float] = SIZE_RANGE
) -> Truth:
    """Draw the truth of one study.

    Parameters
    ----------
    seed
        Seed of the draw.
    kind
        "none", "one", "two", "three", "foreign" or "fault": how many effects are hidden, and which.
    turn
        Number of the study among those of its kind; effects take turns, so that all are equally frequent.
    film
        Whether the study consists of films.
    sizes
        Smallest and largest size of a hidden effect, over what the ideal detector sees in 95 of 100 repeats.

    Returns
    -------
    Truth
        The truth, with hidden effects of a visible size.

    Raises
    ------
    FrictrackError
        If no visible effect was found in many draws.

    """
    rng = np.random.default_rng([seed, 2026])
    for attempt in range(MAX_EFFECTS_TRIED):
        first = _effect_in_turn(kind, turn + attempt, film=film)
        law = _draw_law_names(
            rng, [law for law, _ in LAWS if first is None or first in candidates(kind, law, film=film)]
        )
        names = _hidden_effects(kind, law, first, rng, film=film)
        for _ in range(MAX_DRAWS_MEMORY if any(effect_named(n).memory for n in names) else MAX_DRAWS):
            base_study = _draw_base(seed, kind, law, names, rng, film=film)
            found = _try_draw(base_study, names, rng, sizes)
            if found is not None:
                return found
    raise FrictrackError(f"no visible study of kind {kind} was found for seed {seed}; give another seed")


def _try_draw(
    base_study: Truth, names: tuple[str, ...], rng: np.random.Generator, sizes: tuple[float, float]
) -> Truth | None:
    """Draw runs and hide effects; return None if a run is too short or an effect is not visible."""
    try:
        base_study = replace(base_study, runs=tuple(_draw_runs(base_study, rng)))
        if any(run.frames < MIN_FRAMES for run in base_study.runs):
            return None
        return _hide_effects(base_study, names, rng, sizes)
    except FrictrackError:  # a motion that cannot be integrated
        return None


def effects_in_order(kind: str, *, film: bool = False) -> list[str]:
    """List the effects that take turns in the studies of a kind, whatever the base law."""
    return list(dict.fromkeys(n for law, _ in LAWS for n in candidates(kind, law, film=film)))


def _effect_in_turn(kind: str, turn: int, *, film: bool) -> str | None:
    """The effect whose turn it is; None if nothing is hidden."""
    if kind == "none":
        return None
    order = effects_in_order(kind, film=film)
    return order[turn % len(order)]


def _draw_law_names(rng: np.random.Generator, fitting: list[tuple[str, ...]]) -> tuple[str, ...]:
    """Draw one of the base laws that can lack the effect."""
    share = np.array([share for law, share in LAWS if law in fitting])
    return fitting[int(rng.choice(len(fitting), p=share / share.sum()))]


def _hidden_effects(
    kind: str, law: tuple[str, ...], first: str | None, rng: np.random.Generator, *, film: bool
) -> tuple[str, ...]:
    """Names of the effects to hide: the first one, and random further ones."""
    names = () if first is None else (first,)
    while len(names) < N_HIDDEN.get(kind, 1):
        others = [n for n in candidates(kind, law, film=film) if n not in names and _can_join(n, names)]
        names = (*names, str(rng.choice(others)))
    return names


def _can_join(name: str, hidden: tuple[str, ...]) -> bool:
    """Whether an effect can be simulated beside others: only the first may have a memory, and then none modifies."""
    effect = effect_named(name)
    return not effect.memory and not (effect.modifies and any(effect_named(n).memory for n in hidden))


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw from a log-uniform distribution."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _draw_base(
    seed: int, kind: str, law: tuple[str, ...], names: tuple[str, ...], rng: np.random.Generator, *, film: bool
) -> Truth:
    """Draw law and camera, before runs and hidden effects."""
    mass = _log_uniform(rng, 0.05, 2.0)
    needs = {need for name in names for need in effect_named(name).needs}
    has_unused = (rng.random(3) < UNUSED_SENSOR_SHARE) & (not film)
    pushed = "drive" in needs or any(effect_named(n).memory for n in names) or has_unused[0]  # memory shows from rest
    lift = float(10 ** rng.uniform(-0.7, 0.3)), float(rng.uniform(12.0, 40.0))  # m/s^2 and Hz
    max_fps = [effect_named(name).test_draw.max_fps for name in (*law, *names)]
    pitch = FILM_CAMERA["pitch"] if film else _log_uniform(rng, 2e-4, 1e-3)
    return Truth(
        seed=seed,
        kind=kind,
        model=law,
        law=_draw_law(law, mass * _log_uniform(rng, 4.0, 25.0), rng),
        mass=mass,
        fps=min(4000.0 if film else float(rng.choice([2000.0, 4000.0, 4000.0, 6000.0])), *max_fps),
        pitch=pitch,
        noise=pitch * FILM_CAMERA["noise_px"] if film else _log_uniform(rng, 2e-6, 3e-5),
        scatter=float(rng.choice([0.0, 0.01, 0.03, 0.05])),
        course=0.16 if film else float(rng.uniform(0.4, 1.2)),
        push=PUSH_S if pushed else 0.0,
        lift=(lift[0] / (2 * np.pi * lift[1]) ** 2, lift[1]) if "lift" in needs or has_unused[1] else None,
        clamp=float(-rng.uniform(0.0, 0.1)) if "clamp_x" in needs or has_unused[2] else None,
        turn=(_log_uniform(rng, 2e-3, 2e-2), float(rng.uniform(20.0, 60.0))) if "angle" in needs else None,
        stated=bool(rng.random() < 0.7),
        film=film,
        paused="earlier" in needs,
    )


def _draw_law(names: tuple[str, ...], level: float, rng: np.random.Generator) -> EffectValues:
    """Draw the parameters of a base law with a Coulomb friction of `level` N."""
    possible: EffectValues = {
        "coulomb": {"F_c": level},
        "stribeck": {"F_s": level * float(rng.uniform(0.2, 1.0)), "v_s": _log_uniform(rng, 0.1, 0.8), "delta": 1.0},
        "viscous": {"F_v": level * float(rng.uniform(0.02, 0.15))},
        "drag": {"c": level * float(rng.uniform(0.004, 0.03))},
    }
    return {name: possible[name] for name in names}


def _draw_runs(base_study: Truth, rng: np.random.Generator) -> Iterator[RunTruth]:
    """Draw five to eight runs: slow to fast, to a stop if the course is long enough, another mass, reversed."""
    friction = base_study.law["coulomb"]["F_c"]
    stopping_speed = np.sqrt(1.6 * friction / base_study.mass * base_study.course)  # stops within the course
    low = float(np.clip(rng.uniform(0.6, 0.95) * stopping_speed, 1.5, 4.0))
    high = float(rng.uniform(max(low + 1.0, 4.5), 6.0 if base_study.film else 8.0))
    speeds = np.linspace(low, high, int(rng.integers(3, 5)))
    plan = [(float(v), 1.0) for v in speeds] + [(float(np.mean(speeds)), float(rng.choice([0.5, 2.0])))]
    reversed_speeds = rng.choice(speeds, int(rng.integers(1, min(4, 8 - len(plan)))), replace=False)
    plan += [(-float(v), 1.0) for v in reversed_speeds]
    earlier: EarlierRuns | None = () if base_study.paused else None
    for i, (v, ratio) in enumerate(plan):
        level = float(1 + base_study.scatter * rng.standard_normal())
        phase = float(rng.uniform(-np.pi, np.pi))
        run = RunTruth(f"r{i + 1}", v, ratio, level, min(int(MAX_DURATION_S * base_study.fps), MAX_FRAMES), phase)
        run = replace(run, frames=_count_frames(base_study, run), earlier=earlier)
        yield run
        if earlier is not None:
            motion = base_study.trajectory(run, hidden=False)
            earlier = after_run(earlier, motion.duration, motion.distance, _log_uniform(rng, *PAUSES_S))


def _count_frames(base_study: Truth, run: RunTruth) -> int:
    """Number of frames until the run leaves the course, or a few after its stop."""
    trajectory = base_study.trajectory(run, hidden=False)
    outside = np.flatnonzero(np.abs(trajectory.x - trajectory.x[0]) > base_study.course)
    stops = np.flatnonzero(np.abs(trajectory.v) < 1e-9)
    stops = stops[stops > base_study.push * base_study.fps]
    ends = [len(trajectory.t), *(int(q[0]) + n for q, n in ((outside, 0), (stops, FRAMES_AFTER_STOP)) if len(q))]
    return min(ends)


def _hide_effects(
    base_study: Truth, names: tuple[str, ...], rng: np.random.Generator, sizes: tuple[float, float]
) -> Truth | None:
    """Put the effects into the study; return None if one is not visible, alone or with the other ones free."""
    truth, detector = base_study, IdealDetector(base_study)
    hidden = []
    for name in names:
        found = place_effect(detector, name, rng, sizes)
        if found is None:
            return None
        hidden.append(found)
        runs = zip(truth.runs, found[0][0].runs, strict=True)
        truth = replace(truth, runs=tuple(replace(r, values=r.values | a.values) for r, a in runs))
    reached, traces = tuple(size for _, size in hidden), [trace for (_, trace), _ in hidden]
    if len(names) > 1:
        placed = dict(zip(names, (one for one, _ in hidden), strict=True))
        traces = [_trace_beyond_others(detector, name, placed) for name in names]
        limits = [np.sqrt(detector.limit(effect_named(name))) for name in names]
        reached = tuple(float(np.linalg.norm(t) / least) for t, least in zip(traces, limits, strict=True))
        if min(reached) < sizes[0]:
            return None
    rises: Any = tuple(float(t @ t) for t in traces)
    return replace(truth, hidden=names, size=reached, rise=rises)


def _trace_beyond_others(detector: IdealDetector, name: str, placed: dict[str, PlacedEffect]) -> Array:
    """Part of the trace of one effect that free parameters of the other ones cannot explain."""
    others = [_trace_columns(detector, other, one) for other, one in placed.items() if other != name]
    return unexplained_part(placed[name][1], np.hstack(others))


def _trace_columns(detector: IdealDetector, name: str, placed: PlacedEffect) -> Array:
    """Changes of the data by each parameter of an effect, (N, k); one with memory has its size alone."""
    truth, trace_alone = placed
    if effect_named(name).memory:
        return trace_alone[:, None]
    return detector.trace_derivatives(effect_named(name), [run.values for run in truth.runs])
