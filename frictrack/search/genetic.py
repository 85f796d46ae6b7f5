"""The searches of the papers: genetic algorithm (GA), modified GA (MGA), simulated annealing (SA), and both (SGA).

Chromosomes are Gray-coded, `bits` bits per parameter. Every generation of a genetic search: rank, select, cross,
mutate, evaluate, accept, reinsert. The searches differ in their `Operators`. SA is a population of independent chains.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask
from frictrack.search.method import CostEvaluator, SearchMethod, refuse, setting

Genes = NDArray[np.uint8]
MIN_TEMPERATURE = float(np.finfo(float).tiny)  # the coldest temperature that can be divided by


def encode(unit: Array, bits: int) -> Genes:
    """Encode points of the unit box on the grid k/(2^bits - 1), rounded to the nearest grid point.

    The reflected Gray code g = k xor (k >> 1) differs in one bit between neighbours on the grid.

    Parameters
    ----------
    unit : array of shape (P, d)
        Points of the unit box.
    bits : int
        Bits per parameter, at most 60.

    Returns
    -------
    array of uint8, shape (P, d * bits)
        One chromosome per point, most significant bit first.

    Examples
    --------
    >>> encode(np.array([[0.0], [1 / 3], [2 / 3], [1.0]]), 2).tolist()
    [[0, 0], [0, 1], [1, 1], [1, 0]]

    """
    k = np.minimum(np.rint(unit * (2.0**bits - 1)).astype(np.uint64), np.uint64(2**bits - 1))
    gray = k ^ (k >> np.uint64(1))
    shifts = np.arange(bits, dtype=np.uint64)[::-1]
    genes = (gray[:, :, None] >> shifts) & np.uint64(1)
    return genes.reshape(len(unit), -1).astype(np.uint8)


def decode(genes: Genes, bits: int) -> Array:
    """Decode chromosomes (P, d * bits) to points (P, d) of the unit box. Both ends of the box lie on the grid.

    Examples
    --------
    >>> decode(np.array([[1, 0], [0, 0]], dtype=np.uint8), 2).tolist()
    [[1.0], [0.0]]

    """
    binary = np.bitwise_xor.accumulate(genes.reshape(len(genes), -1, bits), axis=2)
    weights = 2.0 ** np.arange(bits - 1, -1, -1)
    return np.asarray(binary @ (weights / weights.sum()))


def random_genes(population: int, length: int, rng: np.random.Generator) -> Genes:
    """Draw chromosomes (population, length) of independent fair bits."""
    return rng.integers(0, 2, (population, length), dtype=np.uint8)


def rank_fitness(costs: Array) -> Array:
    """Compute the fitness of linear ranking with selective pressure 2.

        f = 2 (pos - 1)/(P - 1),  pos = 1 for the worst ... P for the best

    Equal costs share their mean position. "The fitness function is ordering distribution" (beam paper, 4.1). The
    paper does not specify the pressure; 2 is that of the common toolbox.

    Parameters
    ----------
    costs : array of shape (P,)
        Costs; lower is better.

    Returns
    -------
    array of shape (P,)
        Fitness from 0 (worst) to 2 (best), mean 1.

    Examples
    --------
    >>> rank_fitness(np.array([3.0, 1.0, 2.0])).tolist()
    [0.0, 2.0, 1.0]

    """
    ordered, n = np.sort(costs), len(costs)
    better, no_worse = ordered.searchsorted(costs, "left"), ordered.searchsorted(costs, "right")
    return (2 * n - 1 - better - no_worse) / (n - 1)


def universal_sampling(fitness: Array, n: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Draw parents by stochastic universal sampling: one turn of a wheel with n equally spaced pointers.

    Individual i is drawn n f_i / sum(f) times, rounded down or up, with exactly this mean. The order is shuffled, so
    that neighbours may mate.

    Parameters
    ----------
    fitness : array of shape (P,)
        Fitness f, not negative.
    n : int
        Number of parents.
    rng : numpy.random.Generator
        Source of random numbers.

    Returns
    -------
    array of int, shape (n,)
        Indices of the parents.

    References
    ----------
    Baker, J. E. (1987). Reducing bias and inefficiency in the selection algorithm. Proc. 2nd Int. Conf. on Genetic
    Algorithms, 14-21.

    """
    edges = np.cumsum(fitness)
    pointers = (rng.random() + np.arange(n)) * (edges[-1] / n)
    return rng.permutation(edges[:-1].searchsorted(pointers, "right"))


def roulette(fitness: Array, n: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Draw n parents (n,) independently, each with a probability proportional to its fitness (P,)."""
    edges = np.cumsum(fitness)
    return edges[:-1].searchsorted(rng.random(n) * edges[-1], "right")


def tournament(fitness: Array, n: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Draw n parents (n,): each is the fitter of two individuals drawn at random."""
    first, second = rng.integers(len(fitness), size=(2, n))
    return np.where(fitness[first] >= fitness[second], first, second)


SELECTIONS = {"universal": universal_sampling, "roulette": roulette, "tournament": tournament}


def one_point_crossover(genes: Genes, probability: float, rng: np.random.Generator) -> Genes:
    """Swap the tails of neighbouring rows (0, 1), (2, 3), ... behind one random cut, each pair with `probability`."""
    pairs, length = len(genes) // 2, genes.shape[1]
    cut = rng.integers(1, max(2, length), pairs)
    cut[rng.random(pairs) >= probability] = length
    tail = np.arange(length) >= cut[:, None]
    children = genes.copy()
    first, second = children[0 : 2 * pairs : 2], children[1 : 2 * pairs : 2]
    swap = (first ^ second) & tail
    first ^= swap
    second ^= swap
    return children


def flip_bits(genes: Genes, probability: Array, rng: np.random.Generator) -> Genes:
    """Mutate bits: every bit of row i flips with ``probability[i]``; `probability` has shape (P,)."""
    draw = rng.random(genes.shape, dtype=np.float32)
    return genes ^ (draw < probability[:, None].astype(np.float32))


def metropolis(new: Array, old: Array, temperature: float, rng: np.random.Generator) -> Mask:
    """Decide by Metropolis' rule which new costs are accepted.

    A cost not above the old one is always accepted; a rise is accepted with probability exp(-rise/T). A step from an
    infinite cost is always accepted, so that a chain can leave such a point.

    Parameters
    ----------
    new, old : array of shape (P,)
        Costs after and before the step.
    temperature : float
        T, in the unit of the costs.
    rng : numpy.random.Generator
        Source of random numbers.

    Returns
    -------
    array of bool, shape (P,)
        True where the step is accepted.

    References
    ----------
    Metropolis, N. et al. (1953). Equation of state calculations by fast computing machines. J. Chem. Phys. 21,
    1087-1092.

    """
    rise = np.zeros(len(new))
    np.subtract(new, old, out=rise, where=new > old)
    return np.asarray(rng.random(len(new)) < np.exp(-rise / max(temperature, MIN_TEMPERATURE)))


def geometric_cooling(generation: int, limit: int, first: float, final: float) -> float:
    """Compute the temperature T = first final^(G/G_max): from ``first`` to ``first * final`` over the budget.

    Examples
    --------
    >>> geometric_cooling(50, 100, 1.0, 1e-4)
    0.01

    """
    return first * final ** (generation / limit)


def linear_cooling(generation: int, limit: int, first: float, final: float) -> float:
    """Compute the temperature that falls by the same step in each generation, from ``first`` to ``first * final``."""
    return first * (1 + (final - 1) * generation / limit)


Cooling = Literal["geometric", "linear"]
COOLING = {"geometric": geometric_cooling, "linear": linear_cooling}


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

    population: int = setting(40, ge=4, le=10**6)  # individuals
    gap: float = setting(0.9, gt=0, le=1)  # generation gap: children per generation over population
    selection: Literal["universal", "roulette", "tournament"] = (
        "universal"  # how parents are drawn by their rank fitness
    )

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
    bits: int = setting(20, ge=1, le=MAX_BITS)  # code length L per parameter
    crossover: float = setting(0.7, ge=0, le=1)  # P_c, per pair
    mutation: float | None = setting(None, ge=0, le=1)  # P_m, per bit; None: 0.7 / chromosome length

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
    temperature: float | None = setting(None, gt=0)  # T_0 over (median - minimum) of the first costs; None: 0.3
    final: float = setting(1e-4, gt=0, le=1)  # T at the end of the budget over T_0
    cooling: Cooling = "geometric"

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
    a: float | None = setting(None, ge=0)  # Eq. 5; None: 10/G_max
    b: float = setting(0.4, ge=0, le=1)  # Eq. 5
    c: float | None = setting(None, ge=0)  # Eq. 6; None: 20/G_max, as printed 2/G_max
    # Eq. 6; None: four bits of the longest chromosome, printed 0.05
    p_const: float | None = setting(None, ge=0, le=1)
    l_const: int = setting(10, ge=1, le=MAX_BITS // 2)  # Eq. 7
    d: float = setting(0.2, gt=0)  # Eq. 7
    s: float | None = setting(None, gt=0)  # Eq. 7; None: G_max/4
    bits: int | None = setting(None, ge=1, le=MAX_BITS)  # a fixed code length in place of Eq. 7 (Table 5 has 20)
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


TARGET_ACCEPTANCE = 0.44  # the share of accepted moves that explores fastest in one dimension (Gelman et al. 1996)
STEP_ADAPTATION_RATE = 0.3  # how fast a step length follows its acceptance


@dataclass(frozen=True)
class SA(SearchMethod):
    """Simulated annealing: one coordinate per move, Metropolis' rule, cooling from T_0 to ``final`` T_0.

    The collision paper specifies Metropolis' rule only; moves and cooling are chosen here. A move is Cauchy
    distributed (mostly near, sometimes into another valley) and mirrored at the bounds. Its scale follows the
    acceptance rate of each chain and coordinate. One generation is one move of every chain.

    References
    ----------
    Kirkpatrick, S., Gelatt, C. D. & Vecchi, M. P. (1983). Optimization by simulated annealing. Science 220, 671-680.
    Szu, H. & Hartley, R. (1987). Fast simulated annealing. Physics Letters A 122, 157-162.
    Corana, A. et al. (1987). Minimizing multimodal functions of continuous variables. ACM Trans. Math. Softw. 13,
    262-280.

    """

    name: ClassVar[str] = "sa"
    chains: int = setting(8, ge=1, le=10**6)  # few and long: more chains cool faster within the same budget
    temperature: float = setting(0.1, gt=0)  # T_0 over (median - minimum) of the first population's costs
    final: float = setting(1e-6, gt=0, le=1)  # T at the end of the budget over T_0
    cooling: Cooling = "geometric"

    @property
    def points(self) -> tuple[int, int]:
        """One point per chain."""
        return self.chains, self.chains

    def __call__(self, evaluator: CostEvaluator, rng: np.random.Generator) -> None:
        """Search until the evaluator stops it."""
        d, rows = evaluator.dimension, np.arange(self.chains)
        limit, cool = self.limit(evaluator), COOLING[self.cooling]
        unit = rng.random((self.chains, d))
        step = np.full((self.chains, d), 0.5)
        costs = evaluator(unit)
        for generation in evaluator.generations():
            column = rng.integers(d, size=self.chains)
            moved = unit.copy()
            moved[rows, column] += step[rows, column] * rng.standard_cauchy(self.chains)
            moved = np.abs((moved + 1) % 2 - 1)  # mirrored into the unit box
            moved_costs = evaluator(moved)
            T = evaluator.initial_spread * cool(generation, limit, self.temperature, self.final)
            accepted = metropolis(moved_costs, costs, T, rng)
            unit[accepted], costs[accepted] = moved[accepted], moved_costs[accepted]
            step[rows, column] *= np.exp(STEP_ADAPTATION_RATE * (accepted - TARGET_ACCEPTANCE))
            np.minimum(step, 1.0, out=step)
            evaluator.population = unit, costs
