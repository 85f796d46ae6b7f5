"""The genetic algorithm (GA) of the beam paper, and the simulated annealing genetic algorithm (SGA) after it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.records import Array, Mask
from frictrack.search.evaluator import CostEvaluator
from frictrack.search.evolve import Operators, evolve, offspring_count
from frictrack.search.operators import geometric_cooling, metropolis


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


@dataclass(frozen=True)
class SGA:
    """Simulated annealing genetic algorithm: the GA in which a child replaces its parent by Metropolis' rule.

    "Hybrid algorithm introduces ideas of simulated annealing while sets genetic algorithm as basic framework": the
    paper says no more, and its flowchart is lost. Not specified by the paper, and chosen here: each child is compared
    with its parent after crossover and mutation; elites are not subject to the rule; the first temperature, the
    geometric cooling and all settings of the GA. Mutation is four bits per chromosome, because acceptance needs more
    novelty than the 0.7 of the plain GA.

    References
    ----------
    Research on friction parameter identification under the influence of vibration and collision, section 3.2.

    """

    population: int = 40
    bits: int = 20  # code length L per parameter
    crossover: float = 0.7  # P_c, per pair
    mutation: float | None = None  # P_m, per bit; None: 4 / chromosome length
    gap: float = 0.9  # children per generation over population
    temperature: float = 0.3  # T_0 over (median - minimum) of the first population's costs
    final: float = 1e-4  # T at the end of the budget over T_0

    def __call__(self, evaluator: CostEvaluator, rng: np.random.Generator) -> None:
        """Search until the evaluator stops it."""
        rate = 4 / (evaluator.dimension * self.bits) if self.mutation is None else self.mutation
        rates = np.full(self.population, min(0.5, rate))
        limit = evaluator.generation_limit(self.population, offspring_count(self.population, self.gap))

        def accept(generation: int, child: Array, parent: Array) -> Mask:
            T = evaluator.initial_spread * geometric_cooling(generation, limit, self.temperature, self.final)
            return metropolis(child, parent, T, rng)

        operators = Operators(
            bits=lambda _: self.bits,
            crossover=lambda _: self.crossover,
            mutation=lambda *_: rates,
            accept=accept,
        )
        evolve(evaluator, rng, operators, population=self.population, gap=self.gap)
