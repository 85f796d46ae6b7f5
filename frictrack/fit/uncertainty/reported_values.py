"""Compute parameters as they are reported: F_s for F_s - F_c, x_0 as a length, newtons where the mass was fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import LeastSquaresProblem, Solution
from frictrack.fit.parameters import LEVEL, ParameterLayout, mass_ratio
from frictrack.records import Array

DIFFERENCE_SEPARATOR = " - "  # separates two addresses whose difference is meant


def reported_slots(layout: ParameterLayout) -> list[int]:
    """Return the positions of the A unknowns that are reported: all but the friction levels."""
    return [i for i, s in enumerate(layout.slots) if s.effect != LEVEL]


def reported_values(problem: LeastSquaresProblem, p: Array) -> Array:
    """Compute the reported parameters (A,) of unknowns p (P,), in the order of `reported_slots`."""
    layout = problem.layout
    known = layout.reported_values(p) | {"mass.m": problem.pieces[0].mass / mass_ratio(layout, p)}
    return np.array([known[layout.names[i]] for i in reported_slots(layout)])


def reported_values_and_jacobian(problem: LeastSquaresProblem, p: Array) -> tuple[Array, Array]:
    """Compute the reported parameters and their derivatives.

    Parameters
    ----------
    problem : LeastSquaresProblem
        The problem.
    p : array of shape (P,)
        The unknowns.

    Returns
    -------
    values : array of shape (A,)
        Reported parameters.
    jacobian : array of shape (A, P)
        Derivatives by forward differences.

    """
    base = reported_values(problem, p)
    jacobian = np.zeros((len(base), len(p)))
    for j in range(len(p)):
        step = 1e-6 * max(abs(p[j]), 1e-3)
        moved = p.copy()
        moved[j] += step
        jacobian[:, j] = (reported_values(problem, moved) - base) / step
    return base, jacobian


def reported_gradient(problem: LeastSquaresProblem, p: Array, address: str) -> tuple[float, Array]:
    """Compute one tied parameter as it is reported, and its derivative with respect to the unknowns, (P,)."""
    base = problem.layout.reported_values(p)[address]
    gradient = np.zeros(len(p))
    for j in range(len(p)):
        step = 1e-6 * max(abs(p[j]), 1e-3)
        moved = p.copy()
        moved[j] += step
        gradient[j] = (problem.layout.reported_values(moved)[address] - base) / step
    return base, gradient


def reported_by_address(solution: Solution, p: Array) -> dict[str, float]:
    """Return the reported parameters of unknowns p (P,) by address, without friction levels."""
    values = reported_values(solution.problem, p)
    names = [solution.problem.layout.names[i] for i in reported_slots(solution.problem.layout)]
    return dict(zip(names, map(float, values), strict=True))


@dataclass(frozen=True)
class Quantity:
    """One reported parameter, or the difference of two.

    Attributes
    ----------
    address, unit : str
        Name and unit.
    slot : int
        The unknown that is reported (first).
    weights : array of shape (A,)
        Weights of the reported parameters.

    """

    address: str
    unit: str
    slot: int
    weights: Array  # (A,), of the reported parameters

    def value(self, problem: LeastSquaresProblem, p: Array) -> float:
        """Compute its value for unknowns p (P,)."""
        return float(self.weights @ reported_values(problem, p))

    def gradient(self, problem: LeastSquaresProblem, p: Array) -> Array:
        """Compute its derivative with respect to the unknowns, (P,)."""
        return np.asarray(self.weights @ reported_values_and_jacobian(problem, p)[1])


def parse_quantity(layout: ParameterLayout, address: str) -> Quantity:
    """Parse an address: ``"coulomb.F_c"``, ``"vibration.phase[v3]"`` or ``"stribeck.F_s - coulomb.F_c"``.

    Raises
    ------
    FrictrackError
        (usage) If it is not a reported parameter of this model.

    """
    at = reported_slots(layout)
    names = [layout.names[i] for i in at]
    parts: Sequence[str] = [part.strip() for part in address.split(DIFFERENCE_SEPARATOR)]
    unknown = [part for part in parts if part not in names]
    if unknown or len(parts) > 2:
        fixed = [f"{e}.{p}" for e, p in layout.fixed]
        why = "which is fixed" if unknown and unknown[0] in fixed else f"but got {unknown[0] if unknown else address}"
        raise FrictrackError(f"expected a free parameter of the law ({', '.join(names)}) {why}", usage=True)
    weights = np.zeros(len(at))
    for part, sign in zip(parts, (1.0, -1.0), strict=False):
        weights[names.index(part)] += sign
    slot = layout.slots[at[names.index(parts[0])]]
    return Quantity(address, slot.unit, at[names.index(parts[0])], weights)
