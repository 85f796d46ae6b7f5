"""Measure frictrack: the limit that a diagnosis states, and the size that it names in 95 of 100 repeats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import frictrack as ft
from diagnosis.studies import BASE, holding, recorded

SIZES_OVER_IDEAL = (0.7, 0.85, 1.0, 1.2, 1.45, 1.75, 2.1)  # of the ideal detector's limit
DETECTION_RATE = 0.95


def stated(seed: int = 0) -> dict[str, dict[str, Any]]:
    """Limits that the diagnosis of a study with nothing hidden states."""
    rng = np.random.default_rng([seed, 1])
    truth = holding(BASE[0], {}, 0.0, rng)
    found = ft.diagnose(ft.fit(list(BASE), recorded(truth, rng)), rng=seed)
    return found.summary()["detection_limits"]


def is_named(name: str, at: dict[str, float], size: float, seed: int) -> bool:
    """Whether one repeat names the effect, or a group in which it stands."""
    rng = np.random.default_rng([seed, 2])
    found = ft.diagnose(ft.fit(list(BASE), recorded(holding(name, at, size, rng), rng)), rng=seed)
    best = found.best
    group = [best.effect, *best.indistinguishable_from] if best is not None and found.missing else []
    return name in found.missing or name in group


def repeated(name: str, at: dict[str, float], ideal: float, repeats: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Share of repeats in which sizes around the ideal detector's limit are named, and the size named in 95 of 100."""
    shares = []
    for times in SIZES_OVER_IDEAL:
        hits = sum(is_named(name, at, times * ideal, seed) for seed in range(repeats))
        shares.append(hits / repeats)
        say(f"  {name} at {times:g} of the ideal limit: named in {hits} of {repeats}")
        if len(shares) > 1 and shares[-1] == shares[-2] == 1.0:
            break
    return {
        "times": list(SIZES_OVER_IDEAL[: len(shares)]),
        "named": shares,
        "size": size_seen(SIZES_OVER_IDEAL, shares, ideal),
    }


def size_seen(ladder: Sequence[float], shares: Sequence[float], ideal: float) -> float | None:
    """Size at which the share reaches `DETECTION_RATE`, interpolated in its logarithm; None beyond the largest size."""
    for k, share in enumerate(shares):
        if share >= DETECTION_RATE:
            if k == 0 or share == shares[k - 1]:
                return ideal * ladder[k]
            part = (DETECTION_RATE - shares[k - 1]) / (share - shares[k - 1])
            return float(ideal * ladder[k - 1] * (ladder[k] / ladder[k - 1]) ** part)
    return None
