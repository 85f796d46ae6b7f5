"""The genetic algorithm of the beam paper, section 2.4 and 4.1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.search.evolve import Operators, evolve
from frictrack.search.ledger import Ledger


@dataclass(frozen=True)
class GA:
    """Gray code, linear ranking, stochastic universal sampling, one-point crossover, bit mutation.

    The paper gives 40 individuals, 20 bits and 200 generations for Eq. 8. Crossover 0.7, mutation 0.7/length, gap 0.9
    and Gray code are not specified by the paper: they are the defaults of the common toolbox, whose figures agree
    with the printed Table 5 (33 generations to the last improvement; printed 34.14). On the 10-parameter friction
    problem more mutation (0.02 per bit, four bits per chromosome) does better.
    """

    population: int = 40
    bits: int = 20  # code length L per parameter
    crossover: float = 0.7  # P_c, per pair
    mutation: float | None = None  # P_m, per bit; None: 0.7 / chromosome length
    gap: float = 0.9  # children per generation over population

    def __call__(self, ledger: Ledger, rng: np.random.Generator) -> None:
        """Search until the ledger stops it."""
        rate = 0.7 / (ledger.dimension * self.bits) if self.mutation is None else self.mutation
        rates = np.full(self.population, rate)
        use = Operators(
            bits=lambda _: self.bits,
            crossover=lambda _: self.crossover,
            mutation=lambda *_: rates,
        )
        evolve(ledger, rng, use, population=self.population, gap=self.gap)
