"""The least-squares problem with one reported quantity fixed, while all other unknowns are fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import LeastSquaresProblem, PieceResponse, Solution
from frictrack.fit.uncertainty.reported_values import Quantity
from frictrack.records import Array, Mask

MAX_NEWTON_STEPS = 12  # one suffices where the quantity is linear in the pivot
MIN_DERIVATIVE_SHARE = 1e-7  # share of the largest; smaller derivatives are rounding errors
MIN_DISTANCE_TO_BOUNDS_STD = 20.0  # a pivot should be at least this far from its bounds


class FixedQuantityProblem(LeastSquaresProblem):
    """The same problem with one unknown (the pivot) chosen so that a quantity has a given value.

    Parameters
    ----------
    inner : LeastSquaresProblem
        The problem without the condition.
    quantity : Quantity
        The reported quantity.
    value : float
        Its value.
    pivot : int or None
        The unknown that follows from the others. None if the quantity is an unknown itself.

    """

    def __init__(self, inner: LeastSquaresProblem, quantity: Quantity, value: float, pivot: int | None) -> None:
        super().__init__(inner.model, inner.layout, inner.pieces)
        self.inner, self.quantity, self.value = inner, quantity, value
        self.direct = pivot is None
        self.pivot = quantity.slot if pivot is None else pivot

    @property
    def free(self) -> Mask:
        """Which unknowns may change, (P,)."""
        free = np.ones(len(self.layout.slots), dtype=bool)
        free[self.pivot] = False
        return free

    def law(self, p: Array) -> Array:
        """Compute all unknowns (P,) with the pivot solved for.

        Raises
        ------
        FrictrackError
            If the pivot would leave its bounds.

        """
        p = np.array(p, dtype=float)
        if self.direct:
            p[self.pivot] = self.value
            return p
        tolerance = 1e-12 * max(abs(self.value), 1e-3)
        for _ in range(MAX_NEWTON_STEPS):
            error = self.quantity.value(self.inner, p) - self.value
            if abs(error) <= tolerance:
                break
            p[self.pivot] -= error / self.quantity.gradient(self.inner, p)[self.pivot]
        low, high = self.layout.slots[self.pivot].bounds
        if not (np.isfinite(p[self.pivot]) and low <= p[self.pivot] <= high):
            raise FrictrackError(f"no law within the bounds has {self.quantity.address} = {self.value:g}")
        return p

    def evaluate(self, p: Array, starts: Sequence[Array]) -> list[PieceResponse]:
        """Simulate and linearise every piece; the sensitivities include the response of the pivot."""
        law = self.law(p)
        if self.direct:
            return self.inner.evaluate(law, starts)
        gradient = self.quantity.gradient(self.inner, law)
        derivative = -gradient / gradient[self.pivot]  # of the pivot per unit of every other unknown
        derivative[self.pivot] = -1.0  # so that its own column vanishes
        return [self._with_pivot_derivative(r, derivative) for r in self.inner.evaluate(law, starts)]

    def _with_pivot_derivative(self, r: PieceResponse, derivative: Array) -> PieceResponse:
        """The response of a piece with the pivot following the other unknowns."""
        if self.pivot not in r.active:
            return r
        at = r.active.index(self.pivot)
        share = derivative[r.active]
        changed: dict[str, Any] = {
            "jac": r.jac + np.outer(r.jac[:, at], share),
            "on_start": r.on_start + np.outer(r.on_start[:, at], share),
        }
        displacement = getattr(r, "plain", None)  # the displacement response behind an acceleration chain
        return replace(
            r,
            **changed
            | ({} if displacement is None else {"plain": self._with_pivot_derivative(displacement, derivative)}),
        )


def pivot_of(quantity: Quantity, solution: Solution, std: Array) -> int | None:
    """Choose the pivot: the reported unknown, unless it is close to a bound and another one is not.

    Parameters
    ----------
    quantity : Quantity
        The reported quantity.
    solution : Solution
        The fit.
    std : array of shape (P,)
        Standard deviations of the unknowns.

    Returns
    -------
    int or None
        Position of the pivot; None if the quantity is an unknown itself.

    """
    p, (low, high) = solution.p, solution.problem.layout.bounds
    influence = np.abs(quantity.gradient(solution.problem, p)) * np.maximum(std, 1e-12)
    matters = influence > MIN_DERIVATIVE_SHARE * influence.max()
    only_one = matters[quantity.slot] and np.count_nonzero(matters) == 1
    if only_one and np.isclose(quantity.value(solution.problem, p), p[quantity.slot], rtol=1e-9, atol=1e-12):
        return None
    priors = [q.slot for q in solution.problem.layout.priors if q.slot not in (None, quantity.slot)]
    matters[priors] = False  # an unknown with a prior must not be the pivot
    distance_to_bounds = np.where(matters, np.minimum(p - low, high - p) / np.maximum(std, 1e-300), -1.0)
    if (
        distance_to_bounds[quantity.slot] >= MIN_DISTANCE_TO_BOUNDS_STD
        or distance_to_bounds[quantity.slot] >= distance_to_bounds.max()
    ):
        return quantity.slot
    return int(np.argmax(distance_to_bounds))
