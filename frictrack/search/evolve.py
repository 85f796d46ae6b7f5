"""The genetic algorithm (GA) of the beam paper, the simulated annealing genetic algorithm (SGA), and their common loop.

Every generation: rank, select, cross, mutate, evaluate, accept, reinsert.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from frictrack.records import Array, Mask
from frictrack.search.evaluator import CostEvaluator
from frictrack.search.method import SearchMethod, setting
from frictrack.search.operators import (
    COOLING,
    SELECTIONS,
    decode,
    encode,
    flip_bits,
    metropolis,
    one_point_crossover,
    random_genes,
    rank_fitness,
)

MAX_BITS = 60  # per parameter: what a 64-bit integer carries


@dataclass(frozen=True)
class Operators:
    """The operators that distinguish one genetic search from another. G counts generations; G = 0 is the first."""

    bits: Callable[[int], int]  # G -> code length L, bits per parameter
    crossover: Callable[[int], float]  # G -> P_c
    mutation: Callable[[int, Array, Array], Array]  # G, costs (P,), rank fitness (P,) -> P_m per bit (P,)
    accept: Callable[[int, Array, Array], Mask] | None = None  # G, child's cost, parent's (n,) -> (n,); None: all


@dataclass(frozen=True)
class GeneticMethod(SearchMethod):
    """The settings that all genetic searches have, and their common loop.

    In each generation the children replace the worst individuals and the best parents stay (elitism). A child that is
    not accepted is replaced by its parent. When the code length changes, the population is encoded anew and evaluated
    again, because rounding to another grid moves it.

    References
    ----------
    Baker, J. E. (1987). Reducing bias and inefficiency in the selection algorithm. Proc. 2nd Int. Conf. on Genetic
    Algorithms, 14-21.

    """

    population: int = setting(40, low=4, high=10**6)  # individuals
    gap: float = setting(0.9, above=0, high=1)  # generation gap: children per generation over population
    selection: str = setting("universal", choices=tuple(SELECTIONS))  # how parents are drawn by their rank fitness

    @property
    def points(self) -> tuple[int, int]:
        """The population, then the children of every generation, at least 2."""
        return self.population, max(2, round(self.gap * self.population))

    def operators(self, evaluator: CostEvaluator, rng: np.random.Generator) -> Operators:
        """Return the operators of the method, whose settings are `resolved`."""
        raise NotImplementedError

    def __call__(self, evaluator: CostEvaluator, rng: np.random.Generator) -> None:
        """Evolve a population until the evaluator stops the search."""
        operators, select, (population, n) = self.operators(evaluator, rng), SELECTIONS[self.selection], self.points
        bits = operators.bits(0)
        genes = random_genes(population, evaluator.dimension * bits, rng)
        unit = decode(genes, bits)
        costs = evaluator(unit)
        for generation in evaluator.generations():
            if (length := operators.bits(generation)) != bits:
                bits = length
                genes = encode(unit, bits)
                unit = decode(genes, bits)
                costs = evaluator(unit)
            fitness = rank_fitness(costs)
            parents = select(fitness, n, rng)
            children = one_point_crossover(genes[parents], operators.crossover(generation), rng)
            children = flip_bits(children, operators.mutation(generation, costs, fitness)[parents], rng)
            child_unit = decode(children, bits)
            child_costs = evaluator(child_unit)
            if operators.accept is not None:
                refused = ~operators.accept(generation, child_costs, costs[parents])
                again = parents[refused]
                children[refused], child_unit[refused], child_costs[refused] = genes[again], unit[again], costs[again]
            elite = np.argsort(costs, kind="stable")[: population - n]
            genes = np.concatenate([genes[elite], children])
            unit = np.concatenate([unit[elite], child_unit])
            costs = np.concatenate([costs[elite], child_costs])
            evaluator.population = unit, costs


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
