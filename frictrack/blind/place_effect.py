"""A cause is put into a study: its numbers drawn over its own plausible range, its size over what can be seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictrack.blind.foreign_effects import FOREIGN, parameter_range
from frictrack.blind.ideal_detector import IdealDetector, is_event
from frictrack.blind.truth import EffectValues, Truth, effect_named
from frictrack.effects import Effect, Parameter, Span
from frictrack.records import Array

SIZE_RANGE = (2.0, 6.0)  # a hidden cause over what the ideal detector sees in 95 of 100 repeats
MAX_FORCE_SHARE = 0.4  # rms of a hidden force over the friction: a larger cause is no refinement of a law
SIZE_TOLERANCE = 0.05  # relative, to which a size is brought
MAX_ROUNDS = 6
MIN_COSINE = 0.9  # cosine between what a cause leaves and what it leaves to first order
EVENT_RUN_SHARE = 0.6  # share of the runs in which events happen
SHAKE_RANGE_PX = (0.05, 0.5)  # px, of a film: what its background shows
MAX_MOMENTUM_SHARE = 0.3  # of the momentum at the start that a blow may take

PlacedEffect = tuple[Truth, Array]  # the study with one cause in it, and its trace


def place_effect(detector: IdealDetector, name: str, rng: np.random.Generator) -> tuple[PlacedEffect, float] | None:
    """The study with one cause in it, its trace and its size over the limit; None where no fair size is to be had."""
    effect = effect_named(name)
    size = float(np.exp(rng.uniform(*np.log(SIZE_RANGE))))
    shape = _draw_values(detector, effect, rng)
    if effect.test_draw.own_size or (effect.moves_picture and detector.base_study.film):
        found = _check(detector, effect, shape)
        return None if found is None else (found, _size_over_limit(found[1], detector, effect))
    if is_event(effect):
        return _with_size(_scale_events(detector, effect, shape, size), size)
    return _with_size(_scale_to_size(detector, effect, shape, size), size)


def _with_size(found: PlacedEffect | None, size: float) -> tuple[PlacedEffect, float] | None:
    return None if found is None else (found, size)


def _size_over_limit(trace: Array, detector: IdealDetector, effect: Effect) -> float:
    return float(np.linalg.norm(trace) / np.sqrt(detector.limit(effect)))


# --- what it looks like


def _draw_values(detector: IdealDetector, effect: Effect, rng: np.random.Generator) -> list[EffectValues]:
    """Numbers of a cause in every run, its size at one; none where it does not happen."""
    base_study, slides = detector.base_study, detector.slides
    span = base_study.span(slides)
    shared = {p.name: _draw_value(effect, p, span, rng) for p in effect.parameters if not p.per_run}
    phased = any(p.role == "phase" for p in effect.parameters)  # its sign is half a turn of the phase
    plain = phased or effect.test_draw.positive or effect.name in FOREIGN
    sign = 1.0 if plain else float(rng.choice([-1.0, 1.0]))
    present = np.ones(len(slides), dtype=bool)
    if is_event(effect):
        present = rng.random(len(slides)) < EVENT_RUN_SHARE
        present[rng.integers(len(slides))] = True
    shake_amplitude = base_study.pitch * float(np.exp(rng.uniform(*np.log(SHAKE_RANGE_PX))))
    out: list[EffectValues] = []
    for run, slide, present_here in zip(base_study.runs, slides, present, strict=True):
        each = {p.name: _draw_value(effect, p, base_study.span([slide]), rng) for p in effect.parameters if p.per_run}
        own = {p.name: (shared | each)[p.name] for p in effect.parameters}
        if effect.moves_picture and base_study.film:
            own["amplitude"] = shake_amplitude
        if moment := effect.test_draw.between_frames:
            own[moment] = (np.floor(own[moment] * base_study.fps) + 0.5) / base_study.fps
        for p in size_parameters(effect):
            one_sided = p.bounds[0] >= 0 or p.role == "amplitude"
            own[p.name] *= np.sign(run.speed) if effect.test_draw.impulse else 1.0 if one_sided else sign
        out.append({effect.name: own} if present_here else {})
    return out


def size_parameters(effect: Effect) -> list[Parameter]:
    """Parameters that grow with the size of a cause."""
    sizes = [p for p in effect.parameters if p.linear or p.role in ("amplitude", "depth")]
    return sizes or [effect.nonlinear[0]]


def _draw_value(effect: Effect, p: Parameter, span: Span, rng: np.random.Generator) -> float:
    """One number off the grid of its scan; sizes are one, those of a second coefficient at most as telling."""
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
    own = effect.test_draw.coefficients
    return float(own(span, uniform).get(p.name, 1.0)) if own else 1.0


# --- how large it is


def _with_values(detector: IdealDetector, values: list[EffectValues]) -> Truth:
    runs = zip(detector.base_study.runs, values, strict=True)
    return replace(detector.base_study, runs=tuple(replace(run, values=own) for run, own in runs))


def _scaled(effect: Effect, shape: list[EffectValues], factor: float) -> list[EffectValues] | None:
    """The numbers of a cause so many times as large; None beyond its bounds."""
    out: list[EffectValues] = []
    for own in shape:
        of = dict(own.get(effect.name, {}))
        for p in size_parameters(effect) if of else ():
            of[p.name] *= factor
            if not p.bounds[0] <= of[p.name] <= p.bounds[1]:
                return None
        out.append({effect.name: of} if of else {})
    return out


def _check(detector: IdealDetector, effect: Effect, values: list[EffectValues]) -> PlacedEffect | None:
    """The study with the cause in it and its trace; None where it is too large a part of the friction.

    The trace is as long as it stays where the scatter of the levels has to be estimated, as every diagnosis must.
    None, too, where its trace is not the one of first order: near a stop a law can do what its slopes do not tell.
    """
    if effect.acts_on == "force" and not effect.memory and detector.force_share(effect, values) > MAX_FORCE_SHARE:
        return None
    truth = _with_values(detector, values)
    trace, rise = detector.trace_and_rise(truth)
    size = float(np.linalg.norm(trace))
    if not effect.memory:
        first = detector.linear_trace(effect, values)
        if float(first @ trace) < MIN_COSINE * float(np.linalg.norm(first)) * size:
            return None
    return truth, trace * min(np.sqrt(rise) / max(size, 1e-300), 1.0)


def _scale_to_size(
    detector: IdealDetector, effect: Effect, shape: list[EffectValues], size: float
) -> PlacedEffect | None:
    """A cause grown until its rise is `size` squared times the limit."""
    wanted = size * np.sqrt(detector.limit(effect))
    factor = wanted / max(float(np.linalg.norm(detector.linear_trace(effect, shape))), 1e-12)
    if effect.memory:  # its numbers were drawn where they may lie: as large as that it must be seen
        whole = _check(detector, effect, shape)
        factor = wanted / max(float(np.linalg.norm(whole[1])), 1e-12) if whole else np.inf
        if factor > 1.0:
            return None
    for _ in range(MAX_ROUNDS):
        values = _scaled(effect, shape, factor)
        found = None if values is None else _check(detector, effect, values)
        if found is None:
            return None
        ratio = wanted / max(float(np.linalg.norm(found[1])), 1e-12)
        if abs(ratio - 1) < SIZE_TOLERANCE:
            return found
        factor *= float(np.clip(ratio, 0.05, 20.0))
    return None


def _scale_events(
    detector: IdealDetector, effect: Effect, shape: list[EffectValues], size: float
) -> PlacedEffect | None:
    """Events, each as large as it must be to be seen by itself."""
    values: list[EffectValues] = []
    for i, own in enumerate(shape):
        if not own:
            values.append({})
            continue
        alone = [own if k == i else {} for k in range(len(shape))]
        found = _scale_to_size(detector, effect, alone, size)
        if found is None or _exceeds_momentum(found[0], effect, i):
            return None
        values.append(found[0].runs[i].values)
    return _check(detector, effect, values)


def _exceeds_momentum(truth: Truth, effect: Effect, i: int) -> bool:
    """Whether an impulse takes more than a part of the momentum."""
    if not effect.test_draw.impulse:
        return False
    run = truth.runs[i]
    impulse = run.values[effect.name][effect.linear[0].name]
    return abs(impulse) > MAX_MOMENTUM_SHARE * truth.mass * run.mass_ratio * abs(run.speed)
