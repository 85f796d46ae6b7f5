"""Run the common loop of the genetic searches: rank, select, cross, mutate, evaluate, accept, reinsert."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from frictrack.errors import raise_faults
from frictrack.records import Array, Mask
from frictrack.search.evaluator import CostEvaluator
from frictrack.search.operators import (
    decode,
    encode,
    flip_bits,
    one_point_crossover,
    random_genes,
    rank_fitness,
    universal_sampling,
)


@dataclass(frozen=True)
class Operators:
    """The operators that distinguish one genetic search from another. G counts generations; G = 0 is the first."""

    bits: Callable[[int], int]  # G -> code length L, bits per parameter
    crossover: Callable[[int], float]  # G -> P_c
    mutation: Callable[[int, Array, Array], Array]  # G, costs (P,), rank fitness (P,) -> P_m per bit (P,)
    accept: Callable[[int, Array, Array], Mask] | None = None  # G, child's cost, parent's (n,) -> (n,); None: all


MAX_BITS = 60  # per parameter: what a 64-bit integer carries


def offspring_count(population: int, gap: float) -> int:
    """Compute the number of children per generation: the generation gap times the population, at least 2."""
    return max(2, round(gap * population))


def evolve(
    evaluator: CostEvaluator, rng: np.random.Generator, operators: Operators, *, population: int, gap: float
) -> None:
    """Evolve a population until the evaluator stops the search.

    In each generation the children replace the worst individuals and the best parents stay (elitism). A child that is
    not accepted is replaced by its parent. When the code length changes, the population is encoded anew and evaluated
    again, because rounding to another grid moves it.

    Parameters
    ----------
    evaluator : CostEvaluator
        Cost over the unit box; it ends the search.
    rng : numpy.random.Generator
        Source of all random numbers.
    operators : Operators
        Code length, crossover and mutation probabilities, and acceptance of the method.
    population : int
        Individuals, at least 4.
    gap : float
        Generation gap: children per generation over population, in (0, 1].

    Raises
    ------
    FrictrackError
        If population, gap or code length are out of range.

    References
    ----------
    Baker, J. E. (1987). Reducing bias and inefficiency in the selection algorithm. Proc. 2nd Int. Conf. on Genetic
    Algorithms, 14-21.

    """
    n, bits = offspring_count(population, gap), operators.bits(0)
    _check(population, gap, bits)
    genes = random_genes(population, evaluator.dimension * bits, rng)
    costs = evaluator(decode(genes, bits))
    for generation in evaluator.generations():
        if (length := operators.bits(generation)) != bits:
            unit, bits = decode(genes, bits), length
            _check(population, gap, bits)
            genes = encode(unit, bits)
            costs = evaluator(decode(genes, bits))
        fitness = rank_fitness(costs)
        parents = universal_sampling(fitness, n, rng)
        children = one_point_crossover(genes[parents], operators.crossover(generation), rng)
        children = flip_bits(children, operators.mutation(generation, costs, fitness)[parents], rng)
        child_costs = evaluator(decode(children, bits))
        if operators.accept is not None:
            refused = ~operators.accept(generation, child_costs, costs[parents])
            children[refused], child_costs[refused] = genes[parents[refused]], costs[parents[refused]]
        elite = np.argsort(costs, kind="stable")[: population - n]
        genes = np.concatenate([genes[elite], children])
        costs = np.concatenate([costs[elite], child_costs])


def _check(population: int, gap: float, bits: int) -> None:
    """Raise FrictrackError for settings out of range."""
    faults = []
    if population < 4:
        faults.append(f"expected a population of at least 4 but got {population}")
    if not 0 < gap <= 1:
        faults.append(f"expected a generation gap above 0 and up to 1 but got {gap:g}")
    if not 1 <= bits <= MAX_BITS:
        faults.append(f"expected a code length of 1 to {MAX_BITS} bits but got {bits}")
    raise_faults(faults, "genetic search")
