"""Simulated annealing (SA) as a population of independent chains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from frictrack.search.evaluator import CostEvaluator
from frictrack.search.method import SearchMethod, setting
from frictrack.search.operators import COOLING, metropolis

TARGET_ACCEPTANCE = 0.44  # the share of accepted moves that explores fastest in one dimension (Gelman et al. 1996)
STEP_ADAPTATION_RATE = 0.3  # how fast a step length follows its acceptance


@dataclass(frozen=True)
class SA(SearchMethod):
    """Simulated annealing: one coordinate per move, Metropolis' rule, cooling from T_0 to ``final`` T_0.

    The collision paper specifies Metropolis' rule only; moves and cooling are chosen here. A move is Cauchy
    distributed (mostly near, sometimes into another valley) and mirrored at the bounds. Its scale follows the
    acceptance rate of each chain and coordinate. One generation is one move of every chain.

    References
    ----------
    Kirkpatrick, S., Gelatt, C. D. & Vecchi, M. P. (1983). Optimization by simulated annealing. Science 220, 671-680.
    Szu, H. & Hartley, R. (1987). Fast simulated annealing. Physics Letters A 122, 157-162.
    Corana, A. et al. (1987). Minimizing multimodal functions of continuous variables. ACM Trans. Math. Softw. 13,
    262-280.

    """

    name: ClassVar[str] = "sa"
    chains: int = setting(8, low=1, high=10**6)  # few and long: more chains cool faster within the same budget
    temperature: float = setting(0.1, above=0)  # T_0 over (median - minimum) of the first population's costs
    final: float = setting(1e-6, above=0, high=1)  # T at the end of the budget over T_0
    cooling: str = setting("geometric", choices=tuple(COOLING))

    @property
    def points(self) -> tuple[int, int]:
        """One point per chain."""
        return self.chains, self.chains

    def __call__(self, evaluator: CostEvaluator, rng: np.random.Generator) -> None:
        """Search until the evaluator stops it."""
        d, rows = evaluator.dimension, np.arange(self.chains)
        limit, cool = self.limit(evaluator), COOLING[self.cooling]
        unit = rng.random((self.chains, d))
        step = np.full((self.chains, d), 0.5)
        costs = evaluator(unit)
        for generation in evaluator.generations():
            column = rng.integers(d, size=self.chains)
            moved = unit.copy()
            moved[rows, column] += step[rows, column] * rng.standard_cauchy(self.chains)
            moved = np.abs((moved + 1) % 2 - 1)  # mirrored into the unit box
            moved_costs = evaluator(moved)
            T = evaluator.initial_spread * cool(generation, limit, self.temperature, self.final)
            accepted = metropolis(moved_costs, costs, T, rng)
            unit[accepted], costs[accepted] = moved[accepted], moved_costs[accepted]
            step[rows, column] *= np.exp(STEP_ADAPTATION_RATE * (accepted - TARGET_ACCEPTANCE))
            np.minimum(step, 1.0, out=step)
            evaluator.population = unit, costs
