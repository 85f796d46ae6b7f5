"""Propagate the stated errors of scale and mass, which all runs share, to the reported parameters.

The fit is made in measured lengths and with the stated mass. With a true length (1 + e) times the measured one and a
true mass (1 + d) times the stated one, the measured motion obeys

    m x'' = (K - e K - d D) - F / ((1 + e) (1 + d)),     K = D - m g sin(incline)

to first order. A force is therefore (1 + e) (1 + d) times the fitted one, and the model also fits its parameters to the
acceleration -(e K + d D) / m as if it were friction. An error of the incline is an unknown of the fit: `slope`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from frictrack.fit.least_squares import NORMAL_QUANTILE_975, PieceResponse, Solution, white_noise_covariance
from frictrack.fit.parameters import prior_jacobian
from frictrack.fit.routes import FittedRuns
from frictrack.fit.uncertainty.estimates import Estimate, Estimates, Parameters
from frictrack.fit.uncertainty.reported_values import reported_values_and_jacobian
from frictrack.records import Array


def with_stated_errors(found: Estimates, fitted: FittedRuns) -> Estimates:
    """Add the stated errors of scale and mass to the standard deviations and intervals of fitted parameters."""
    units = {name: one.unit for name, one in found.parameters.items() if one.std}
    added = np.sqrt(np.sum(stated_error_changes(fitted, units) ** 2, axis=0))
    wider = {name: _wider(found.parameters[name], float(more)) for name, more in zip(units, added, strict=True)}
    return replace(found, parameters=Parameters(found.parameters | wider))


def _wider(one: Estimate, more: float) -> Estimate:
    """An estimate with one more independent standard deviation."""
    if not more or one.value is None:
        return one
    std, misfit = (None if s is None else float(np.hypot(s, more)) for s in (one.std, one.std_misfit))
    low, high = (
        None if end is None else one.value + sign * float(np.hypot(end - one.value, NORMAL_QUANTILE_975 * more))
        for sign, end in zip((-1, 1), one.interval or (None, None), strict=True)
    )
    return replace(one, std=std, std_misfit=misfit, interval=one.interval and (low, high))


def stated_error_changes(fitted: FittedRuns, units: Mapping[str, str], of_mass: Array | None = None) -> Array:
    """Compute by how much one standard deviation of each stated error changes reported parameters, (sources, A).

    `units`: of the parameters by address; `of_mass` (A,): whether each is proportional to the mass, by default forces.
    """
    solution, problem = fitted.solution, fitted.solution.problem
    scale = max((run.displacement.relative_scale_error for run in fitted.runs), default=0.0)
    mass = max((run.sigma_mass / run.mass for run in fitted.runs if run.mass), default=0.0)
    if not units or not (scale or (mass and problem.simulates)):
        return np.zeros((0, len(units)))
    values, jacobian = reported_values_and_jacobian(problem, solution.p, list(units))
    lengths, forces = _powers(units.values(), force_has_length=problem.simulates)
    if not problem.simulates:
        return (scale * lengths * values)[None]
    as_friction = [jacobian @ shift for shift in _shifts(solution)]
    own = (lengths * values, (forces if of_mass is None else of_mass) * values)
    return np.array([size * (o - f) for size, o, f in zip((scale, mass), own, as_friction, strict=True)])


def _powers(units: Iterable[str], *, force_has_length: bool) -> tuple[Array, Array]:
    """Powers of length and of mass (A,) in values of these units."""
    lengths = [length_power(unit, force_has_length=force_has_length) for unit in units]
    return np.array(lengths), np.array(["N" in unit for unit in units], dtype=float)


def _shifts(solution: Solution) -> Iterator[Array]:
    """Yield the changes (P,) of the unknowns per relative error of the scale, and of the mass.

    A prior is of the true values, and so it takes a part of their error.
    """
    layout = solution.problem.layout
    covariance, priors = white_noise_covariance(solution)[0], prior_jacobian(layout, solution.p)
    values = layout.reported_values(solution.p)
    held = np.array([values[q.address] for q in layout.priors])
    powers = _powers([layout.slots[layout.names.index(q.address)].unit for q in layout.priors], force_has_length=True)
    known = [r.piece.known for r in solution.responses]
    drives = [np.zeros(1) if (d := r.piece.path.drive) is None else d / r.piece.mass for r in solution.responses]
    for power, of_all in zip(powers, (known, drives), strict=True):
        rows = [_row(r, -own) @ r.jac for r, own in zip(solution.responses, of_all, strict=True)]
        pull = solution.stacked([row[None] for row in rows]).sum(axis=0)
        if layout.priors:
            pull += priors.T @ (layout.prior_whitening @ (power * held))
        yield covariance @ pull


def _row(r: PieceResponse, acceleration: Array) -> Array:
    """Whitened change (n,) of the measured position by an acceleration at the nodes (3 p,), another start taken out."""
    inputs = np.broadcast_to(acceleration, r.piece.known.shape)[:, None]
    moved = r.linear.edge_states(inputs, np.zeros((2, 1)))[r.piece.at, 0, 0]
    row = r.piece.whitened((1 + r.shift_slope) * moved)
    return np.asarray(row - r.q @ (r.q.T @ row))


def length_power(unit: str, *, force_has_length: bool) -> float:
    """Return the power of length in a unit: 1 of m/s; 0 of N s/m, where forces were computed from the motion.

    Examples
    --------
    >>> [length_power(unit, force_has_length=True) for unit in ("N", "m/s", "N s/m", "N s^2/m^2", "1")]
    [1.0, 1.0, 0.0, -1.0, 0.0]

    """
    power = 0.0
    for sign, part in zip((1, -1), unit.partition("/")[::2], strict=True):
        for factor in part.split():
            symbol, _, exponent = factor.partition("^")
            if symbol == "m" or (symbol == "N" and force_has_length):
                power += sign * float(exponent or 1)
    return power
