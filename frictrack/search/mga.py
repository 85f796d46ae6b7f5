"""The modified genetic algorithm (MGA) of the beam paper, section 4: adaptive P_c, P_m and code length (Eqs. 5-7)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from frictrack.records import Array
from frictrack.search.evaluator import CostEvaluator
from frictrack.search.evolve import Operators, evolve, offspring_count


def crossover_probability(generation: int, a: float, b: float) -> float:
    """Compute the crossover probability of Eq. 5: P_c = 1/(1 + exp(a G)) + b, limited to 1.

    It falls from 1/2 + b at generation G = 0 to b.
    """
    return min(1.0, 1 / (1 + math.exp(min(a * generation, 700.0))) + b)


def mutation_probability(generation: int, fitness: Array, c: float, p_const: float) -> Array:
    """Compute the mutation probability per bit of Eq. 6, with the factor P that makes it work.

        P_m = P tanh(c G/2) (f_max - f)/(f_max - f_avg)   for f > f_avg,    P otherwise

    (e^cG - 1)/(e^cG + 1) = tanh(cG/2). The factor P is missing in print. Without it every bit of an individual just
    above the average flips late in the run. With f the objective value, 9-61 % of the runs then fail.

    Parameters
    ----------
    generation : int
        G.
    fitness : array of shape (P,)
        Rank fitness: worst 0, mean 1, best 2.
    c, p_const : float
        Constants c and P.

    Returns
    -------
    array of shape (P,)
        P_m of every individual.

    References
    ----------
    Research on parameter identification of nonlinear friction on cantilever beam (2014), Eq. 6.

    """
    best, mean = fitness.max(), fitness.mean()
    if best == mean:
        return np.full(len(fitness), p_const)
    share = math.tanh(c * generation / 2) * (best - fitness) / (best - mean)
    return np.asarray(p_const * np.where(fitness > mean, share, 1.0))


def mutation_as_printed(generation: int, f: Array, c: float, p_const: float) -> Array:
    """Compute the mutation probability of Eq. 6 as printed: f (P,) is the objective value of a maximisation.

        P_m = (e^cG - 1)/(e^cG + 1) (f_max - f)/(f_max - f_avg)   for f > f_avg,    P_const otherwise

    The paper does not define f = f_avg. Here it belongs to the second case.
    """
    f = np.where(np.isfinite(f), f, np.min(f[np.isfinite(f)], initial=0.0))
    best, mean = f.max(), f.mean()
    good = f > mean
    rate = np.full(len(f), p_const)
    rate[good] = math.tanh(c * generation / 2) * (best - f[good]) / (best - mean)
    return rate


def code_length(generation: int, limit: int, l_const: int, d: float, s: float) -> int:
    """Compute the code length of Eq. 7 as its text describes it: "short at the early stage but long later".

        L = L_const 2/(1 + exp(-d Round(G/s)))   for G < 0.8 G_max,    2 L_const after

    Its mean over the paper's own setting (L_const 10, s 50, d 0.2, G_max 200) is 13.3 bits. The times of Table 6
    imply 12.3 bits; the printed formula gives 27.2.

    Parameters
    ----------
    generation : int
        G.
    limit : int
        G_max.
    l_const : int
        L_const, bits per parameter.
    d, s : float
        Constants d and s; s is counted in generations.

    Returns
    -------
    int
        Bits per parameter.

    References
    ----------
    Research on parameter identification of nonlinear friction on cantilever beam (2014), Eq. 7 and Table 6.

    Examples
    --------
    >>> code_length(0, 200, 10, 0.2, 50), code_length(199, 200, 10, 0.2, 50)
    (10, 20)

    """
    if generation >= 0.8 * limit:
        return 2 * l_const
    return round(l_const * 2 / (1 + math.exp(-d * math.floor(generation / s + 0.5))))


def code_length_as_printed(generation: int, limit: int, l_const: int, d: float, s: float) -> int:
    """Compute the code length of Eq. 7 as printed.

        L = L_const/(1 - exp(-d (Round(G/s) + 1)))   for G < 0.8 G_max,    2 L_const after

    Parameters and return value are those of `code_length`.
    """
    if generation >= 0.8 * limit:
        return 2 * l_const
    return round(l_const / (1 - math.exp(-d * (math.floor(generation / s + 0.5) + 1))))


@dataclass(frozen=True)
class MGA:
    """Modified genetic algorithm: the GA with the adaptive probabilities and code length of Eqs. 5, 6 and 7.

    G_max is the number of generations that the budget of evaluations allows. The paper gives L_const 10, d 0.2,
    population 40 and s = G_max/4 (its "critical point at 1/4 of the maximum number of iterations" agrees with s = 50
    of 200). It does not specify a, b, c and P_const; they are chosen here. A child has the P_m of its parent.
    ``as_printed`` uses Eqs. 6 and 7 as printed.

    References
    ----------
    Research on parameter identification of nonlinear friction on cantilever beam (2014), section 4.

    """

    population: int = 40
    gap: float = 0.9  # children per generation over population
    a: float | None = None  # Eq. 5; None: 10/G_max
    b: float = 0.4  # Eq. 5
    c: float | None = None  # Eq. 6; None: 20/G_max, as printed 2/G_max
    p_const: float | None = None  # Eq. 6; None: four bits of the longest chromosome, as printed 0.05
    l_const: int = 10  # Eq. 7
    d: float = 0.2  # Eq. 7
    s: float | None = None  # Eq. 7; None: G_max/4
    bits: int | None = None  # a fixed code length in place of Eq. 7 (Table 5 has 20)
    as_printed: bool = False

    def __call__(self, evaluator: CostEvaluator, rng: np.random.Generator) -> None:
        """Search until the evaluator stops it."""
        limit = evaluator.generation_limit(self.population, offspring_count(self.population, self.gap))
        a = 10 / limit if self.a is None else self.a
        operators = Operators(
            bits=self._bits(limit),
            crossover=lambda generation: crossover_probability(generation, a, self.b),
            mutation=self._mutation(limit, evaluator.dimension),
        )
        evolve(evaluator, rng, operators, population=self.population, gap=self.gap)

    def _bits(self, limit: int) -> Callable[[int], int]:
        """Code length as a function of the generation."""
        if (fixed := self.bits) is not None:
            return lambda _: fixed
        law = code_length_as_printed if self.as_printed else code_length
        s = limit / 4 if self.s is None else self.s
        return partial(law, limit=limit, l_const=self.l_const, d=self.d, s=s)

    def _mutation(self, limit: int, dimension: int) -> Callable[[int, Array, Array], Array]:
        """Mutation probability as a function of generation, costs and rank fitness."""
        longest = dimension * (self.bits or 2 * self.l_const)
        p = min(0.5, 0.05 if self.as_printed else 4 / longest) if self.p_const is None else self.p_const
        c = (2 if self.as_printed else 20) / limit if self.c is None else self.c
        if self.as_printed:
            return lambda generation, costs, _: mutation_as_printed(generation, -costs, c, p)
        return lambda generation, _, fitness: mutation_probability(generation, fitness, c, p)
