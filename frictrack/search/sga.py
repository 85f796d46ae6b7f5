"""The simulated annealing genetic algorithm of the collision paper, section 3.2."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictrack.records import Array, Mask
from frictrack.search.evolve import Operators, evolve, offspring
from frictrack.search.ledger import Ledger
from frictrack.search.operators import geometric_cooling, metropolis


@dataclass(frozen=True)
class SGA:
    """The GA's frame, in which a child takes its parent's place by Metropolis' rule under a falling temperature.

    "Hybrid algorithm introduces ideas of simulated annealing while sets genetic algorithm as basic framework": that is
    all the paper says (its flowchart is lost). Not specified by the paper, and chosen here: what is accepted against
    what (each child against the parent whose slot it took, after crossover and mutation), elites outside the rule,
    the first temperature, the geometric cooling and all settings of the frame (mutation is four bits per chromosome:
    acceptance needs more novelty than the plain GA's 0.7).
    """

    population: int = 40
    bits: int = 20  # code length L per parameter
    crossover: float = 0.7  # P_c, per pair
    mutation: float | None = None  # P_m, per bit; None: 4 / chromosome length
    gap: float = 0.9  # children per generation over population
    temperature: float = 0.3  # T_0 over (median - minimum) of the first population's costs
    final: float = 1e-4  # T at the end of the budget over T_0

    def __call__(self, ledger: Ledger, rng: np.random.Generator) -> None:
        """Search until the ledger stops it."""
        rate = 4 / (ledger.dimension * self.bits) if self.mutation is None else self.mutation
        rates = np.full(self.population, min(0.5, rate))
        limit = ledger.generation_limit(self.population, offspring(self.population, self.gap))

        def accept(generation: int, child: Array, parent: Array) -> Mask:
            T = ledger.spread * geometric_cooling(generation, limit, self.temperature, self.final)
            return metropolis(child, parent, T, rng)

        use = Operators(
            bits=lambda _: self.bits,
            crossover=lambda _: self.crossover,
            mutation=lambda *_: rates,
            accept=accept,
        )
        evolve(ledger, rng, use, population=self.population, gap=self.gap)
