"""Compute what the runs could have shown: detection limits, and the power that a verdict of completeness needs.

A detection limit is the smallest effect that would be called missing in 95 of 100 repeats. A model is called complete
only if each basic effect, at a tenth of the mean friction, would have been detected. Effects that the runs cannot show,
and parameters that they do not determine, make the verdict undetermined.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import chndtrinc

from frictrack.base.number_format import format_plain
from frictrack.diagnose.examination import Examination, NullEnsemble, ScannedCandidate
from frictrack.diagnose.model_selection import MIN_SIGNIFICANCE
from frictrack.effects import Effect
from frictrack.fit import Fit
from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import MIN_COLUMN_SQUARE, MIN_UNEXPLAINED_SHARE, CandidateScan
from frictrack.fit.uncertainty import Estimate, linear_estimates
from frictrack.records import Array

POWER = 0.95  # probability of detection at the limit
MIN_RELATIVE_GAIN = 1e-3  # of the median gain; less means that no run visits the place, speed or time
MIN_DETECTABLE_SHARE = 0.10  # of the mean friction, rms
MAX_NOISE_FACTOR = 5.0  # noise reduction that a laboratory can achieve; beyond it another kind of run is needed
NOT_ESTIMATED = ("fixed", "tied")  # reasons for a parameter without standard deviation that are no fault


def noncentrality(threshold: float, freedom: int) -> float:
    """Non-centrality at which chi-squared exceeds a threshold with probability `POWER`.

    Examples
    --------
    >>> round(noncentrality(3.84, 1), 1)  # (1.96 + 1.645)^2
    13.0

    """
    return float(chndtrinc(threshold, freedom, 1 - POWER))


def detection_limits(first: Examination) -> tuple[dict[str, dict[str, Any]], dict[str, dict[str, Array]]]:
    """Return the detection limit of every scanned effect, and its curve over all settings; see `detection_limit`."""
    limits, curves = {}, {}
    for s in first.scanned:
        limits[s.effect.title], curve = detection_limit(s, first.draws, first.critical)
        curves[s.effect.title] = curve | ({"rise": s.scans[0].gains} if len(s.scans) == 1 else {})
    return limits, curves


def detection_limit(
    scanned: ScannedCandidate, draws: NullEnsemble, critical: float
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Detection limit of one effect.

    It is the first coefficient (for events: of the first run) whose expected likelihood ratio passes the threshold of
    the whole search; phases and further coefficients are at their least favourable.

    `scanned`: the effect's scans; `draws`: data and draws of the null hypothesis; `critical`: critical excess of the
    whole search. Returns `limit`, JSON: value, unit and setting at the least favourable setting that the runs visit;
    `curve`, settings and limit at all G grid points, (G,).
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
    at = {p.name: family.point(worst)[p.name] for p in scanned.effect.nonlinear if p.scan is not None}
    curve = dict(zip(family.names, family.values.T, strict=True)) | {"limit": needed}
    value = float(needed[worst]) if np.isfinite(needed[worst]) else None
    reason = None if value is not None else "the fitted model absorbs it whatever its size"
    return {"value": value, "unit": size.unit if size else "", "at": at, "power": POWER, "reason": reason}, curve


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


@dataclass(frozen=True)
class Undetermined:
    """One thing that the runs leave open: an effect below its detection limit, or a parameter.

    Parameters
    ----------
    what
        Effect or parameter.
    why
        Reason.
    settled_by
        Measurement that would settle it.
    limit
        Smallest detectable size, rms over the mean friction; None if there is none, or for a parameter.
    uncertainty
        Standard deviation of a coefficient over the mean friction, if that leaves the model itself open.

    """

    what: str
    why: str
    settled_by: str
    limit: float | None = None
    uncertainty: float | None = None

    def summary(self) -> dict[str, Any]:
        """Return the entry of the JSON `undetermined`."""
        return {"what": self.what, "why": self.why, "settled_by": self.settled_by, "limit_over_friction": self.limit}


def find_undetermined(
    fit: Fit, first: Examination, curves: Mapping[str, Mapping[str, Array]], grown: Solution | None = None
) -> list[Undetermined]:
    """List what the runs of a fit leave open.

    `curves`: detection limits over all settings, by effect; `grown`: the model with the effects found; None if there
    are none. A coefficient of the law is open if it is uncertain with and without them: without them, its standard
    deviation also holds what the effects explain; with them, it may be uncertain because one of them replaces its
    force.
    """
    friction = mean_friction(first)
    uncertain = list(_uncertain_coefficients(fit.parameters, first, friction))
    if grown is not None and uncertain:
        of_grown = {u.what for u in _uncertain_coefficients(linear_estimates(grown).parameters, first, friction)}
        uncertain = [u for u in uncertain if u.what in of_grown]
    found = [*_undetermined_parameters(fit), *uncertain]
    for scanned in first.scanned:
        name = scanned.effect.title
        if scanned.effect.basic and name == scanned.effect.kind and len(scanned.scans) == 1:
            limit = limit_as_force(first, scanned, curves[name]["limit"]) / friction
            if not limit <= MIN_DETECTABLE_SHARE:
                found.append(_undetectable(name, limit, scanned.effect.confirm))
    return found


def mean_friction(first: Examination) -> float:
    """Mean size of the friction force of a fitted model over its frames, N."""
    forces = [np.abs(s.problem.model.force(s.path, s.values)) for s in first.draws.law.pieces]
    return max(float(np.mean(np.concatenate(forces))), 1e-300)


def limit_as_force(first: Examination, scanned: ScannedCandidate, limits: Array) -> float:
    """Smallest detectable force of an effect at the middle of its scan (in logarithms), N rms, from its limits (G,)."""
    family = scanned.scans[0].grid
    g = _middle_row(family.values)
    unit = [family.raw_columns(s, family.values[g : g + 1])[0, 0] for s in first.draws.law.pieces]  # of one coefficient
    return float(limits[g]) * rms_of_parts(unit)


def rms_of_parts(parts: Sequence[Array]) -> float:
    """Root mean square of values that come in several arrays."""
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def _middle_row(values: Array) -> int:
    """Row of grid points (G, d) nearest to their middle, in logarithms if all are positive."""
    if not values.shape[1]:
        return 0
    scale = np.log(values) if np.all(values > 0) else values
    low, high = scale.min(axis=0), scale.max(axis=0)
    distance = (scale - (low + high) / 2) / np.maximum(high - low, 1e-300)
    return int(np.argmin(np.sum(distance**2, axis=1)))


def _undetermined_parameters(fit: Fit) -> Sequence[Undetermined]:
    """Parameters that the runs do not determine, grouped by reason.

    The shape of an effect whose size is significant leaves nothing open, such as the duration of a short blow.
    """
    groups: dict[str, list[str]] = {}
    sized = _significant_effects(fit)
    for address, found in fit.parameters.items():
        shared = "[" not in address and address.split(".")[0] not in sized
        if shared and found.value is None and found.reason and not found.reason.startswith(NOT_ESTIMATED):
            groups.setdefault(found.reason, []).append(address)
    return [Undetermined(" and ".join(names), *_split_advice(reason)) for reason, names in groups.items()]


def _significant_effects(fit: Fit) -> set[str]:
    """Effects with a coefficient that exceeds three standard deviations in at least one run."""
    heads = {f"{e.name}.{p.name}": e.name for e in fit.model.effects for p in e.linear}
    estimates = ((heads.get(address.split("[")[0]), found) for address, found in fit.parameters.items())
    return {name for name, found in estimates if name and found.is_significant(MIN_SIGNIFICANCE)}


def _uncertain_coefficients(
    known: Mapping[str, Estimate], first: Examination, friction: float
) -> Iterator[Undetermined]:
    """Coefficients of the friction law whose standard deviation is a tenth of the mean friction or more."""
    for effect in first.solution.problem.model.effects:
        for k, p in enumerate(effect.linear):
            found = known.get(f"{effect.name}.{p.name}")
            if not (effect.basic or effect.kind == "coulomb") or p.per_run or found is None or not found.std:
                continue
            pieces = first.draws.law.pieces
            columns = [s.problem.model.force_columns(s.path, s.values)[effect.name][:, k] for s in pieces]
            share = found.std * rms_of_parts(columns) / friction
            if share > MIN_DETECTABLE_SHARE:
                why = f"its standard deviation, {found.std:.2g} {p.unit}, is {100 * share:.0f} % of the mean friction"
                yield Undetermined(f"{effect.name}.{p.name}", why, effect.confirm, uncertainty=share)


def _split_advice(reason: str) -> tuple[str, str]:
    """Split a reason from the advice at its end."""
    why, _, advice = reason.rpartition(": ")
    return (why, advice) if why else (reason, "")


def _undetectable(name: str, limit: float, confirm: str) -> Undetermined:
    """Entry of an effect that would not have been detected."""
    if not np.isfinite(limit):
        return Undetermined(name, "the fitted model absorbs it whatever its size", confirm)
    times = limit / MIN_DETECTABLE_SHARE
    why = f"it would have been detected only above {format_plain(100 * limit, 2)} % of the mean friction"
    advice = f"noise lower by a factor of {times:.2g}, or {int(np.ceil(times**2))} times as many runs"
    return Undetermined(name, why, advice if times < MAX_NOISE_FACTOR else confirm, limit)
