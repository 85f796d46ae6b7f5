"""A cause is put into a study: its numbers drawn over its own plausible range, its size over what can be seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frictrack.blind.detector import Detector, is_event
from frictrack.blind.foreign import FOREIGN, reach
from frictrack.blind.truth import Numbers, Truth, made
from frictrack.effects import Effect, Parameter, Span
from frictrack.records import Array

SIZES = (2.0, 6.0)  # a hidden cause over what the ideal detector sees in 95 of 100 repeats
LARGEST = 0.4  # rms of a hidden force over the friction: a larger cause is no refinement of a law
CLOSE = 0.05  # relative, to which a size is brought
ROUNDS = 6
LIKE = 0.9  # cosine between what a cause leaves and what it leaves to first order
OFTEN = 0.6  # share of the runs in which events happen
SHAKEN = (0.05, 0.5)  # px, of a film: what its background shows
BLOW = 0.3  # of the momentum at the start that a blow may take
POSITIVE = ("drag", "spring", "measured_load")  # causes with one sign

Hidden = tuple[Truth, Array]  # the study with one cause in it, and its trace


def hide(detector: Detector, name: str, rng: np.random.Generator) -> tuple[Hidden, float] | None:
    """The study with one cause in it, its trace and its size over the limit; None where no fair size is to be had."""
    effect = made(name)
    size = float(np.exp(rng.uniform(*np.log(SIZES))))
    shape = _shape(detector, effect, rng)
    if effect.name == "dropped_frame" or (effect.name == "camera_shake" and detector.bare.film):  # as large as it is
        found = _checked(detector, effect, shape)
        return None if found is None else (found, _times(found[1], detector, effect))
    if is_event(effect):
        return _with_size(_events(detector, effect, shape, size), size)
    return _with_size(_grown(detector, effect, shape, size), size)


def _with_size(found: Hidden | None, size: float) -> tuple[Hidden, float] | None:
    return None if found is None else (found, size)


def _times(trace: Array, detector: Detector, effect: Effect) -> float:
    return float(np.linalg.norm(trace) / np.sqrt(detector.limit(effect)))


# --- what it looks like


def _shape(detector: Detector, effect: Effect, rng: np.random.Generator) -> list[Numbers]:
    """Numbers of a cause in every run, its size at one; none where it does not happen."""
    bare, slides = detector.bare, detector.slides
    span = bare.span(slides)
    shared = {p.name: _value(effect, p, span, rng) for p in effect.parameters if not p.per_run}
    phased = any(p.role == "phase" for p in effect.parameters)  # its sign is half a turn of the phase
    plain = phased or effect.name in POSITIVE or effect.name in FOREIGN
    sign = 1.0 if plain else float(rng.choice([-1.0, 1.0]))
    there = np.ones(len(slides), dtype=bool)
    if is_event(effect):
        there = rng.random(len(slides)) < OFTEN
        there[rng.integers(len(slides))] = True
    shaken = bare.pitch * float(np.exp(rng.uniform(*np.log(SHAKEN))))
    out: list[Numbers] = []
    for run, slide, happens in zip(bare.runs, slides, there, strict=True):
        each = {p.name: _value(effect, p, bare.span([slide]), rng) for p in effect.parameters if p.per_run}
        own = {p.name: (shared | each)[p.name] for p in effect.parameters}
        if effect.name == "camera_shake" and bare.film:
            own["amplitude"] = shaken
        if effect.name == "dropped_frame":  # between two frames
            own["time"] = (np.floor(own["time"] * bare.fps) + 0.5) / bare.fps
        for p in sizes_of(effect):
            one_sided = p.bounds[0] >= 0 or p.role == "amplitude"
            own[p.name] *= np.sign(run.speed) if effect.name == "collision" else 1.0 if one_sided else sign
        out.append({effect.name: own} if happens else {})
    return out


def sizes_of(effect: Effect) -> list[Parameter]:
    """Parameters that grow with the size of a cause."""
    sizes = [p for p in effect.parameters if p.linear or p.role in ("amplitude", "depth")]
    return sizes or [effect.nonlinear[0]]


def _value(effect: Effect, p: Parameter, span: Span, rng: np.random.Generator) -> float:
    """One number off the grid of its scan; sizes are one, those of a second coefficient at most as telling."""
    if p.fixed is not None:
        return p.fixed
    if p.role == "phase":
        return float(rng.uniform(-np.pi, np.pi))
    if p.scan is not None:
        grid = np.sort(p.scan(span))
        return float(np.interp(rng.uniform(0.05, 0.95) * (len(grid) - 1), np.arange(len(grid)), grid))
    if effect.name in FOREIGN and not p.linear:
        return float(rng.uniform(*reach(p.name, span)))
    second = {  # a spring's rest lies on the course; of a viscous asymmetry there is at most as much as of a dry one
        ("spring", "x_0"): -rng.uniform(span.x_min, span.x_max),
        ("asymmetry", "dF_v"): rng.uniform(-1.0, 1.0) / span.v_max,
    }
    return float(second.get((effect.name, p.name), 1.0))


# --- how large it is


def _placed(detector: Detector, values: list[Numbers]) -> Truth:
    runs = zip(detector.bare.runs, values, strict=True)
    return replace(detector.bare, runs=tuple(replace(run, values=own) for run, own in runs))


def _scaled(effect: Effect, shape: list[Numbers], factor: float) -> list[Numbers] | None:
    """The numbers of a cause so many times as large; None beyond its bounds."""
    out: list[Numbers] = []
    for own in shape:
        of = dict(own.get(effect.name, {}))
        for p in sizes_of(effect) if of else ():
            of[p.name] *= factor
            if not p.bounds[0] <= of[p.name] <= p.bounds[1]:
                return None
        out.append({effect.name: of} if of else {})
    return out


def _checked(detector: Detector, effect: Effect, values: list[Numbers]) -> Hidden | None:
    """The study with the cause in it and its trace; None where it is too large a part of the friction.

    The trace is as long as it stays where the scatter of the levels has to be estimated, as every diagnosis must.
    None, too, where its trace is not the one of first order: near a stop a law can do what its slopes do not tell.
    """
    if effect.acts_on == "force" and not effect.memory and detector.share(effect, values) > LARGEST:
        return None
    truth = _placed(detector, values)
    trace, rise = detector.shown(truth)
    size = float(np.linalg.norm(trace))
    if not effect.memory:
        first = detector.unit(effect, values)
        if float(first @ trace) < LIKE * float(np.linalg.norm(first)) * size:
            return None
    return truth, trace * min(np.sqrt(rise) / max(size, 1e-300), 1.0)


def _grown(detector: Detector, effect: Effect, shape: list[Numbers], size: float) -> Hidden | None:
    """A cause grown until its rise is `size` squared times the limit."""
    wanted = size * np.sqrt(detector.limit(effect))
    factor = wanted / max(float(np.linalg.norm(detector.unit(effect, shape))), 1e-12)
    if effect.memory:  # its numbers were drawn where they may lie: as large as that it must be seen
        whole = _checked(detector, effect, shape)
        factor = wanted / max(float(np.linalg.norm(whole[1])), 1e-12) if whole else np.inf
        if factor > 1.0:
            return None
    for _ in range(ROUNDS):
        values = _scaled(effect, shape, factor)
        found = None if values is None else _checked(detector, effect, values)
        if found is None:
            return None
        ratio = wanted / max(float(np.linalg.norm(found[1])), 1e-12)
        if abs(ratio - 1) < CLOSE:
            return found
        factor *= float(np.clip(ratio, 0.05, 20.0))
    return None


def _events(detector: Detector, effect: Effect, shape: list[Numbers], size: float) -> Hidden | None:
    """Events, each as large as it must be to be seen by itself."""
    values: list[Numbers] = []
    for i, own in enumerate(shape):
        if not own:
            values.append({})
            continue
        alone = [own if k == i else {} for k in range(len(shape))]
        found = _grown(detector, effect, alone, size)
        if found is None or _too_hard(found[0], i):
            return None
        values.append(found[0].runs[i].values)
    return _checked(detector, effect, values)


def _too_hard(truth: Truth, i: int) -> bool:
    """Whether a blow takes more than a part of the momentum."""
    run = truth.runs[i]
    impulse = run.values.get("collision", {}).get("J", 0.0)
    return abs(impulse) > BLOW * truth.mass * run.mass_ratio * abs(run.speed)
