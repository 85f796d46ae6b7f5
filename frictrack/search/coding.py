"""Encode points as Gray-coded binary chromosomes and decode them: `bits` bits per parameter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frictrack.records import Array

Genes = NDArray[np.uint8]


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
