"""Gray-coded binary chromosomes: one bit string per individual, `bits` bits per parameter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array

Genes = NDArray[np.uint8]


def encode(unit: Array, bits: int) -> Genes:
    """Chromosomes (P, d bits) of points (P, d) in the unit box, rounded to the grid k/(2^bits - 1).

    Reflected Gray code g = k xor (k >> 1): neighbours on the grid differ in one bit.
    """
    k = np.minimum(np.rint(unit * (2.0**bits - 1)).astype(np.uint64), np.uint64(2**bits - 1))
    gray = k ^ (k >> np.uint64(1))
    shifts = np.arange(bits, dtype=np.uint64)[::-1]
    genes = (gray[:, :, None] >> shifts) & np.uint64(1)
    return genes.reshape(len(unit), -1).astype(np.uint8)


def decode(genes: Genes, bits: int) -> Array:
    """Points (P, d) in the unit box of chromosomes (P, d bits); both ends of the box are on the grid."""
    binary = np.bitwise_xor.accumulate(genes.reshape(len(genes), -1, bits), axis=2)
    weights = 2.0 ** np.arange(bits - 1, -1, -1)
    return np.asarray(binary @ (weights / weights.sum()))


def random_genes(population: int, length: int, rng: np.random.Generator) -> Genes:
    """Chromosomes (population, length) of fair coin flips."""
    return rng.integers(0, 2, (population, length), dtype=np.uint8)
