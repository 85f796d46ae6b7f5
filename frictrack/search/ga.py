"""The genetic algorithm (GA) of the beam paper, and the simulated annealing genetic algorithm (SGA) after it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from frictrack.records import Array, Mask
from frictrack.search.evaluator import CostEvaluator
from frictrack.search.evolve import MAX_BITS, GeneticMethod, Operators
from frictrack.search.method import setting
from frictrack.search.operators import COOLING, metropolis


@dataclass(frozen=True)
class GA(GeneticMethod):
    """Genetic algorithm: Gray code, linear ranking, stochastic universal sampling, one-point crossover, bit mutation.

    The paper gives 40 individuals, 20 bits and 200 generations for its Eq. 8. It does not specify crossover 0.7,
    mutation 0.7/length, gap 0.9 and Gray code. They are the defaults of the common toolbox, whose results agree with
    the printed Table 5 (33 generations to the last improvement; printed 34.14). On the 10-parameter friction problem
    more mutation (0.02 per bit, four bits per chromosome) does better.

    References
    ----------
    Research on parameter identification of nonlinear friction on cantilever beam (2014), sections 2.4, 4.1, Table 5.

    Examples
    --------
    >>> GA(population=60, generations=500).mutation is None
    True

    """

    name: ClassVar[str] = "ga"
    bits: int = setting(20, low=1, high=MAX_BITS)  # code length L per parameter
    crossover: float = setting(0.7, low=0, high=1)  # P_c, per pair
    mutation: float | None = setting(None, low=0, high=1)  # P_m, per bit; None: 0.7 / chromosome length

    def resolved(self, evaluator: CostEvaluator) -> Self:
        """Return the settings with the mutation probability of this number of parameters."""
        return self.filled(mutation=0.7 / (evaluator.dimension * self.bits))

    def operators(self, evaluator: CostEvaluator, rng: np.random.Generator) -> Operators:
        """Return the operators: all probabilities and the code length are constant."""
        rates = np.full(self.population, self.mutation)
        return Operators(bits=lambda _: self.bits, crossover=lambda _: self.crossover, mutation=lambda *_: rates)


@dataclass(frozen=True)
class SGA(GA):
    """Simulated annealing genetic algorithm: the GA in which a child replaces its parent by Metropolis' rule.

    "Hybrid algorithm introduces ideas of simulated annealing while sets genetic algorithm as basic framework": the
    paper says no more, and its flowchart is lost. Not specified by the paper, and chosen here: each child is compared
    with its parent after crossover and mutation; elites are not subject to the rule; the first temperature, the
    cooling and all settings of the GA. Mutation is four bits per chromosome, because acceptance needs more novelty
    than the 0.7 of the plain GA.

    References
    ----------
    Research on friction parameter identification under the influence of vibration and collision, section 3.2.

    """

    name: ClassVar[str] = "sga"
    temperature: float | None = setting(None, above=0)  # T_0 over (median - minimum) of the first costs; None: 0.3
    final: float = setting(1e-4, above=0, high=1)  # T at the end of the budget over T_0
    cooling: str = setting("geometric", choices=tuple(COOLING))

    def resolved(self, evaluator: CostEvaluator) -> Self:
        """Return the settings with the mutation probability of this number of parameters."""
        return self.filled(mutation=min(0.5, 4 / (evaluator.dimension * self.bits)), temperature=0.3)

    def operators(self, evaluator: CostEvaluator, rng: np.random.Generator) -> Operators:
        """Return the operators of the GA with Metropolis' rule."""
        limit, first, cool = self.limit(evaluator), self.temperature or 0.0, COOLING[self.cooling]

        def accept(generation: int, child: Array, parent: Array) -> Mask:
            T = evaluator.initial_spread * cool(generation, limit, first, self.final)
            return metropolis(child, parent, T, rng)

        return replace(super().operators(evaluator, rng), accept=accept)
