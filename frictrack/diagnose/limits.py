"""Detection limits: the smallest effect that would be called missing in 95 of 100 repeats."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.stats import ncx2

from frictrack.diagnose.null import Ensemble
from frictrack.diagnose.tests import Scanned
from frictrack.fit.simulated.scan import ABSORBED, Scan
from frictrack.records import Array

POWER = 0.95
VISITED = 1e-3  # of the usual gain: less belongs to a place, speed or moment that no run comes near


def noncentrality(threshold: float, freedom: int) -> float:
    """Non-centrality of chi-squared with `freedom` degrees that exceeds the threshold with probability `POWER`."""
    return float(brentq(lambda nc: ncx2.sf(threshold, freedom, nc) - POWER, 1e-9, 1e6))


def detection_limit(scanned: Scanned, draws: Ensemble, critical: float) -> tuple[dict[str, Any], dict[str, Array]]:
    """Limit at the least favourable setting that the runs visit, as the JSON has it, and the curve over all settings.

    The amplitude of one coefficient (for events: of the best run) whose expected likelihood ratio passes the
    threshold of the whole search; phases at their worst.
    """
    found = scanned.scans[0]
    family = found.family
    threshold = scanned.quantile + critical
    if len(scanned.scans) > 1:
        threshold += 2 * np.log(len(draws.series.data))
    per_amplitude = _unit_gain(found, draws.left)
    needed = np.sqrt(noncentrality(threshold, family.size) / np.maximum(per_amplitude, 1e-300))
    needed[per_amplitude <= 0] = np.inf
    visited = per_amplitude > VISITED * np.median(per_amplitude)
    worst = int(np.argmax(np.where(visited, needed, 0.0))) if visited.any() else 0
    size = next((p for p in scanned.effect.parameters if p.role in ("amplitude", "depth") or p.linear), None)
    unit = size.unit if size else ""
    at = {p.name: family.point(worst)[p.name] for p in scanned.effect.nonlinear if p.scan is not None}
    curve = dict(zip(family.names, family.values.T, strict=True)) | {"limit": needed}
    value = float(needed[worst]) if np.isfinite(needed[worst]) else None
    reason = None if value is not None else "the fitted law absorbs it whatever its size"
    return {"value": value, "unit": unit, "at": at, "power": POWER, "reason": reason}, curve


def _unit_gain(found: Scan, left: Array) -> Array:
    """Expected likelihood ratio of every form at amplitude one, phases at their worst, (G,)."""
    schur, full = found.schur(left), found.full()
    gains = []
    for i in range(0, schur.shape[1], found.family.k):
        mine = slice(i, i + found.family.k)
        least = np.linalg.eigvalsh(schur[:, mine, mine])[:, 0]
        gains.append(np.where(least > ABSORBED * full[:, mine].sum(axis=1), least, 0.0))  # less is rounding
    return np.asarray(np.sum(gains, axis=0))
