"""Simulated annealing (Kirkpatrick et al. 1983), as a population of independent chains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.search.ledger import Ledger
from frictrack.search.operators import geometric_cooling, metropolis

ACCEPTANCE = 0.44  # the share of accepted moves that explores fastest in one dimension (Gelman et al. 1996)
GAIN = 0.3  # how fast a step length follows its acceptance


@dataclass(frozen=True)
class SA:
    """Independent chains, one coordinate per move, Metropolis' rule, geometric cooling from T_0 to ``final`` T_0.

    The collision paper names only Metropolis' rule; moves and cooling are chosen here. A move is Cauchy distributed
    (Szu & Hartley 1987: mostly near, now and then into another valley), mirrored at the bounds; its scale follows the
    acceptance, per chain and coordinate (Corana et al. 1987). One generation is one move of every chain.
    """

    chains: int = 8  # few and long: more chains cool faster within the same budget
    temperature: float = 0.1  # T_0 over (median - minimum) of the first population's costs
    final: float = 1e-6  # T at the end of the budget over T_0

    def __call__(self, ledger: Ledger, rng: np.random.Generator) -> None:
        """Search until the ledger stops it."""
        d, rows = ledger.dimension, np.arange(self.chains)
        limit = ledger.generation_limit(self.chains, self.chains)
        unit = rng.random((self.chains, d))
        step = np.full((self.chains, d), 0.5)
        costs = ledger(unit)
        for generation in ledger.generations():
            column = rng.integers(d, size=self.chains)
            moved = unit.copy()
            moved[rows, column] += step[rows, column] * rng.standard_cauchy(self.chains)
            moved = np.abs((moved + 1) % 2 - 1)  # mirrored into the unit box
            moved_costs = ledger(moved)
            T = ledger.spread * geometric_cooling(generation, limit, self.temperature, self.final)
            accepted = metropolis(moved_costs, costs, T, rng)
            unit[accepted], costs[accepted] = moved[accepted], moved_costs[accepted]
            step[rows, column] *= np.exp(GAIN * (accepted - ACCEPTANCE))
            np.minimum(step, 1.0, out=step)
