"""Operators of the evolutionary searches over a whole population: coding, ranking, selection, crossover, mutation.

Chromosomes are Gray-coded, `bits` bits per parameter.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask

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
    out: Array = (2 * n - 1 - better - no_worse) / (n - 1)
    return out


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


COOLING = {"geometric": geometric_cooling, "linear": linear_cooling}
