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
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.linearised.series import Absorbed, Float32Array
from frictrack.records import Array

Products = Array | Float32Array

MIN_UNEXPLAINED_SHARE = 1e-10  # smallest share of a column outside the model
MAX_NEGLECTED_SHARE = 1e-4  # of a gain, as in sums of plain waves: by a shared column, or another scatter of the levels
MAX_ABSORBED_LEFT = 10 * MAX_NEGLECTED_SHARE  # of a shared direction that is absorbed but for what was neglected
MIN_COLUMN_SQUARE = 1e-20  # smaller squares belong to places that no run reaches


def whitener(schur: Array, full: Array) -> Array:
    """Compute W (..., K, K) with W'W the inverse of projected Gram matrices. Absorbed columns gain nothing.

    `full` (..., K) are the squares of the columns before the projection. W is lower triangular.
    """
    size = np.sqrt(full)
    size[full < MIN_COLUMN_SQUARE] = np.inf
    unit_gram = schur / size[..., :, None] / size[..., None, :]
    if unit_gram.shape[-1] == 1:
        return np.asarray(1 / np.sqrt(np.maximum(unit_gram, 0.0) + MIN_UNEXPLAINED_SHARE) / size[..., None, :])
    diagonal = np.arange(unit_gram.shape[-1])
    unit_gram[..., diagonal, diagonal] += MIN_UNEXPLAINED_SHARE
    return np.asarray(inverse_cholesky(unit_gram) / size[..., None, :])


def inverse_cholesky(gram: Array) -> Array:
    """Compute the inverses of the Cholesky factors of matrices (..., K, K); those of two columns in closed form."""
    if gram.shape[-1] != 2:  # of any number of matrices, also none
        return np.asarray(np.linalg.inv(np.linalg.cholesky(gram)))
    out = np.zeros(gram.shape)
    first = 1 / np.sqrt(gram[..., 0, 0])
    across = gram[..., 1, 0] * first
    second = 1 / np.sqrt(gram[..., 1, 1] - across**2)
    out[..., 0, 0], out[..., 1, 1] = first, second
    out[..., 1, 0] = -across * first * second
    return out


def _inverse_root(gram: Array) -> Array:
    """Compute W (..., K, K) with W'W the inverse of matrices; directions that neglected shares absorb gain nothing.

    A difference from the identity may come out indefinite, because small shares of its columns were neglected.
    """
    try:
        return inverse_cholesky(gram)
    except np.linalg.LinAlgError:
        left, axes = np.linalg.eigh(gram)
        floor = np.where(left[..., :1] > 0, 0.0, MAX_ABSORBED_LEFT)
        size = np.where(left > floor, 1 / np.sqrt(np.maximum(left, MIN_UNEXPLAINED_SHARE)), 0.0)
        return np.asarray(size[..., :, None] * np.swapaxes(axes, -1, -2))


class SeriesProducts(Protocol):
    """Products of the columns at some grid points with the series."""

    @property
    def points(self) -> slice:
        """The grid points, c of them."""

    def mixed(self, mix: Array, series: slice) -> Float32Array:
        """Compute products (c, q, d) of combinations `mix` (c, q, k) of the k columns with some of the series."""


@dataclass(frozen=True, eq=False)
class ColumnSums:
    """Products of columns of one block of runs at some grid points, g of them.

    Attributes
    ----------
    points : slice
        The grid points.
    gram : array of shape (g, k, k)
        Gram matrices of the columns outside the bases of the pieces.
    data : array of shape (g, k)
        Products of these remainders with the measured series.
    coordinates : array of shape (g, k, L_b)
        Coordinates of the columns in the bases of the pieces of the block.
    products : list of SeriesProducts
        Products with the series; together they cover the points.

    """

    points: slice
    gram: Array
    data: Array
    coordinates: Array
    products: list[SeriesProducts]

    @property
    def full(self) -> Array:
        """Squares of the columns, starts projected out, (g, k)."""
        return np.asarray(np.einsum("gkk->gk", self.gram) + np.einsum("gkl,gkl->gk", *[self.coordinates] * 2))

    def schur(self, left: Array) -> Array:
        """Gram matrices (T, g, k, k) of what the model leaves of the columns; `left` (T, L_b, L_b) of coordinates."""
        return np.asarray(self.gram + self.times(left) @ self.coordinates.transpose(0, 2, 1))

    def times(self, matrices: Array) -> Array:
        """Multiply the coordinates with matrices (T, L_b, q), one product each; gives (T, g, k, q)."""
        flat = self.coordinates.reshape(-1, self.coordinates.shape[2]) @ matrices
        return np.asarray(flat.reshape(len(matrices), *self.data.shape, -1))

    def of_data(self, projected: Array) -> Array:
        """Products (g, k) with the measured series; `projected` (L_b,) is what the model leaves of its coordinates."""
        return np.asarray(self.data + self.coordinates @ projected)


class GridGains:
    """Gains of a grid for all series, each at its own scatter of the levels, summed block by block.

    Parameters
    ----------
    absorbed : dict
        What the model absorbs at every scatter that is the own estimate of some series, by number of the scatter.
    groups : sequence of slice
        The series whose own estimate each scatter is; the measured series is the first one of all.
    count : int
        Number G of grid points.
    limits : tuple of float
        Bounds of whitened products: (0, inf) where a single coefficient must be positive.

    """

    def __init__(
        self, absorbed: dict[int, Absorbed], groups: Sequence[slice], count: int, limits: tuple[float, float]
    ) -> None:
        self._limits, self._groups = limits, [groups[t] for t in absorbed]
        self._left = [np.stack(of_block) for of_block in zip(*(a.left for a in absorbed.values()), strict=True)]
        self._shared = _side_by_side([a.shared for a in absorbed.values()])
        self._own = next(i for i, columns in enumerate(self._groups) if columns.start == 0)
        series = max(columns.stop for columns in self._groups)
        self._squares = np.zeros((count, series), dtype=np.float32)
        self._coupled = [_Coupled(count, self._shared.shape[2], c) for c in self._groups]
        self._of_data = np.zeros(count)
        self._coupled_data = _Coupled(count, self._shared.shape[2], slice(0, 1), np.float64)

    def add(self, block: int, rows: NDArray[np.int_], sums: ColumnSums, data: Array) -> None:
        """Add some columns of one block, with its `rows` among all coordinates; `data` (g, k) are those measured."""
        roots, shared = _mixes(sums, self._left[block], self._shared[:, rows])
        root = roots[self._own]
        measured = (root @ data[:, :, None]).clip(*self._limits)
        self._of_data[sums.points] += np.sum(measured[:, :, 0] ** 2, axis=1)
        self._coupled_data.add(sums.points, shared[self._own], shared[self._own] @ measured)
        coupled = np.any(np.sum(shared**2, axis=(2, 3)) > MAX_NEGLECTED_SHARE, axis=0)
        spread = np.abs(roots - root).max(axis=(0, 2, 3))
        varied = coupled | (2 * spread > MAX_NEGLECTED_SHARE * np.abs(root).max(axis=(1, 2)))
        for part in sums.products:
            own = slice(part.points.start - sums.points.start, part.points.stop - sums.points.start)
            if not varied[own].any():
                self._add_squares(part, root[own], slice(0, self._squares.shape[1]))
                continue
            for t, columns in enumerate(self._groups):
                others = (t, shared[t, own]) if coupled[own].any() else None
                self._add_squares(part, roots[t, own], columns, others)

    def _add_squares(
        self, part: SeriesProducts, root: Array, columns: slice, coupled: tuple[int, Array] | None = None
    ) -> None:
        """Add whitened products of some series, and those with the shared columns (c, p, k) of one scatter."""
        k = root.shape[1]
        mix = root if coupled is None else np.concatenate([root, coupled[1] @ root], axis=1)
        mixed = self._bounded(part.mixed(mix, columns))
        self._squares[part.points, columns] += np.einsum("gkd,gkd->gd", mixed[:, :k], mixed[:, :k])
        if coupled is not None:
            self._coupled[coupled[0]].add(part.points, coupled[1], mixed[:, k:])

    def _bounded(self, products: Float32Array) -> Float32Array:
        return products if self._limits == (-np.inf, np.inf) else products.clip(*self._limits)

    def totals(self) -> tuple[Array, Array]:
        """Gains of the measured series (G,), and the largest of every series (D,)."""
        for coupled in self._coupled:
            points, gains = coupled.gains()
            self._squares[points, coupled.series] += gains
        points, gains = self._coupled_data.gains()
        self._of_data[points] += gains[:, 0]
        return self._of_data, self._squares.max(axis=0).astype(np.float64)


def _mixes(sums: ColumnSums, left: Array, shared: Array) -> tuple[Array, Array]:
    """What whitens columns of one block (T, g, k, k), and the columns that it shares with others (T, g, p, k).

    `left` (T, L_b, L_b) and `shared` (T, L_b, p) are those of T scatters of the levels.
    """
    roots = whitener(sums.schur(left), sums.full)
    return roots, (roots @ sums.times(shared)).transpose(0, 1, 3, 2)


def _side_by_side(matrices: Sequence[Array]) -> Array:
    """Stack matrices (L, p) of T scatters, those with fewer columns filled up with zeros, (T, L, p)."""
    out = np.zeros((len(matrices), len(matrices[0]), max(m.shape[1] for m in matrices)))
    for room, matrix in zip(out, matrices, strict=True):
        room[:, : matrix.shape[1]] = matrix
    return out


class _Coupled:
    """Whitened products (G, p, D) with the p columns that the blocks share, and what these leave of each other."""

    def __init__(self, count: int, p: int, series: slice, dtype: type = np.float32) -> None:
        self.series = series
        self._products: Products = np.zeros((count, p, series.stop - series.start), dtype=dtype)
        self._left = np.zeros((count, p, p)) + np.eye(p)
        self._found = np.zeros(count, dtype=bool)

    def add(self, points: slice, shared: Array, products: Products) -> None:
        """Add products (g, p, D) of one block, with its shared columns (g, p, k)."""
        self._left[points] -= shared @ shared.transpose(0, 2, 1)
        self._products[points] += products
        self._found[points] = self._products.shape[1] > 0

    def gains(self) -> tuple[NDArray[np.int_], Products]:
        """Points (m,) at which blocks are coupled, and what that adds to the gains (m, D)."""
        points = np.flatnonzero(self._found)
        left = self._left[points]
        diagonal = np.arange(left.shape[1])
        left[:, diagonal, diagonal] += MIN_UNEXPLAINED_SHARE
        root = np.asarray(_inverse_root(left), dtype=self._products.dtype)
        whitened: Products = np.matmul(root, self._products[points])
        return points, np.einsum("gkd,gkd->gd", whitened, whitened)


def sign_limits(low: Array, high: Array) -> tuple[float, float]:
    """Limits of the product of a single bounded coefficient: data that ask for the wrong sign gain nothing.

    Examples
    --------
    >>> sign_limits(np.array([0.0]), np.array([5.0]))
    (0.0, inf)

    """
    if len(low) > 1:
        return -np.inf, np.inf
    return (0.0 if low[0] >= 0 else -np.inf), (0.0 if high[0] <= 0 else np.inf)
