"""Compute the gain of chi-squared of every grid point and series, run by run.

The Gram matrix of a candidate with coefficients per run is one small block per run, less a product T T' of the few
columns that the runs share through the model. With whitened products w of the blocks, the gain is
|w|^2 + (T'w)' (1 - T'T)^-1 (T'w).

References
----------
Golub, G. H. & Van Loan, C. F. (2013). Matrix Computations, section 2.1.4 (Woodbury's identity).

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.linearised.series import Absorbed, Float32Array
from frictrack.records import Array

Products = Array | Float32Array

MIN_UNEXPLAINED_SHARE = 1e-10  # smallest share of a column outside the model
MIN_COLUMN_SQUARE = 1e-20  # smaller squares belong to places that no run reaches
MAX_PRODUCTS_AT_ONCE = 300_000  # whitened at once, so that they fit into the cache


def whitener(schur: Array, full: Array) -> Array:
    """Compute W (..., K, K) with W'W the inverse of projected Gram matrices. Absorbed columns gain nothing.

    `full` (..., K) are the squares of the columns before the projection.
    """
    size = np.sqrt(full)
    size[full < MIN_COLUMN_SQUARE] = np.inf
    unit_gram = schur / size[..., :, None] / size[..., None, :]
    if unit_gram.shape[-1] == 1:
        return np.asarray(1 / np.sqrt(np.maximum(unit_gram, 0.0) + MIN_UNEXPLAINED_SHARE) / size[..., None, :])
    diagonal = np.arange(unit_gram.shape[-1])
    unit_gram[..., diagonal, diagonal] += MIN_UNEXPLAINED_SHARE
    return np.asarray(np.linalg.inv(np.linalg.cholesky(unit_gram)) / size[..., None, :])


@dataclass(frozen=True, eq=False)
class BlockSums:
    """Products of the columns of one block of runs, summed over its pieces.

    Attributes
    ----------
    gram : array of shape (G, k, k)
        Gram matrices of the columns outside the bases of the pieces.
    data : array of shape (G, k)
        Products of these remainders with the measured series.
    scale : array of shape (G, k)
        Size of the columns in `products`, so that no square leaves the range of a float32.
    products : array of shape (G, k, D), float32
        Products of the columns over `scale` with the residuals of the series; of the remainders only, where the grid is
        profiled.
    rows : array of shape (L_b,)
        Coordinates of the block among all L.
    coordinates : array of shape (G, k, L_b)
        Coordinates of the columns in the bases of the pieces.

    """

    gram: Array
    data: Array
    scale: Array
    products: Float32Array
    rows: NDArray[np.int_]
    coordinates: Array

    @property
    def full(self) -> Array:
        """Squares of the columns, starts projected out, (G, k)."""
        return np.asarray(np.einsum("gkk->gk", self.gram) + np.einsum("gkl,gkl->gk", *[self.coordinates] * 2))

    def left_gram(self, left: Array) -> Array:
        """Gram matrices (G, k, k) of what the model leaves of the columns; `left` (L_b, L_b) of their coordinates."""
        return np.asarray(self.gram + self.coordinates @ left @ self.coordinates.transpose(0, 2, 1))

    def from_coordinates(self, projected: Products) -> Products:
        """Products (G, k, D) of the coordinates over `scale` with the projected ones (L_b, D) of the series."""
        scaled = (self.coordinates / self.scale[:, :, None]).reshape(-1, len(self.rows))
        return np.matmul(scaled, projected, dtype=projected.dtype, casting="same_kind").reshape(*self.scale.shape, -1)


@dataclass(eq=False)
class GainSum:
    """Gains (G, D) of a grid at one scatter of the levels, summed block by block."""

    absorbed: Absorbed
    count: int
    series: int
    dtype: type = np.float32
    _squares: Array = field(init=False, repr=False)
    _shared: Array = field(init=False, repr=False)
    _left: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        p = self.absorbed.shared.shape[1]
        self._squares = np.zeros((self.count, self.series), dtype=self.dtype)
        self._shared = np.zeros((self.count, p, self.series), dtype=self.dtype)
        self._left = np.zeros((self.count, p, p)) + np.eye(p)

    def add(self, blocks: Sequence[int], sums: Sequence[BlockSums], products: Products) -> None:
        """Add some blocks with their products (G, B, k, D) over the columns' scale."""
        roots = [whitener(s.left_gram(self.absorbed.left[b]), s.full) for b, s in zip(blocks, sums, strict=True)]
        shared = [root @ (s.coordinates @ self.absorbed.shared[s.rows]) for root, s in zip(roots, sums, strict=True)]
        scaled = [root * s.scale[:, None, :] for root, s in zip(roots, sums, strict=True)]
        root: Products = np.stack(scaled, axis=1).astype(self.dtype)
        columns = np.concatenate(shared, axis=1)
        self._left -= columns.transpose(0, 2, 1) @ columns
        across: Products = columns.transpose(0, 2, 1).astype(self.dtype)
        step = max(1, MAX_PRODUCTS_AT_ONCE // max(int(np.prod(products.shape[1:])), 1))
        for first in range(0, self.count, step):
            part = slice(first, first + step)
            whitened = _lower_product(root[part], products[part]).reshape(len(root[part]), -1, self.series)
            self._squares[part] += np.einsum("gkd,gkd->gd", whitened, whitened)
            if across.shape[1]:
                self._shared[part] += across[part] @ whitened

    def total(self) -> Array:
        """Gains (G, D)."""
        if not self._shared.shape[1]:
            return self._squares
        diagonal = np.arange(self._left.shape[1])
        self._left[:, diagonal, diagonal] += MIN_UNEXPLAINED_SHARE
        root: Products = np.linalg.inv(np.linalg.cholesky(self._left)).astype(self.dtype)
        whitened = root @ self._shared
        return np.asarray(self._squares + np.einsum("gkd,gkd->gd", whitened, whitened))


def _lower_product(root: Products, products: Products) -> Products:
    """Multiply lower triangular matrices (..., k, k) with products (..., k, D), of which k is small."""
    out = np.empty(products.shape, dtype=products.dtype)
    for i in range(root.shape[-1]):
        np.multiply(root[..., i, :1], products[..., 0, :], out=out[..., i, :])
        for j in range(1, i + 1):
            out[..., i, :] += root[..., i, j : j + 1] * products[..., j, :]
    return out


def within_bounds(products: Products, low: Array, high: Array) -> Products:
    """Return products, zero where a single bounded coefficient asks for the wrong sign: such data gain nothing."""
    if len(low) > 1:
        return products
    if low[0] >= 0:
        products = np.maximum(products, 0.0)
    return np.minimum(products, 0.0) if high[0] <= 0 else products
