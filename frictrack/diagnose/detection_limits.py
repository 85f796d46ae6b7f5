"""Compute detection limits: the smallest effect that would be called missing in 95 of 100 repeats."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import brentq

from frictrack.diagnose.examination import ScannedCandidate
from frictrack.diagnose.null_distribution import NullEnsemble
from frictrack.distributions import noncentral_chi2_sf
from frictrack.effects import Effect
from frictrack.fit.linearised import MIN_COLUMN_SQUARE, MIN_UNEXPLAINED_SHARE, CandidateScan
from frictrack.records import Array

POWER = 0.95  # probability of detection at the limit
MIN_RELATIVE_GAIN = 1e-3  # of the median gain; less means that no run visits the place, speed or time


def noncentrality(threshold: float, freedom: int) -> float:
    """Non-centrality at which chi-squared exceeds a threshold with probability `POWER`.

    Parameters
    ----------
    threshold
        The threshold.
    freedom
        Degrees of freedom.

    Returns
    -------
    float

    Examples
    --------
    >>> round(noncentrality(3.84, 1), 1)  # (1.96 + 1.645)^2
    13.0

    """
    return float(brentq(lambda nc: noncentral_chi2_sf(threshold, freedom, nc) - POWER, 1e-9, 1e6))


def detection_limit(
    scanned: ScannedCandidate, draws: NullEnsemble, critical: float
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Detection limit of one effect.

    It is the first coefficient (for events: of the first run) whose expected likelihood ratio passes the threshold of
    the whole search; phases and further coefficients are at their least favourable.

    Parameters
    ----------
    scanned
        The effect's scans.
    draws
        Data and draws of the null hypothesis.
    critical
        Critical excess of the whole search.

    Returns
    -------
    limit : dict
        JSON: value, unit and setting at the least favourable setting that the runs visit.
    curve : dict of ndarray
        Settings and limit at all G grid points, (G,).

    """
    first_scan = scanned.scans[0]
    family = first_scan.grid
    threshold = scanned.quantile + critical
    if len(scanned.scans) > 1:
        threshold += 2 * np.log(len(draws.series.measured))
    per_amplitude = _unit_gain(first_scan, draws.unbounded_projector)
    needed = np.sqrt(noncentrality(threshold, family.size) / np.maximum(per_amplitude, 1e-300))
    needed[per_amplitude <= 0] = np.inf
    visited = per_amplitude > MIN_RELATIVE_GAIN * np.median(per_amplitude)
    worst = int(np.argmax(np.where(visited, needed, 0.0))) if visited.any() else 0
    size = next((p for p in scanned.effect.parameters if p.role in ("amplitude", "depth") or p.linear), None)
    unit = size.unit if size else ""
    at = {p.name: family.point(worst)[p.name] for p in scanned.effect.nonlinear if p.scan is not None}
    curve = dict(zip(family.names, family.values.T, strict=True)) | {"limit": needed}
    value = float(needed[worst]) if np.isfinite(needed[worst]) else None
    reason = None if value is not None else "the fitted model absorbs it whatever its size"
    return {"value": value, "unit": unit, "at": at, "power": POWER, "reason": reason}, curve


def _unit_gain(scan: CandidateScan, projector: Array) -> Array:
    """Expected likelihood ratio of every grid point at size one, other coefficients least favourable, (G,)."""
    of_block = _wave_gain if _is_wave(scan.grid.effect) else _first_coefficient_gain
    least, whole = of_block(scan.schur(projector), scan.squares)
    return np.asarray(np.sum(np.where(least > MIN_UNEXPLAINED_SHARE * whole, least, 0.0), axis=1))  # less is rounding


def _wave_gain(schur: Array, full: Array) -> tuple[Array, Array]:
    """Gain per amplitude (G, B) of sine and cosine coefficients, and the square of the columns."""
    return np.asarray(np.linalg.eigvalsh(schur)[..., 0], dtype=np.float64), full.sum(axis=-1)


def _first_coefficient_gain(schur: Array, full: Array) -> tuple[Array, Array]:
    """Gain (G, B) per unit of the first coefficient with the others free, and the square of its column."""
    size = np.sqrt(full[..., 1:])
    size[full[..., 1:] < MIN_COLUMN_SQUARE] = np.inf  # columns of places that no run reaches
    unit = schur[..., 1:, 1:] / size[..., :, None] / size[..., None, :]
    across = schur[..., 1:, 0] / size
    inverse = np.linalg.pinv(unit, rcond=MIN_UNEXPLAINED_SHARE, hermitian=True)
    return schur[..., 0, 0] - np.einsum("...i,...ij,...j->...", across, inverse, across), full[..., 0]


def _is_wave(effect: Effect) -> bool:
    """Whether coefficients are sine and cosine of one size, or changes that a lag makes to other effects."""
    return any(p.role == "phase" and p.free for p in effect.nonlinear) or (bool(effect.modifies) and not effect.sized)
