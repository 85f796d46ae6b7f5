"""The one loop of the genetic searches: rank, select, cross, mutate, evaluate, accept, reinsert."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from frictrack.errors import gather
from frictrack.records import Array, Mask
from frictrack.search.coding import decode, encode, random_genes
from frictrack.search.ledger import Ledger
from frictrack.search.operators import flip_bits, one_point_crossover, rank_fitness, universal_sampling


@dataclass(frozen=True)
class Operators:
    """What distinguishes one genetic search from another. G counts generations; G = 0 is the first."""

    bits: Callable[[int], int]  # G -> code length L, bits per parameter
    crossover: Callable[[int], float]  # G -> P_c
    mutation: Callable[[int, Array, Array], Array]  # G, costs (P,), rank fitness (P,) -> P_m per bit (P,)
    accept: Callable[[int, Array, Array], Mask] | None = None  # G, child's cost, parent's (n,) -> (n,); None: all


MOST_BITS = 60  # per parameter: what a 64-bit integer carries


def offspring(population: int, gap: float) -> int:
    """Children per generation: the generation gap's share of the population, at least 2."""
    return max(2, round(gap * population))


def evolve(ledger: Ledger, rng: np.random.Generator, use: Operators, *, population: int, gap: float) -> None:
    """Evolve until the ledger stops it.

    Each generation the `offspring(population, gap)` children replace the worst; the best parents stay (elites). A
    child that is not accepted leaves its place to the parent whose slot it took. When the code length changes, the
    population is re-encoded and evaluated again, because rounding to another grid moves it.
    """
    n, bits = offspring(population, gap), use.bits(0)
    _check(population, gap, bits)
    genes = random_genes(population, ledger.dimension * bits, rng)
    costs = ledger(decode(genes, bits))
    for generation in ledger.generations():
        if (length := use.bits(generation)) != bits:
            unit, bits = decode(genes, bits), length
            _check(population, gap, bits)
            genes = encode(unit, bits)
            costs = ledger(decode(genes, bits))
        fitness = rank_fitness(costs)
        parents = universal_sampling(fitness, n, rng)
        children = one_point_crossover(genes[parents], use.crossover(generation), rng)
        children = flip_bits(children, use.mutation(generation, costs, fitness)[parents], rng)
        child_costs = ledger(decode(children, bits))
        if use.accept is not None:
            refused = ~use.accept(generation, child_costs, costs[parents])
            children[refused], child_costs[refused] = genes[parents[refused]], costs[parents[refused]]
        elite = np.argsort(costs, kind="stable")[: population - n]
        genes = np.concatenate([genes[elite], children])
        costs = np.concatenate([costs[elite], child_costs])


def _check(population: int, gap: float, bits: int) -> None:
    faults = []
    if population < 4:
        faults.append(f"expected a population of at least 4 but got {population}")
    if not 0 < gap <= 1:
        faults.append(f"expected a generation gap above 0 and up to 1 but got {gap:g}")
    if not 1 <= bits <= MOST_BITS:
        faults.append(f"expected a code length of 1 to {MOST_BITS} bits but got {bits}")
    gather(faults, "genetic search")
