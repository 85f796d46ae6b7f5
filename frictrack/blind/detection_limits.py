"""Detection limits of a diagnosis beside those of the ideal detector, at the same settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from frictrack.blind.ideal_detector import IdealDetector, is_event
from frictrack.blind.truth import EffectValues, Truth, effect_named
from frictrack.effects import Effect

N_PHASES = 8  # tried for the least favourable one


def limits_over_ideal(truth: Truth, limits: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Stated limit over the ideal detector's, for every effect whose limit is a size at a setting."""
    detector = IdealDetector(truth)
    out = {}
    for name, stated in limits.items():
        if stated["value"] is None or ":" in name or not _comparable(effect_named(name), truth):
            continue
        least = ideal_detection_limit(detector, effect_named(name), dict(stated["at"]))
        if least is not None:
            out[name] = float(stated["value"]) / least
    return out


def _comparable(effect: Effect, truth: Truth) -> bool:
    """Whether an effect has one size, no memory that only a whole simulation shows, and what it needs is in the truth.

    A film shows a vertical motion and an angle of every target, where in truth there is neither.
    """
    there = {"drive": truth.push, "lift": truth.lift, "clamp_x": truth.clamp, "angle": truth.turn}
    known = all(there.get(need, True) for need in effect.needs)
    return known and effect.sized and not effect.memory and not is_event(effect)


def ideal_detection_limit(detector: IdealDetector, effect: Effect, at: dict[str, float]) -> float | None:
    """Smallest size that the ideal detector sees in 95 of 100 repeats; None if it never can.

    Phases, and what further coefficients an effect has, are at their least favourable.
    """
    runs = len(detector.base_study.runs)
    phases = [p.name for p in effect.parameters if p.role == "phase"]
    tried = np.arange(N_PHASES) * np.pi / N_PHASES if phases else [0.0]
    forms = [unit_values(effect, at, dict.fromkeys(phases, float(q)), runs) for q in tried]
    least = min(_rise(detector, effect, form) for form in forms)
    return float(np.sqrt(detector.limit(effect) / least)) if least > 1e-12 else None


def _rise(detector: IdealDetector, effect: Effect, form: list[EffectValues]) -> float:
    """Rise by an effect of size one, its further coefficients hiding what they can of it."""
    first, *others = [p.name for p in effect.linear] or [""]
    left = detector.linear_trace(effect, form)
    for name in others:
        swapped = [{effect.name: own[effect.name] | {first: 0.0, name: 1.0}} for own in form]
        other = detector.linear_trace(effect, swapped)
        left = left - other * float(other @ left) / max(float(other @ other), 1e-300)
    return float(left @ left)


def unit_values(effect: Effect, at: dict[str, float], phases: Mapping[str, float], runs: int) -> list[EffectValues]:
    """Numbers of an effect of size one, the first coefficient carrying it."""
    size = next(p.name for p in effect.parameters if p.role in ("amplitude", "depth") or p.linear)
    own = {p.name: p.fixed or 0.0 for p in effect.parameters} | at | dict(phases) | {size: 1.0}
    return [{effect.name: own} for _ in range(runs)]
