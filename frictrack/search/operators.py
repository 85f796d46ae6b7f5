"""The small interchangeable parts of the evolutionary searches. All are vectorised over the population."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array, Mask
from frictrack.search.coding import Genes

TINY = float(np.finfo(float).tiny)  # the coldest temperature that can be divided by


def rank_fitness(costs: Array) -> Array:
    """Linear ranking with selective pressure 2: fitness (P,) from 0 (worst) to 2 (best), mean 1.

        f = 2 (pos - 1)/(P - 1),  pos = 1 for the worst ... P for the best

    Equal costs share their mean position. "The fitness function is ordering distribution" (beam paper, 4.1);
    the pressure is not specified by the paper and is the one of the common toolbox.
    """
    ordered, n = np.sort(costs), len(costs)
    better, no_worse = ordered.searchsorted(costs, "left"), ordered.searchsorted(costs, "right")
    out: Array = (2 * n - 1 - better - no_worse) / (n - 1)
    return out


def universal_sampling(fitness: Array, n: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Stochastic universal sampling (Baker 1987): n parents (n,) from one turn of a wheel with n equal pointers.

    Individual i is drawn n f_i / sum(f) times, rounded down or up, with exactly this mean. The order is shuffled, so
    that neighbours may mate.
    """
    edges = np.cumsum(fitness)
    pointers = (rng.random() + np.arange(n)) * (edges[-1] / n)
    return rng.permutation(edges[:-1].searchsorted(pointers, "right"))


def one_point_crossover(genes: Genes, probability: float, rng: np.random.Generator) -> Genes:
    """Neighbouring rows (0, 1), (2, 3), ... swap their tails behind one random cut, each pair with `probability`."""
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
    """Bit mutation: every bit of row i flips with ``probability[i]``; `probability` (P,)."""
    draw = rng.random(genes.shape, dtype=np.float32)
    return genes ^ (draw < probability[:, None].astype(np.float32))


def metropolis(new: Array, old: Array, temperature: float, rng: np.random.Generator) -> Mask:
    """Metropolis' rule: accept (P,) costs no worse than `old` always, a rise with probability exp(-rise/T).

    A step from an infinitely bad point is always accepted, so that a chain can walk out of there.
    """
    rise = np.zeros(len(new))
    np.subtract(new, old, out=rise, where=new > old)
    return np.asarray(rng.random(len(new)) < np.exp(-rise / max(temperature, TINY)))


def geometric_cooling(generation: int, limit: int, first: float, final: float) -> float:
    """Temperature T = first final^(G/G_max): geometric, from ``first`` to ``first * final`` over the budget."""
    return first * final ** (generation / limit)
