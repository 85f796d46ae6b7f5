"""Compute parameters as they are reported: F_s for F_s - F_c, x_0 as a length, newtons where the mass was fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.fit.least_squares import LeastSquaresProblem, Solution
from frictrack.fit.parameters import LEVEL, MASS, ParameterLayout, mass_ratio
from frictrack.records import Array

DIFFERENCE_SEPARATOR = " - "  # separates two addresses whose difference is meant


def reported_slots(layout: ParameterLayout) -> list[int]:
    """Return the positions of the A unknowns that are reported: all but the friction levels."""
    return [i for i, s in enumerate(layout.slots) if s.effect != LEVEL]


def reported_names(layout: ParameterLayout) -> list[str]:
    """Return the addresses of the A unknowns that are reported."""
    return [layout.names[i] for i in reported_slots(layout)]


def reported_values(problem: LeastSquaresProblem, p: Array, addresses: Sequence[str]) -> Array:
    """Compute the reported values (A,) of some parameters, fitted or tied, for unknowns p (P,)."""
    layout = problem.layout
    known = layout.reported_values(p) | {f"{MASS}.m": problem.pieces[0].mass / mass_ratio(layout, p)}
    return np.array([known[address] for address in addresses])


def reported_by_address(solution: Solution, p: Array) -> dict[str, float]:
    """Return the reported parameters of unknowns p (P,) by address, without friction levels."""
    names = reported_names(solution.problem.layout)
    return dict(zip(names, map(float, reported_values(solution.problem, p, names)), strict=True))


def reported_values_and_jacobian(
    problem: LeastSquaresProblem, p: Array, addresses: Sequence[str] | None = None
) -> tuple[Array, Array]:
    """Compute reported parameters (A,), by default those of `reported_slots`, and their derivatives (A, P)."""
    if addresses is None:
        addresses = reported_names(problem.layout)
    base = reported_values(problem, p, addresses)
    jacobian = np.zeros((len(base), len(p)))
    for j in range(len(p)):  # forward differences
        moved = p.copy()
        moved[j] += (step := 1e-6 * max(abs(p[j]), 1e-3))
        jacobian[:, j] = (reported_values(problem, moved, addresses) - base) / step
    return base, jacobian


def standard_deviations(jacobian: Array, covariance: Array) -> Array:
    """Propagate a covariance (P, P) of the unknowns to quantities with derivatives J (A, P): sqrt(diag(J C J'))."""
    return np.sqrt(np.maximum(np.einsum("ai,ij,aj->a", jacobian, covariance, jacobian), 0.0))


@dataclass(frozen=True)
class Quantity:
    """One reported parameter, or the difference of two (`parts`); the first is the unknown `slot`."""

    address: str
    unit: str
    slot: int
    parts: tuple[str, ...]
    is_unknown: bool = False  # whether it is known to be the unknown itself, reported as it was fitted

    def value(self, problem: LeastSquaresProblem, p: Array) -> float:
        """Compute its value for unknowns p (P,)."""
        return float(p[self.slot] if self.is_unknown else self._signs @ reported_values(problem, p, self.parts))

    def gradient(self, problem: LeastSquaresProblem, p: Array) -> Array:
        """Compute its derivative with respect to the unknowns, (P,)."""
        if self.is_unknown:
            return np.asarray(np.arange(len(p)) == self.slot, dtype=float)
        return np.asarray(self._signs @ reported_values_and_jacobian(problem, p, self.parts)[1])

    @property
    def _signs(self) -> Array:
        return np.array([1.0, -1.0])[: len(self.parts)]


def parse_quantity(layout: ParameterLayout, address: str) -> Quantity:
    """Parse an address: ``"coulomb.F_c"``, ``"vibration.phase[v3]"`` or ``"stribeck.F_s - coulomb.F_c"``."""
    names = reported_names(layout)
    parts = tuple(part.strip() for part in address.split(DIFFERENCE_SEPARATOR))
    unknown = [part for part in parts if part not in names]
    if unknown or len(parts) > 2:
        fixed = [f"{e}.{p}" for e, p in layout.fixed]
        why = "which is fixed" if unknown and unknown[0] in fixed else f"but got {unknown[0] if unknown else address}"
        raise FrictrackError(f"expected a free parameter of the law ({', '.join(names)}) {why}", usage=True)
    slot = layout.names.index(parts[0])
    return Quantity(address, layout.slots[slot].unit, slot, parts)
