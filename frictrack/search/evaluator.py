"""Evaluate the cost function of a search: count evaluations, record the best points, stop at the budget."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.records import Array

Cost = Callable[[Array], Array]
Callback = Callable[[int, Array, float], "bool | None"]
MAX_EXCESS_COST_SHARE = 0.01  # of the best cost's size
MIN_OPTIMA_DISTANCE = 0.02  # of the box, in every direction: nearer points are one optimum
MAX_CELLS = 2000  # cells compared pairwise


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The best point of a search and how it was reached. Generation 0 is the initial population."""

    x: Array  # (d,) the best point
    cost: float  # its cost
    evaluations: int  # points whose cost was asked for
    generations: int  # generations after the initial one
    generation_of_last_improvement: int  # the papers' "generations to find the optimum"
    history: Array  # (generations + 1,) best cost so far
    optima: Array  # (k, d) distinct optima within 1 % of the best, best first: "a group of feasible solutions"
    optima_costs: Array  # (k,)
    reason: str  # why it stopped: "evaluations", "callback", "stagnation" or "converged"


class StopSearch(Exception):
    """Signal that ends a search from inside the cost function, whichever loop runs it. Its text is the reason."""


class CostEvaluator:
    """A cost function over the unit box that counts its evaluations and raises `StopSearch` when the search is over.

    Parameters
    ----------
    cost : callable
        Maps points (P, d) to costs (P,). NaN counts as infinite.
    bounds : array of shape (d, 2)
        Lower and upper bounds, already checked.
    max_evaluations : int
        Number of points that may be evaluated.
    callback : callable, optional
        Called after every generation with generation, best point and best cost. A true return value stops the search.
    stagnation : int, optional
        Number of generations without improvement after which the search stops.

    Attributes
    ----------
    evaluations : int
        Points evaluated so far.
    initial_spread : float
        Median minus minimum of the costs of the first population. Annealing scales its temperature by it.

    """

    def __init__(
        self,
        cost: Cost,
        bounds: Array,
        max_evaluations: int,
        callback: Callback | None = None,
        stagnation: int | None = None,
    ) -> None:
        self.lower, self.width = bounds[:, 0], bounds[:, 1] - bounds[:, 0]
        self.max_evaluations = max_evaluations
        self.evaluations = 0
        self.initial_spread = 0.0  # median minus minimum of the first population's costs: scale of the temperature
        self._cost, self._callback, self._stagnation = cost, callback, stagnation
        self._best_x, self._best = bounds[:, 0], np.inf
        self._history: list[float] = []
        self._last_improvement = 0
        self._generation_open = False
        self._near_optimal: list[tuple[Array, Array]] = []  # within 1 % of the best cost so far

    @property
    def dimension(self) -> int:
        """Number of parameters d."""
        return len(self.lower)

    def generation_limit(self, first: int, each: int) -> int:
        """Compute G_max: generations of ``each`` points that the budget allows after ``first`` points; at least 1."""
        return max(1, -(-(self.max_evaluations - first) // each))

    def __call__(self, unit: Array) -> Array:
        """Evaluate the points ``unit`` (P, d) of the unit box and return their costs (P,).

        Raises `StopSearch` when the budget is used up.
        """
        points = self.lower + self.width * unit[: self.max_evaluations - self.evaluations]
        costs = self._checked(self._cost(points), len(points))
        self.evaluations += len(points)
        self._record(points, costs)
        if self.evaluations >= self.max_evaluations:
            self.end_generation()
            raise StopSearch("evaluations")
        return costs

    def generations(self) -> Iterator[int]:
        """Yield 1, 2, ... without end. Each step ends the previous generation."""
        while True:
            self.end_generation()
            yield len(self._history)

    def end_generation(self) -> None:
        """End the current generation: extend the history, call the callback, check for stagnation."""
        if not self._generation_open:
            return
        self._generation_open = False
        generation = len(self._history)
        self._history.append(self._best)
        if self._callback and self._callback(generation, self._best_x.copy(), self._best):
            raise StopSearch("callback")
        if self._stagnation and generation - self._last_improvement >= self._stagnation:
            raise StopSearch("stagnation")

    def result(self, reason: str) -> SearchResult:
        """Return the result of the search, with the reason why it ended."""
        points = np.concatenate([p for p, _ in self._near_optimal])
        costs = np.concatenate([c for _, c in self._near_optimal])
        optima, optima_costs = distinct_optima(points, costs, self.lower, self.width)
        return SearchResult(
            x=self._best_x,
            cost=self._best,
            evaluations=self.evaluations,
            generations=len(self._history) - 1,
            generation_of_last_improvement=self._last_improvement,
            history=np.array(self._history),
            optima=optima,
            optima_costs=optima_costs,
            reason=reason,
        )

    def _record(self, points: Array, costs: Array) -> None:
        """Update the best point and the list of nearly optimal points."""
        if not self._near_optimal:
            finite = costs[np.isfinite(costs)]
            self.initial_spread = float(np.median(finite) - finite.min()) if len(finite) else 0.0
        self._generation_open = True
        best = int(np.argmin(costs))
        if costs[best] < self._best or not self._near_optimal:
            self._best, self._best_x = float(costs[best]), points[best].copy()
            self._last_improvement = len(self._history)
        near = costs <= self._best + MAX_EXCESS_COST_SHARE * abs(self._best)
        if near.any():
            self._near_optimal.append((points[near], costs[near]))

    @staticmethod
    def _checked(costs: Array, n: int) -> Array:
        """Costs as an array (n,), NaN replaced by infinity."""
        costs = np.asarray(costs, dtype=np.float64)
        if costs.shape != (n,):
            raise FrictrackError(
                f"expected one cost per point, shape ({n},), but got shape {costs.shape}; "
                "the cost must take the whole population (P, d) at once"
            )
        return np.where(np.isnan(costs), np.inf, costs)


def distinct_optima(points: Array, costs: Array, lower: Array, width: Array) -> tuple[Array, Array]:
    """Find the distinct optima within 1 % of the best cost.

    A point is an optimum of its own when no better point lies within 2 % of the box around it in every coordinate.
    These are the modes of quick shift, so that the slope of one valley counts once.

    Parameters
    ----------
    points : array of shape (n, d)
        Evaluated points.
    costs : array of shape (n,)
        Their costs.
    lower, width : array of shape (d,)
        Lower bounds and widths of the box.

    Returns
    -------
    points : array of shape (k, d)
        The distinct optima, best first.
    costs : array of shape (k,)
        Their costs.

    References
    ----------
    Vedaldi, A. & Soatto, S. (2008). Quick shift and kernel methods for mode seeking. ECCV, 705-718.

    """
    best = costs.min()
    keep = np.flatnonzero(costs <= best + MAX_EXCESS_COST_SHARE * abs(best))
    keep = keep[np.argsort(costs[keep], kind="stable")]
    unit = (points[keep] - lower) / width
    # one point per half radius is enough, and keeps the pairwise comparison small
    cells = np.floor(unit / (MIN_OPTIMA_DISTANCE / 2)).astype(np.int64)
    first = np.sort(np.unique(cells, axis=0, return_index=True)[1])[:MAX_CELLS]
    unit, keep = unit[first], keep[first]
    mode = [i for i in range(len(unit)) if np.all(np.abs(unit[:i] - unit[i]).max(axis=1) > MIN_OPTIMA_DISTANCE)]
    return points[keep[mode]], costs[keep[mode]]
