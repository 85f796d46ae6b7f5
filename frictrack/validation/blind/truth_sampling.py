"""Draw the truth of a study: law, mass, speeds and camera, then hidden effects of a visible size.

The ranges of law, runs and camera do not depend on the hidden effects, whose sizes are multiples of what the ideal
detector sees.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from frictrack import effects
from frictrack.base.errors import FrictrackError
from frictrack.effects import Effect, Parameter, Span
from frictrack.measure.friction import after_run
from frictrack.records import Array, EarlierRuns
from frictrack.validation.blind.ideal_detector import IdealDetector, RunValues, is_event, unexplained_part
from frictrack.validation.blind.truth import FOREIGN, EffectValues, RunTruth, Truth, effect_named, parameter_range

SIZE_RANGE = (2.0, 6.0)  # size over what the ideal detector sees in 95 of 100 repeats
MAX_FORCE_SHARE = 0.4  # rms of a hidden force over that of friction: a larger one is not a refinement of a law
SIZE_TOLERANCE = 0.05  # relative, at which the scaling ends
MAX_ROUNDS = 6
MIN_COSINE = 0.9  # between the trace of an effect and its linearised trace
EVENT_RUN_SHARE = 0.6  # share of the runs in which events happen
SHAKE_RANGE_PX = (0.05, 0.5)  # of a film, whose background shows the shake
MAX_MOMENTUM_SHARE = 0.3  # of the momentum at the start that a collision may take

Rng = np.random.Generator
Names = tuple[str, ...]  # of effects
Range = tuple[float, float]
PlacedEffect = tuple[Truth, Array]  # the study with one hidden effect, and its whitened trace (N,)
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


def place_effect(
    detector: IdealDetector, name: str, rng: Rng, sizes: Range = SIZE_RANGE
) -> tuple[PlacedEffect, float] | None:
    """Put one effect into a study at a random size.

    `detector`: ideal detector of the study without hidden effects; `name`: effect of the library or foreign effect;
    `sizes`: smallest and largest size over the detection limit of the ideal detector. Returns the study with the effect
    and its trace, and the size over the detection limit. None if no such size is possible.
    """
    effect = effect_named(name)
    size = float(np.exp(rng.uniform(*np.log(sizes))))
    shape = _draw_values(detector, effect, rng)
    if effect.test_draw.own_size or (effect.moves_picture and detector.base_study.film):
        found = _checked_placement(detector, effect, shape)
        size = 0.0 if found is None else float(np.linalg.norm(found[1]) / np.sqrt(detector.limit(effect)))
    else:
        found = (_scale_events if is_event(effect) else _scale_to_size)(detector, effect, shape, size)
    return None if found is None else (found, size)


# --- parameters


def _draw_values(detector: IdealDetector, effect: Effect, rng: Rng) -> RunValues:
    """Parameter values of an effect in each run at size one; empty in runs without the event."""
    base_study, trajectories = detector.base_study, detector.trajectories
    span = base_study.span(trajectories)
    shared = {p.name: _draw_value(effect, p, span, rng) for p in effect.parameters if not p.per_run}
    has_phase = any(p.role == "phase" for p in effect.parameters)  # a negative size is a phase shifted by pi
    one_sign = has_phase or effect.test_draw.positive or effect.name in FOREIGN
    sign = 1.0 if one_sign else float(rng.choice([-1.0, 1.0]))
    present = np.ones(len(trajectories), dtype=bool)
    if is_event(effect):
        present = rng.random(len(trajectories)) < EVENT_RUN_SHARE
        present[rng.integers(len(trajectories))] = True
    shake_amplitude = base_study.pitch * float(np.exp(rng.uniform(*np.log(SHAKE_RANGE_PX))))
    out: RunValues = []
    for run, trajectory, is_present in zip(base_study.runs, trajectories, present, strict=True):
        own = base_study.span([trajectory])
        per_run = {p.name: _draw_value(effect, p, own, rng) for p in effect.parameters if p.per_run}
        values_of_run = {p.name: (shared | per_run)[p.name] for p in effect.parameters}
        if effect.moves_picture and base_study.film:
            values_of_run["amplitude"] = shake_amplitude
        if moment := effect.test_draw.between_frames:
            values_of_run[moment] = (np.floor(values_of_run[moment] * base_study.fps) + 0.5) / base_study.fps
        for p in size_parameters(effect):
            one_sided = p.bounds[0] >= 0 or p.role == "amplitude"
            values_of_run[p.name] *= np.sign(run.speed) if effect.test_draw.impulse else 1.0 if one_sided else sign
        out.append({effect.name: values_of_run} if is_present else {})
    return out


def size_parameters(effect: Effect) -> list[Parameter]:
    """Parameters that are proportional to the size of an effect."""
    sizes = [p for p in effect.parameters if p.linear or p.role in ("amplitude", "depth")]
    return sizes or [effect.nonlinear[0]]


def _draw_value(effect: Effect, p: Parameter, span: Span, rng: Rng) -> float:
    """Draw one parameter between the grid points of its scan; sizes are 1, second coefficients at most comparable."""
    if p.fixed is not None:
        return p.fixed
    if p.role == "phase":
        return float(rng.uniform(-np.pi, np.pi))
    if p.scan is not None:
        grid = np.sort(p.scan(span))
        return float(np.interp(rng.uniform(0.05, 0.95) * (len(grid) - 1), np.arange(len(grid)), grid))
    if effect.name in FOREIGN and not p.linear:
        return float(rng.uniform(*parameter_range(p.name, span)))
    uniform = rng.random(2)  # drawn for every effect, so that a study does not depend on which effects use them
    coefficients = effect.test_draw.coefficients
    return float(coefficients(span, uniform).get(p.name, 1.0)) if coefficients else 1.0


# --- size


def _scale_values(effect: Effect, shape: RunValues, factor: float) -> RunValues | None:
    """Multiply the size of an effect; return None if a parameter leaves its bounds."""
    out: RunValues = []
    for values_of_run in shape:
        scaled = dict(values_of_run.get(effect.name, {}))
        for p in size_parameters(effect) if scaled else ():
            scaled[p.name] *= factor
            if not p.bounds[0] <= scaled[p.name] <= p.bounds[1]:
                return None
        out.append({effect.name: scaled} if scaled else {})
    return out


def _checked_placement(detector: IdealDetector, effect: Effect, values: RunValues) -> PlacedEffect | None:
    """Place an effect and compute its trace; None if it is too large or impossible, or its trace is not linear.

    The trace is shortened to the rise that remains when the scatter of the levels must be estimated, as in a
    diagnosis. Near a stop the trace of a large force can differ from the linearised one.
    """
    if effect.acts_on == "force" and not effect.memory and detector.force_share(effect, values) > MAX_FORCE_SHARE:
        return None
    span = detector.base_study.span(detector.trajectories)
    if effect.plausible and all(effect.plausible(of_run[effect.name], span) for of_run in values if of_run):
        return None  # the effect itself objects to its values in every run in which it acts
    pairs = zip(detector.base_study.runs, values, strict=True)
    truth = replace(detector.base_study, runs=tuple(replace(run, values=of_run) for run, of_run in pairs))
    trace, rise = detector.trace_and_rise(truth)
    size = float(np.linalg.norm(trace))
    if not effect.memory:
        first = detector.linear_trace(effect, values)
        if float(first @ trace) < MIN_COSINE * float(np.linalg.norm(first)) * size:
            return None
    return truth, trace * min(np.sqrt(rise) / max(size, 1e-300), 1.0)


def _scale_to_size(detector: IdealDetector, effect: Effect, shape: RunValues, size: float) -> PlacedEffect | None:
    """Scale an effect until its rise of chi-squared is `size` squared times the limit."""
    target = size * np.sqrt(detector.limit(effect))
    factor = target / max(float(np.linalg.norm(detector.linear_trace(effect, shape))), 1e-12)
    if effect.memory:  # the drawn values are the largest plausible ones: at that size it must be visible
        unscaled = _checked_placement(detector, effect, shape)
        factor = target / max(float(np.linalg.norm(unscaled[1])), 1e-12) if unscaled else np.inf
        if factor > 1.0:
            return None
    for _ in range(MAX_ROUNDS):
        values = _scale_values(effect, shape, factor)
        found = None if values is None else _checked_placement(detector, effect, values)
        if found is None:
            return None
        ratio = target / max(float(np.linalg.norm(found[1])), 1e-12)
        if abs(ratio - 1) < SIZE_TOLERANCE:
            return found
        factor *= float(np.clip(ratio, 0.05, 20.0))
    return None


def _scale_events(detector: IdealDetector, effect: Effect, shape: RunValues, size: float) -> PlacedEffect | None:
    """Scale the event of each run so that it is visible by itself."""
    values: RunValues = []
    for i, values_of_run in enumerate(shape):
        if not values_of_run:
            values.append({})
            continue
        single_event = [values_of_run if k == i else {} for k in range(len(shape))]
        found = _scale_to_size(detector, effect, single_event, size)
        if found is None or _exceeds_momentum(found[0], effect, i):
            return None
        values.append(found[0].runs[i].values)
    return _checked_placement(detector, effect, values)


def _exceeds_momentum(truth: Truth, effect: Effect, i: int) -> bool:
    """Whether an impulse takes more than a share of the momentum."""
    if not effect.test_draw.impulse:
        return False
    run = truth.runs[i]
    impulse = run.values[effect.name][effect.linear[0].name]
    return abs(impulse) > MAX_MOMENTUM_SHARE * truth.mass * run.mass_ratio * abs(run.speed)


def candidates(kind: str, law: Names, *, film: bool = False) -> list[str]:
    """List the effects that a study can hide, in a fixed order.

    `kind`: kind of the study, one of `KINDS`; `film`: whether the study consists of films. Returns the names of
    effects.
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
        and (not e.linear or any(p.free for p in e.linear))  # what has one size only can be no multiple of a limit
        and not (e.memory and not e.modifies)  # a model of its own memory needs a drive to show
        and not (e.modifies and not kinds & e.modifies)
        and e.clock is None  # a setting of a run, not an effect of the motion
        and not (e.test_draw.only_with and not kinds & e.test_draw.only_with)
        and "angle" not in e.needs
        and not (film and (e.acts_on == "measurement" or e.needs or e.memory))
    ]


def draw_truth(seed: int, kind: str, turn: int = 0, *, film: bool = False, sizes: Range = SIZE_RANGE) -> Truth:
    """Draw the truth of one study.

    `kind`: "none", "one", "two", "three", "foreign" or "fault": how many effects are hidden, and which; `turn`: number
    of the study among those of its kind; effects take turns, so that all are equally frequent; `film`: whether the
    study consists of films; `sizes`: smallest and largest size of a hidden effect, over what the ideal detector sees in
    95 of 100 repeats. Returns the truth, with hidden effects of a visible size. Raises FrictrackError if no visible
    effect was found in many draws.
    """
    rng = np.random.default_rng([seed, 2026])
    for attempt in range(MAX_EFFECTS_TRIED):
        order = [] if kind == "none" else effects_in_order(kind, film=film)
        first = order[(turn + attempt) % len(order)] if order else None
        fitting = [i for i, (law, _) in enumerate(LAWS) if first is None or first in candidates(kind, law, film=film)]
        shares = np.array([LAWS[i][1] for i in fitting])
        law = LAWS[fitting[int(rng.choice(len(fitting), p=shares / shares.sum()))]][0]
        names = _hidden_effects(kind, law, first, rng, film=film)
        for _ in range(MAX_DRAWS_MEMORY if any(effect_named(n).memory for n in names) else MAX_DRAWS):
            base_study = _draw_base(seed, kind, law, names, rng, film=film)
            found = _try_draw(base_study, names, rng, sizes)
            if found is not None:
                return found
    raise FrictrackError(f"no visible study of kind {kind} was found for seed {seed}; give another seed")


def _try_draw(base_study: Truth, names: Names, rng: Rng, sizes: Range) -> Truth | None:
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


def _hidden_effects(kind: str, law: Names, first: str | None, rng: Rng, *, film: bool) -> Names:
    """Names of the effects to hide: the first one, and random further ones."""
    names = () if first is None else (first,)
    while len(names) < N_HIDDEN.get(kind, 1):
        others = [n for n in candidates(kind, law, film=film) if n not in names and _can_join(n, names)]
        names = (*names, str(rng.choice(others)))
    return names


def _can_join(name: str, hidden: Names) -> bool:
    """Whether an effect can be simulated beside others: only the first may have a memory, and then none modifies."""
    effect = effect_named(name)
    return not effect.memory and not (effect.modifies and any(effect_named(n).memory for n in hidden))


def _log_uniform(rng: Rng, low: float, high: float) -> float:
    """Draw from a log-uniform distribution."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _draw_base(seed: int, kind: str, law: Names, names: Names, rng: Rng, *, film: bool) -> Truth:
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


def _draw_law(names: Names, level: float, rng: Rng) -> EffectValues:
    """Draw the parameters of a base law with a Coulomb friction of `level` N."""
    possible: EffectValues = {
        "coulomb": {"F_c": level},
        "stribeck": {"F_s": level * float(rng.uniform(0.2, 1.0)), "v_s": _log_uniform(rng, 0.1, 0.8), "delta": 1.0},
        "viscous": {"F_v": level * float(rng.uniform(0.02, 0.15))},
        "drag": {"c": level * float(rng.uniform(0.004, 0.03))},
    }
    return {name: possible[name] for name in names}


def _draw_runs(base_study: Truth, rng: Rng) -> Iterator[RunTruth]:
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


def _hide_effects(base_study: Truth, names: Names, rng: Rng, sizes: Range) -> Truth | None:
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
