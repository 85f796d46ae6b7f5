"""Compute parameters as they are reported: F_s for F_s - F_c, x_0 as a length, newtons where the mass was fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import LeastSquaresProblem, Solution
from frictrack.fit.parameters import LEVEL, MASS, ParameterLayout, mass_ratio
from frictrack.records import Array

DIFFERENCE_SEPARATOR = " - "  # separates two addresses whose difference is meant


class FittedModel(Protocol):
    """A model fitted to runs, as profiles and the bootstrap need it, such as `frictrack.fit.Fit`."""

    @property
    def solution(self) -> Solution:
        """The unknowns, and the displacement model linearised there."""

    @property
    def compared(self) -> Solution:
        """The solution in the compared domain: displacement, acceleration or measured friction."""

    @property
    def domain(self) -> str:
        """The compared domain: "displacement" or "force"."""

    @property
    def search(self) -> str:
        """The search method."""

    @property
    def is_default_route(self) -> bool:
        """Whether variable projection fitted the displacement."""

    @property
    def covariance(self) -> Array:
        """Covariance (P, P) of the unknowns."""


def require_one_fit(result: FittedModel) -> None:
    """Raise an error (usage) for fits of several groups."""
    if not hasattr(result, "solution"):
        raise FrictrackError(
            "expected the fit of one group but got several; take one of fits[name], or leave out --per group",
            usage=True,
        )


def reported_slots(layout: ParameterLayout) -> list[int]:
    """Return the positions of the A unknowns that are reported: all but the friction levels."""
    return [i for i, s in enumerate(layout.slots) if s.effect != LEVEL]


def reported_values(problem: LeastSquaresProblem, p: Array, addresses: Sequence[str]) -> Array:
    """Compute the reported values (A,) of some parameters, fitted or tied, for unknowns p (P,)."""
    layout = problem.layout
    known = layout.reported_values(p) | {f"{MASS}.m": problem.pieces[0].mass / mass_ratio(layout, p)}
    return np.array([known[address] for address in addresses])


def reported_by_address(solution: Solution, p: Array) -> dict[str, float]:
    """Return the reported parameters of unknowns p (P,) by address, without friction levels."""
    layout = solution.problem.layout
    names = [layout.names[i] for i in reported_slots(layout)]
    return dict(zip(names, map(float, reported_values(solution.problem, p, names)), strict=True))


def reported_values_and_jacobian(
    problem: LeastSquaresProblem, p: Array, addresses: Sequence[str] | None = None
) -> tuple[Array, Array]:
    """Compute reported parameters and their derivatives.

    Parameters
    ----------
    problem : LeastSquaresProblem
        The problem.
    p : array of shape (P,)
        The unknowns.
    addresses : sequence of str, optional
        Parameters, fitted or tied; default those of `reported_slots`.

    Returns
    -------
    values : array of shape (A,)
        Reported parameters.
    jacobian : array of shape (A, P)
        Derivatives by forward differences.

    """
    if addresses is None:
        addresses = [problem.layout.names[i] for i in reported_slots(problem.layout)]
    base = reported_values(problem, p, addresses)
    jacobian = np.zeros((len(base), len(p)))
    for j in range(len(p)):
        moved = p.copy()
        moved[j] += (step := 1e-6 * max(abs(p[j]), 1e-3))
        jacobian[:, j] = (reported_values(problem, moved, addresses) - base) / step
    return base, jacobian


def standard_deviations(jacobian: Array, covariance: Array) -> Array:
    """Propagate a covariance (P, P) of the unknowns to quantities with derivatives J (A, P): sqrt(diag(J C J'))."""
    return np.sqrt(np.maximum(np.einsum("ai,ij,aj->a", jacobian, covariance, jacobian), 0.0))


@dataclass(frozen=True)
class Quantity:
    """One reported parameter, or the difference of two.

    Attributes
    ----------
    address, unit : str
        Name and unit.
    slot : int
        The unknown that is reported (first).
    parts : tuple of str
        The addresses of one or two reported parameters.
    is_unknown : bool
        Whether it is known to be the unknown itself, reported as it was fitted.

    """

    address: str
    unit: str
    slot: int
    parts: tuple[str, ...]
    is_unknown: bool = False

    def value(self, problem: LeastSquaresProblem, p: Array) -> float:
        """Compute its value for unknowns p (P,)."""
        if self.is_unknown:
            return float(p[self.slot])
        first, *others = reported_values(problem, p, self.parts)
        return float(first - sum(others))

    def gradient(self, problem: LeastSquaresProblem, p: Array) -> Array:
        """Compute its derivative with respect to the unknowns, (P,)."""
        if self.is_unknown:
            return np.asarray(np.arange(len(p)) == self.slot, dtype=float)
        first, *others = reported_values_and_jacobian(problem, p, self.parts)[1]
        return np.asarray(first - sum(others))


def parse_quantity(layout: ParameterLayout, address: str) -> Quantity:
    """Parse an address: ``"coulomb.F_c"``, ``"vibration.phase[v3]"`` or ``"stribeck.F_s - coulomb.F_c"``.

    Raises
    ------
    FrictrackError
        (usage) If it is not a reported parameter of this model.

    """
    at = {layout.names[i]: i for i in reported_slots(layout)}
    parts = [part.strip() for part in address.split(DIFFERENCE_SEPARATOR)]
    unknown = [part for part in parts if part not in at]
    if unknown or len(parts) > 2:
        fixed = [f"{e}.{p}" for e, p in layout.fixed]
        why = "which is fixed" if unknown and unknown[0] in fixed else f"but got {unknown[0] if unknown else address}"
        raise FrictrackError(f"expected a free parameter of the law ({', '.join(at)}) {why}", usage=True)
    slot = at[parts[0]]
    return Quantity(address, layout.slots[slot].unit, slot, tuple(parts))
