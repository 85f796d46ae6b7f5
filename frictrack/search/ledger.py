"""What every search shares: the counted cost, the best so far, its history, and the reasons to stop."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.records import Array
from frictrack.search.optima import WITHIN, distinct_optima

Cost = Callable[[Array], Array]
Callback = Callable[[int, Array, float], "bool | None"]


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


class Stop(Exception):
    """Ends a search from inside, whoever runs the loop; a signal, not an error. Its text is the reason."""


class Ledger:
    """A cost function that keeps the books. Searches call it; `Stop` leaves it when the search is over.

    Parameters: ``cost`` maps (P, d) to (P,), NaN counts as infinitely bad; ``bounds`` (d, 2) are already checked;
    ``stagnation`` is the number of generations without improvement after which to stop, or None.
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
        self.spread = 0.0  # of the first population's costs: median minus minimum; what annealing calls hot
        self._cost, self._callback, self._stagnation = cost, callback, stagnation
        self._best_x, self._best = bounds[:, 0], np.inf
        self._history: list[float] = []
        self._improved = 0
        self._open = False
        self._near: list[tuple[Array, Array]] = []  # what was within 1 % of the best when it was met

    @property
    def dimension(self) -> int:
        """Number of parameters d."""
        return len(self.lower)

    def generation_limit(self, first: int, each: int) -> int:
        """G_max: generations of ``each`` points that the budget allows after ``first`` points, at least 1."""
        return max(1, -(-(self.max_evaluations - first) // each))

    def __call__(self, unit: Array) -> Array:
        """Cost (P,) of the points ``unit`` (P, d), given in the unit box; stops when the budget is spent."""
        points = self.lower + self.width * unit[: self.max_evaluations - self.evaluations]
        costs = self._checked(self._cost(points), len(points))
        self.evaluations += len(points)
        self._note(points, costs)
        if self.evaluations >= self.max_evaluations:
            self.close()
            raise Stop("evaluations")
        return costs

    def generations(self) -> Iterator[int]:
        """Count 1, 2, ... for ever; each step closes the generation before it."""
        while True:
            self.close()
            yield len(self._history)

    def close(self) -> None:
        """End the current generation: history, callback, stagnation."""
        if not self._open:
            return
        self._open = False
        generation = len(self._history)
        self._history.append(self._best)
        if self._callback and self._callback(generation, self._best_x.copy(), self._best):
            raise Stop("callback")
        if self._stagnation and generation - self._improved >= self._stagnation:
            raise Stop("stagnation")

    def result(self, reason: str) -> SearchResult:
        """Close the books."""
        points = np.concatenate([p for p, _ in self._near])
        costs = np.concatenate([c for _, c in self._near])
        optima, optima_costs = distinct_optima(points, costs, self.lower, self.width)
        return SearchResult(
            x=self._best_x,
            cost=self._best,
            evaluations=self.evaluations,
            generations=len(self._history) - 1,
            generation_of_last_improvement=self._improved,
            history=np.array(self._history),
            optima=optima,
            optima_costs=optima_costs,
            reason=reason,
        )

    def _note(self, points: Array, costs: Array) -> None:
        if not self._near:
            finite = costs[np.isfinite(costs)]
            self.spread = float(np.median(finite) - finite.min()) if len(finite) else 0.0
        self._open = True
        best = int(np.argmin(costs))
        if costs[best] < self._best or not self._near:
            self._best, self._best_x = float(costs[best]), points[best].copy()
            self._improved = len(self._history)
        near = costs <= self._best + WITHIN * abs(self._best)
        if near.any():
            self._near.append((points[near], costs[near]))

    @staticmethod
    def _checked(costs: Array, n: int) -> Array:
        costs = np.asarray(costs, dtype=np.float64)
        if costs.shape != (n,):
            raise FrictrackError(
                f"expected one cost per point, shape ({n},), but got shape {costs.shape}; "
                "the cost must take the whole population (P, d) at once"
            )
        return np.where(np.isnan(costs), np.inf, costs)
