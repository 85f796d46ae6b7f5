"""Run the common loop of the genetic searches: rank, select, cross, mutate, evaluate, accept, reinsert."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from frictrack.records import Array, Mask
from frictrack.search.evaluator import CostEvaluator
from frictrack.search.method import SearchMethod, setting
from frictrack.search.operators import (
    SELECTIONS,
    decode,
    encode,
    flip_bits,
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
