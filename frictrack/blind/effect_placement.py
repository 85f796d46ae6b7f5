"""Put a hidden effect into a study: draw its parameters, and scale it to a multiple of the ideal detection limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictrack.blind.foreign_effects import FOREIGN, parameter_range
from frictrack.blind.ideal_detector import IdealDetector, is_event
from frictrack.blind.truth import EffectValues, Truth, effect_named
from frictrack.effects import Effect, Parameter, Span
from frictrack.records import Array

SIZE_RANGE = (2.0, 6.0)  # size over what the ideal detector sees in 95 of 100 repeats
MAX_FORCE_SHARE = 0.4  # rms of a hidden force over that of friction: a larger one is not a refinement of a law
SIZE_TOLERANCE = 0.05  # relative, at which the scaling ends
MAX_ROUNDS = 6
MIN_COSINE = 0.9  # between the trace of an effect and its linearised trace
EVENT_RUN_SHARE = 0.6  # share of the runs in which events happen
SHAKE_RANGE_PX = (0.05, 0.5)  # of a film, whose background shows the shake
MAX_MOMENTUM_SHARE = 0.3  # of the momentum at the start that a collision may take

PlacedEffect = tuple[Truth, Array]  # the study with one hidden effect, and its whitened trace (N,)


def place_effect(
    detector: IdealDetector, name: str, rng: np.random.Generator, sizes: tuple[float, float] = SIZE_RANGE
) -> tuple[PlacedEffect, float] | None:
    """Put one effect into a study at a random size.

    Parameters
    ----------
    detector
        Ideal detector of the study without hidden effects.
    name
        Effect of the library or foreign effect.
    rng
        Source of the draws.
    sizes
        Smallest and largest size over the detection limit of the ideal detector.

    Returns
    -------
    tuple or None
        The study with the effect and its trace, and the size over the detection limit. None if no such size is
        possible.

    """
    effect = effect_named(name)
    size = float(np.exp(rng.uniform(*np.log(sizes))))
    shape = _draw_values(detector, effect, rng)
    if effect.test_draw.own_size or (effect.moves_picture and detector.base_study.film):
        found = _checked_placement(detector, effect, shape)
        return None if found is None else (found, _size_over_limit(found[1], detector, effect))
    if is_event(effect):
        return _with_size(_scale_events(detector, effect, shape, size), size)
    return _with_size(_scale_to_size(detector, effect, shape, size), size)


def _with_size(found: PlacedEffect | None, size: float) -> tuple[PlacedEffect, float] | None:
    """Pair a placed effect with its size; None stays None."""
    return None if found is None else (found, size)


def _size_over_limit(trace: Array, detector: IdealDetector, effect: Effect) -> float:
    """Size of a trace over that at the detection limit."""
    return float(np.linalg.norm(trace) / np.sqrt(detector.limit(effect)))


# --- parameters


def _draw_values(detector: IdealDetector, effect: Effect, rng: np.random.Generator) -> list[EffectValues]:
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
    out: list[EffectValues] = []
    for run, trajectory, is_present in zip(base_study.runs, trajectories, present, strict=True):
        per_run = {
            p.name: _draw_value(effect, p, base_study.span([trajectory]), rng) for p in effect.parameters if p.per_run
        }
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


def _draw_value(effect: Effect, p: Parameter, span: Span, rng: np.random.Generator) -> float:
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


def _with_values(detector: IdealDetector, values: list[EffectValues]) -> Truth:
    """The study with the values of one effect in its runs."""
    runs = zip(detector.base_study.runs, values, strict=True)
    return replace(detector.base_study, runs=tuple(replace(run, values=values_of_run) for run, values_of_run in runs))


def _scale_values(effect: Effect, shape: list[EffectValues], factor: float) -> list[EffectValues] | None:
    """Multiply the size of an effect; return None if a parameter leaves its bounds."""
    out: list[EffectValues] = []
    for values_of_run in shape:
        scaled = dict(values_of_run.get(effect.name, {}))
        for p in size_parameters(effect) if scaled else ():
            scaled[p.name] *= factor
            if not p.bounds[0] <= scaled[p.name] <= p.bounds[1]:
                return None
        out.append({effect.name: scaled} if scaled else {})
    return out


def _checked_placement(detector: IdealDetector, effect: Effect, values: list[EffectValues]) -> PlacedEffect | None:
    """Place an effect and compute its trace; None if it is too large or impossible, or its trace is not linear.

    The trace is shortened to the rise that remains when the scatter of the levels must be estimated, as in a
    diagnosis. Near a stop the trace of a large force can differ from the linearised one.
    """
    if effect.acts_on == "force" and not effect.memory and detector.force_share(effect, values) > MAX_FORCE_SHARE:
        return None
    if _is_impossible(detector, effect, values):
        return None
    truth = _with_values(detector, values)
    trace, rise = detector.trace_and_rise(truth)
    size = float(np.linalg.norm(trace))
    if not effect.memory:
        first = detector.linear_trace(effect, values)
        if float(first @ trace) < MIN_COSINE * float(np.linalg.norm(first)) * size:
            return None
    return truth, trace * min(np.sqrt(rise) / max(size, 1e-300), 1.0)


def _is_impossible(detector: IdealDetector, effect: Effect, values: list[EffectValues]) -> bool:
    """Whether the effect itself objects to its values in every run in which it acts."""
    if effect.plausible is None:
        return False
    span = detector.base_study.span(detector.trajectories)
    return all(effect.plausible(of_run[effect.name], span) for of_run in values if of_run)


def _scale_to_size(
    detector: IdealDetector, effect: Effect, shape: list[EffectValues], size: float
) -> PlacedEffect | None:
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


def _scale_events(
    detector: IdealDetector, effect: Effect, shape: list[EffectValues], size: float
) -> PlacedEffect | None:
    """Scale the event of each run so that it is visible by itself."""
    values: list[EffectValues] = []
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
