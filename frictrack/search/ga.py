"""The genetic algorithm (GA) of the beam paper, sections 2.4 and 4.1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.search.evaluator import CostEvaluator
from frictrack.search.evolve import Operators, evolve


@dataclass(frozen=True)
class GA:
    """Genetic algorithm: Gray code, linear ranking, stochastic universal sampling, one-point crossover, bit mutation.

    The paper gives 40 individuals, 20 bits and 200 generations for its Eq. 8. It does not specify crossover 0.7,
    mutation 0.7/length, gap 0.9 and Gray code. They are the defaults of the common toolbox, whose results agree with
    the printed Table 5 (33 generations to the last improvement; printed 34.14). On the 10-parameter friction problem
    more mutation (0.02 per bit, four bits per chromosome) does better.

    References
    ----------
    Research on parameter identification of nonlinear friction on cantilever beam (2014), sections 2.4, 4.1, Table 5.

    """

    population: int = 40
    bits: int = 20  # code length L per parameter
    crossover: float = 0.7  # P_c, per pair
    mutation: float | None = None  # P_m, per bit; None: 0.7 / chromosome length
    gap: float = 0.9  # children per generation over population

    def __call__(self, evaluator: CostEvaluator, rng: np.random.Generator) -> None:
        """Search until the evaluator stops it."""
        rate = 0.7 / (evaluator.dimension * self.bits) if self.mutation is None else self.mutation
        rates = np.full(self.population, rate)
        operators = Operators(
            bits=lambda _: self.bits,
            crossover=lambda _: self.crossover,
            mutation=lambda *_: rates,
        )
        evolve(evaluator, rng, operators, population=self.population, gap=self.gap)
