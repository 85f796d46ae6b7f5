"""Compute the penalties of priors: a multivariate normal distribution of reported parameters.

With deviations d of the reported values from their means and covariance C, the penalty is d' C^-1 d. It is written as
the sum of squares of W d with W' W = C^-1, so priors are further rows of a least-squares problem.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from frictrack.fit.parameters.constraints import MASS
from frictrack.fit.parameters.layout import ParameterLayout
from frictrack.fit.parameters.prior_covariance import whitening
from frictrack.records import Array


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
