"""Compute what the runs could have shown: the power that a verdict of completeness needs.

A model is called complete only if each basic effect, at a tenth of the mean friction, would have been detected. Effects
that the runs cannot show, and parameters that they do not determine, make the verdict undetermined.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictrack.diagnose.admissible import MIN_SIGNIFICANCE
from frictrack.diagnose.examination import Examination, ScannedCandidate
from frictrack.fit import Fit
from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised import LinearisedPiece
from frictrack.fit.uncertainty import Estimate, linear_estimates
from frictrack.number_format import format_plain
from frictrack.records import Array

MIN_DETECTABLE_SHARE = 0.10  # of the mean friction, rms
MAX_NOISE_FACTOR = 5.0  # noise reduction that a laboratory can achieve; beyond it another kind of run is needed
NOT_ESTIMATED = ("fixed", "tied")  # reasons for a parameter without standard deviation that are no fault


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

    Parameters
    ----------
    fit
        The fit.
    first
        Examination of the model.
    curves
        Detection limits over all settings, by effect.
    grown
        The model with the effects found; None if there are none. A coefficient of the law is open if it is uncertain
        with and without them: without them, its standard deviation also holds what the effects explain; beside them,
        it may be uncertain because one of them replaces its force.

    Returns
    -------
    list of Undetermined

    """
    friction = mean_friction(first)
    uncertain = list(_uncertain_coefficients(fit.parameters, first, friction))
    if grown is not None and uncertain:
        beside = {u.what for u in _uncertain_coefficients(linear_estimates(grown).parameters, first, friction)}
        uncertain = [u for u in uncertain if u.what in beside]
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
    forces = []
    for strip in first.draws.law.pieces:
        forces.append(np.abs(strip.problem.model.force(strip.path, strip.values)))
    return max(float(np.mean(np.concatenate(forces))), 1e-300)


def limit_as_force(first: Examination, scanned: ScannedCandidate, limits: Array) -> float:
    """Smallest detectable force of an effect at the middle of its scan (in logarithms), N rms.

    Parameters
    ----------
    first
        Examination of the model.
    scanned
        The effect's scans.
    limits
        Its detection limits at all grid points, (G,).

    Returns
    -------
    float

    """
    family = scanned.scans[0].grid
    g = _middle_row(family.values)
    unit_forces = [_unit_force(s, family, g) for s in first.draws.law.pieces]
    unit = float(np.sqrt(np.mean(np.concatenate(unit_forces) ** 2)))
    return float(limits[g]) * unit


def _unit_force(strip: LinearisedPiece, family: Any, g: int) -> Array:
    """Force of one unit of the first coefficient along one piece, N."""
    return np.asarray(family.raw_columns(strip, family.values[g : g + 1])[0, 0])


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
            columns = [
                s.problem.model.force_columns(s.path, s.values)[effect.name][:, k] for s in first.draws.law.pieces
            ]
            share = found.std * float(np.sqrt(np.mean(np.concatenate(columns) ** 2))) / friction
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
