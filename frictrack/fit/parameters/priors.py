"""Compute the penalties of priors: a multivariate normal distribution of reported parameters.

With deviations d of the reported values from their means and covariance C, the penalty is d' C^-1 d. It is written as
the sum of squares of W d with W' W = C^-1, so priors are further rows of a least-squares problem.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.fit.parameters.constraints import MASS
from frictrack.models import Model
from frictrack.records import Array

if TYPE_CHECKING:
    from frictrack.fit.parameters.layout import ParameterLayout


@dataclass(frozen=True)
class ReportedPrior:
    """Prior knowledge of a parameter: mean and standard deviation of its reported value.

    `slot` is its position in the parameter vector, None if the reported value differs from the internal one.
    """

    address: str
    mean: float
    std: float
    slot: int | None
    phase: bool


def reported_priors(layout: ParameterLayout) -> tuple[ReportedPrior, ...]:
    """Return the priors of the unknowns, in order; one per run where the parameter has a value per run."""
    effects = {e.name: e for e in layout.model.effects}
    mass_known = MASS not in effects
    found_priors = []
    for i, (slot, name) in enumerate(zip(layout.slots, layout.names, strict=True)):
        effect = effects.get(slot.effect)  # None for a friction level
        p = None if effect is None else effect.parameter(slot.parameter)
        if effect is not None and p is not None and p.prior is not None:
            is_direct = slot.parameter not in effect.quoted and (mass_known or not slot.linear)
            found_priors.append(ReportedPrior(name, *p.prior, i if is_direct else None, p.role == "phase"))
    return tuple(found_priors)


def covariance_of_priors(model: Model, priors: Sequence[ReportedPrior]) -> Array:
    """Compute the covariance (m, m) of priors from their standard deviations and correlations.

    Raises
    ------
    FrictrackError
        (usage) If the correlations cannot hold together.

    """
    std = np.array([q.std for q in priors])
    at = {q.address: i for i, q in enumerate(priors)}
    matrix = np.eye(len(priors))
    for e in model.effects:
        for p in e.parameters:
            i = at.get(f"{e.name}.{p.name}")
            for other, r in p.prior_correlation if i is not None else ():
                if other in at:
                    matrix[i, at[other]] = matrix[at[other], i] = r
    if len(priors) and np.linalg.eigvalsh(matrix)[0] <= 0:
        raise FrictrackError("expected prior_correlation that can hold together (positive definite)", usage=True)
    return np.asarray(matrix * std * std[:, None], dtype=np.float64)


def whitening(covariance: Array) -> Array:
    """Compute W (m, m) with W' W the inverse of a covariance."""
    std = np.sqrt(np.diag(covariance))
    factor = np.linalg.cholesky(covariance / std / std[:, None])
    return np.asarray(np.linalg.inv(factor) / std, dtype=np.float64)


def prior_departure(layout: ParameterLayout, p: Array) -> Array:
    """Compute the deviation of every parameter with a prior from its mean, in its unit, (m,)."""
    reported = layout.reported_values(p)
    return np.array([_wrapped(reported[q.address] - q.mean, q.phase) for q in layout.priors])


def prior_residual(layout: ParameterLayout, p: Array) -> Array:
    """Compute the deviations from the means of the priors, in independent standard deviations, (m,)."""
    if not layout.priors:
        return np.empty(0)
    return np.asarray(layout.prior_whitening @ prior_departure(layout, p))


def prior_jacobian(layout: ParameterLayout, p: Array | None = None) -> Array:
    """Compute the derivative of `prior_residual` with respect to the unknowns, (m, P)."""
    rows = np.zeros((len(layout.priors), len(layout.slots)))
    if not layout.priors:
        return rows
    for row, q in zip(rows, layout.priors, strict=True):
        if q.slot is not None:
            row[q.slot] = 1.0
    which = [i for i, q in enumerate(layout.priors) if q.slot is None]
    if which:
        rows[which] = _differences(layout, _regular_point(layout) if p is None else p)[which]
    return np.asarray(layout.prior_whitening @ rows)


def _regular_point(layout: ParameterLayout) -> Array:
    """Unknowns (P,) at which no reported value is singular."""
    return np.array([0.0 if s.effect == MASS else 1.0 for s in layout.slots])


def _differences(layout: ParameterLayout, p: Array) -> Array:
    """Derivatives (m, P) of the deviations, by forward differences."""
    base = prior_departure(layout, p)
    out = np.zeros((len(base), len(p)))
    for i in range(len(p)):
        step = np.zeros(len(p))
        step[i] = 1e-6 * max(abs(p[i]), 1e-3)
        out[:, i] = (prior_departure(layout, p + step) - base) / step[i]
    return out


def prior_misfit(layout: ParameterLayout, points: Array) -> Array:
    """Compute the sum of squared prior residuals for a population of unknowns (n, P), shape (n,)."""
    if not layout.priors:
        return np.zeros(len(points))
    if any(q.slot is None for q in layout.priors):
        departures = np.array([prior_departure(layout, p) for p in points]).reshape(len(points), -1)
    else:
        departures = np.stack([_wrapped(points[:, q.slot] - q.mean, q.phase) for q in layout.priors], axis=1)
    return np.asarray(np.sum((departures @ layout.prior_whitening.T) ** 2, axis=1))


def direct_prior_equations(layout: ParameterLayout, free: Sequence[int]) -> tuple[Array, Array]:
    """Compute rows (m, P) and targets (m,) of the priors of some unknowns that are reported as they are.

    Correlations with other priors are left out: these rows are their marginal distribution.
    """
    which = [i for i, q in enumerate(layout.priors) if q.slot is not None and q.slot in free]
    rows = np.zeros((len(which), len(layout.slots)))
    if not which:
        return rows, np.zeros(0)
    for row, i in zip(rows, which, strict=True):
        row[layout.priors[i].slot or 0] = 1.0
    white = whitening(layout.prior_covariance[np.ix_(which, which)])
    return white @ rows, white @ np.array([layout.priors[i].mean for i in which])


def _wrapped(departure: Any, phase: bool) -> Any:
    """A deviation; that of a phase wrapped to (-pi, pi]."""
    return (departure + np.pi) % (2 * np.pi) - np.pi if phase else departure
