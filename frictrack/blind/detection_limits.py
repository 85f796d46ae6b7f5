"""Compare the detection limits that a diagnosis states with those of the ideal detector."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from frictrack.blind.ideal_detector import IdealDetector, is_event
from frictrack.blind.truth import EffectValues, Truth, effect_named
from frictrack.effects import Effect

N_PHASES = 8  # tried to find the least favourable one


def limits_over_ideal(truth: Truth, limits: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Divide stated detection limits by those of the ideal detector.

    Parameters
    ----------
    truth
        Truth of a study without hidden effect.
    limits
        `detection_limits` of its diagnosis: value and setting ("at") by effect.

    Returns
    -------
    dict
        Ratio by effect; only effects whose size can be compared.

    """
    detector = IdealDetector(truth)
    out = {}
    for name, stated in limits.items():
        if stated["value"] is None or ":" in name or not _comparable(effect_named(name), truth):
            continue
        ideal = ideal_detection_limit(detector, effect_named(name), dict(stated["at"]))
        if ideal is not None:
            out[name] = float(stated["value"]) / ideal
    return out


def _comparable(effect: Effect, truth: Truth) -> bool:
    """Whether an effect has one size, no memory, and needs no signal that the truth lacks.

    A film yields a vertical motion and an angle of each target even where the truth has neither.
    """
    available = {"drive": truth.push, "lift": truth.lift, "clamp_x": truth.clamp, "angle": truth.turn}
    available |= {"earlier": truth.paused}
    known = all(available.get(need, True) for need in effect.needs)
    return known and effect.sized and not effect.memory and not is_event(effect)


def ideal_detection_limit(detector: IdealDetector, effect: Effect, at: dict[str, float]) -> float | None:
    """Smallest size that the ideal detector sees in 95 of 100 repeats.

    Phases and further coefficients take their least favourable values.

    Parameters
    ----------
    detector
        Detector of the study.
    effect
        Effect to detect.
    at
        Values of its non-linear parameters.

    Returns
    -------
    float or None
        Size in the unit of the effect's first coefficient; None if it can never be seen.

    """
    runs = len(detector.base_study.runs)
    phases = [p.name for p in effect.parameters if p.role == "phase"]
    tried = np.arange(N_PHASES) * np.pi / N_PHASES if phases else [0.0]
    forms = [unit_values(effect, at, dict.fromkeys(phases, float(q)), runs) for q in tried]
    rise = min(_rise(detector, effect, form) for form in forms)
    return float(np.sqrt(detector.limit(effect) / rise)) if rise > 1e-12 else None


def _rise(detector: IdealDetector, effect: Effect, form: list[EffectValues]) -> float:
    """Rise of chi-squared by an effect of size one that its further coefficients cannot compensate."""
    first, *others = [p.name for p in effect.linear] or [""]
    left = detector.linear_trace(effect, form)
    for name in others:
        swapped = [{effect.name: values[effect.name] | {first: 0.0, name: 1.0}} for values in form]
        other = detector.linear_trace(effect, swapped)
        left = left - other * float(other @ left) / max(float(other @ other), 1e-300)
    return float(left @ left)


def unit_values(effect: Effect, at: dict[str, float], phases: Mapping[str, float], runs: int) -> list[EffectValues]:
    """Parameter values of an effect of size one in each run; its first coefficient is the size.

    Parameters
    ----------
    effect
        The effect.
    at, phases
        Values of non-linear parameters and of phases, by name.
    runs
        Number of runs.

    Returns
    -------
    list of dict
        Values by effect and parameter, the same for each run.

    """
    size = next(p.name for p in effect.parameters if p.role in ("amplitude", "depth") or p.linear)
    own = {p.name: p.fixed or 0.0 for p in effect.parameters} | at | dict(phases) | {size: 1.0}
    return [{effect.name: own} for _ in range(runs)]
