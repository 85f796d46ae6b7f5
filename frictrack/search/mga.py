"""The modified genetic algorithm (MGA) of the beam paper, section 4: adaptive P_c, P_m and code length (Eqs. 5-7)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from frictrack.records import Array
from frictrack.search.evaluator import CostEvaluator
from frictrack.search.evolve import MAX_BITS, GeneticMethod, Operators
from frictrack.search.method import refuse, setting


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
class MGA(GeneticMethod):
    """Modified genetic algorithm: the GA with the adaptive probabilities and code length of Eqs. 5, 6 and 7.

    G_max is the number of generations. The paper gives L_const 10, d 0.2, population 40 and s = G_max/4 (its "critical
    point at 1/4 of the maximum number of iterations" agrees with s = 50 of 200). It does not specify a, b, c and
    P_const; they are chosen here. A child has the P_m of its parent. ``as_printed`` uses Eqs. 6 and 7 as printed.

    References
    ----------
    Research on parameter identification of nonlinear friction on cantilever beam (2014), section 4.

    Examples
    --------
    >>> MGA(generations=500, l_const=8).generation_limit(36_000)
    500

    """

    name: ClassVar[str] = "mga"
    a: float | None = setting(None, low=0)  # Eq. 5; None: 10/G_max
    b: float = setting(0.4, low=0, high=1)  # Eq. 5
    c: float | None = setting(None, low=0)  # Eq. 6; None: 20/G_max, as printed 2/G_max
    p_const: float | None = setting(
        None, low=0, high=1
    )  # Eq. 6; None: four bits of the longest chromosome, printed 0.05
    l_const: int = setting(10, low=1, high=MAX_BITS // 2)  # Eq. 7
    d: float = setting(0.2, above=0)  # Eq. 7
    s: float | None = setting(None, above=0)  # Eq. 7; None: G_max/4
    bits: int | None = setting(None, low=1, high=MAX_BITS)  # a fixed code length in place of Eq. 7 (Table 5 has 20)
    as_printed: bool = setting(False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.as_printed and not self.bits and (longest := self._length(0, 1, 1.0)) > MAX_BITS:
            refuse(
                self.name,
                f"expected at most {MAX_BITS} bits but Eq. 7 as printed begins with {longest} for l_const = "
                f"{self.l_const} and d = {self.d:g}; take a smaller l_const or a larger d",
            )

    def resolved(self, evaluator: CostEvaluator) -> Self:
        """Return the settings with the constants of this number of parameters and generations."""
        limit, longest = self.limit(evaluator), evaluator.dimension * (self.bits or 2 * self.l_const)
        return self.filled(
            a=10 / limit,
            c=(2 if self.as_printed else 20) / limit,
            p_const=min(0.5, 0.05 if self.as_printed else 4 / longest),
            s=limit / 4,
        )

    def operators(self, evaluator: CostEvaluator, rng: np.random.Generator) -> Operators:
        """Return the operators of Eqs. 5, 6 and 7."""
        limit, a, b, c, p, s = self.limit(evaluator), self.a, self.b, self.c, self.p_const, self.s
        assert a is not None and c is not None and p is not None and s is not None  # noqa: PT018 - by `resolved`
        return Operators(
            bits=lambda G: self.bits or self._length(G, limit, s),
            crossover=lambda G: crossover_probability(G, a, b),
            mutation=(lambda G, costs, _: mutation_as_printed(G, -costs, c, p))
            if self.as_printed
            else (lambda G, _, fitness: mutation_probability(G, fitness, c, p)),
        )

    def _length(self, generation: int, limit: int, s: float) -> int:
        """Code length of Eq. 7, as mended or as printed."""
        length = code_length_as_printed if self.as_printed else code_length
        return length(generation, limit, self.l_const, self.d, s)
