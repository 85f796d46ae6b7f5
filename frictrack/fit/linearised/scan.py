"""Scan a candidate effect over a grid: the gain of every grid point added to the fitted model.

A candidate's rows are the response of the measured motion to its force (or measurement shift), with the feedback of
the fitted model. Phases enter as two quadratures with free coefficients; a modifier as the change that it makes at
depth one. The gain is the fall of chi-squared after the whole linearised model has been fitted again, friction levels
held by their scatter.

The model leaves W = I - U S U' of a column, U its orthonormal basis and S the shrinkage by the scatter of the friction
levels. The levels belong to single runs, and all other parameters of the model are few: so W is one small matrix per
run less a product T T' of few columns. With whitened products w of the runs, the gain of a candidate with coefficients
per run is |w|^2 + (T'w)' (1 - T'T)^-1 (T'w) (Woodbury's identity).

References
----------
Golub, G. H. & Pereyra, V. (1973). SIAM J. Numer. Anal. 10, 413-432.
Golub, G. H. & Van Loan, C. F. (2013). Matrix Computations, section 2.1.4.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frictrack.base.workers import map_in_threads, rows_at_once
from frictrack.fit.linearised.columns import (
    MIN_COLUMN_SQUARE,
    CandidateGrid,
    ColumnProducts,
    SeriesOfPiece,
    column_products,
    series_of_run,
)
from frictrack.fit.linearised.model import Float32Array, LinearisedModel, ScannedSeries
from frictrack.fit.linearised.waves import WaveProducts, are_sums_of_waves
from frictrack.records import Array

MIN_UNEXPLAINED_SHARE = 1e-10  # smallest share of a column outside the model
MAX_NEGLECTED_SHARE = 1e-4  # of a gain, as in sums of plain waves, by a column that runs share
MAX_ABSORBED_LEFT = 10 * MAX_NEGLECTED_SHARE  # of a shared direction that is absorbed but for what was neglected
MIN_SHARED_SHARE = 1e-11  # of a unit column; what several runs share and is smaller is rounding
MAX_COLUMNS_EVERY_SCATTER = 200  # of a grid that is evaluated at every scatter of the levels
MIN_POINTS_AT_ONCE = 16  # from which products with many series are not limited by the memory
WAVES_AT_ONCE = 48


@dataclass(frozen=True, eq=False)
class CandidateScan:
    """The scan of a candidate grid: the products of its columns with model and data, and its gains.

    Attributes
    ----------
    grid : CandidateGrid
        The G points.
    products : list of ColumnProducts
        For every block of runs, the products of its columns with the model and the measured series.
    rows : list of array of shape (L_b,)
        For every block, which of all L coordinates it has.
    gains : array of shape (G,)
        Fall of chi-squared of the data.
    max_gains : array of shape (D,)
        Largest gain of every series.

    """

    grid: CandidateGrid
    products: list[ColumnProducts]
    rows: list[NDArray[np.int_]]
    gains: Array
    max_gains: Array

    @property
    def squares(self) -> Array:
        """Squares of the columns of every block, starts projected out, (G, B, k)."""
        return np.stack([own.squares for own in self.products], axis=1)

    def schur(self, projector: Array) -> Array:
        """Compute the Gram matrices (G, B, k, k) of every block alone with the model projected out.

        `projector` (L, L) comes from `LinearisedModel.residual_projector`.
        """
        pairs = zip(self.products, self.rows, strict=True)
        return np.stack([own.schur(projector[np.ix_(rows, rows)]) for own, rows in pairs], axis=1)

    def coefficients(self, g: int, projector: Array, data: Array) -> Array:
        """Compute the best coefficients (K,) at grid point g.

        Parameters
        ----------
        g : int
            Grid point.
        projector : array of shape (L, L)
            From `LinearisedModel.residual_projector`.
        data : array of shape (L,)
            Coordinates of the scanned series.

        Returns
        -------
        array of shape (K,)
            Least-squares coefficients.

        """
        k, size = self.grid.k, self.grid.size
        gram, coordinates = np.zeros((size, size)), np.zeros((size, len(data)))
        for b, (products, rows) in enumerate(zip(self.products, self.rows, strict=True)):
            own = slice(b * k, (b + 1) * k)
            gram[own, own], coordinates[own, rows] = products.gram[g], products.coordinates[g]
        right = np.concatenate([products.data[g] for products in self.products])
        root = whitener(gram + coordinates @ projector @ coordinates.T, np.diag(gram) + np.sum(coordinates**2, axis=1))
        return np.asarray(root.T @ (root @ (right + coordinates @ (projector @ data))))


def scan_candidates(law: LinearisedModel, grids: Sequence[CandidateGrid], series: ScannedSeries) -> list[CandidateScan]:
    """Scan candidate grids added to a fitted model; see `scan_candidate`."""
    return map_in_threads(lambda grid: scan_candidate(law, grid, series), grids)


def scan_candidate(law: LinearisedModel, grid: CandidateGrid, series: ScannedSeries) -> CandidateScan:
    """Scan a candidate grid added to a fitted model.

    Parameters
    ----------
    law : LinearisedModel
        The fitted model.
    grid : CandidateGrid
        The candidate.
    series : ScannedSeries
        The data.

    Returns
    -------
    CandidateScan
        Gains and products of all grid points.

    """
    absorption, products = _Absorption(law, grid, series), _products_of_blocks(law, grid, series)
    gains, max_gains, kept = [], np.full(series.profile.shape[1], -np.inf), []
    for points in _parts(law, grid):
        parts = [of_block(points) for of_block in products]
        found = absorption.gains(parts)
        gains.append(found[:, 0])
        max_gains = np.maximum(max_gains, found.max(axis=0))
        kept.append([own.without_draws() for own in parts])
    blocks = [ColumnProducts.over_points(own) for own in zip(*kept, strict=True)]
    return CandidateScan(grid, blocks, absorption.rows, np.concatenate(gains), max_gains)


def _parts(law: LinearisedModel, grid: CandidateGrid) -> Iterator[slice]:
    """Divide a grid into points that are evaluated together; waves of one envelope, or as many as suit the cache."""
    line, size = len(grid.values), max(len(law.pieces[i].path_for(grid.effect).t) for i in grid.members)
    at_once = max(MIN_POINTS_AT_ONCE, rows_at_once(size))
    if any(are_sums_of_waves(grid, law.pieces[i]) for i in grid.members):
        line, at_once = grid.shape[-1], WAVES_AT_ONCE
    for first in range(0, len(grid.values), line):
        for at in range(first, first + line, at_once):
            yield slice(at, min(at + at_once, first + line))


def _products_of_blocks(
    law: LinearisedModel, grid: CandidateGrid, series: ScannedSeries
) -> list[Callable[[slice], ColumnProducts]]:
    """What computes the products of the columns of every block at some grid points."""

    def of_piece(i: int, own: SeriesOfPiece) -> Callable[[slice], ColumnProducts]:
        piece = law.pieces[i]
        if are_sums_of_waves(grid, piece):
            return WaveProducts(law, grid, i, own, series.kept)
        return lambda points: column_products(piece, grid.whitened_columns(piece, grid.values[points]), grid.k, own)

    def of_run(run: int) -> Callable[[slice], ColumnProducts]:
        pairs = zip(law.members(run), series_of_run(law, run, series), strict=True)
        pieces = [of_piece(i, own) for i, own in pairs]
        return pieces[0] if len(pieces) == 1 else lambda points: ColumnProducts.of_run(at(points) for at in pieces)

    def together(block: list[int]) -> Callable[[slice], ColumnProducts]:
        runs = [of_run(run) for run in sorted({law.pieces[i].run for i in block})]
        return lambda points: ColumnProducts.of_runs(at(points) for at in runs)

    return [together(block) for block in grid.blocks]


class _Absorption:
    """What the model absorbs of a candidate's columns at the scatters of the levels that are considered, T of them."""

    # A small grid is evaluated at every scatter, because the candidate may explain what looked like scatter. Every
    # other is evaluated for each series at its own scatter. The views say at which of the T scatters which series are
    # seen.

    def __init__(self, law: LinearisedModel, grid: CandidateGrid, series: ScannedSeries) -> None:
        self._profile, self._limits = series.profile, _sign_limits(grid.low, grid.high)
        self.rows = [_coordinate_rows(law, block) for block in grid.blocks]
        groups = dict(enumerate(series.groups))
        if len(grid.values) * grid.size <= MAX_COLUMNS_EVERY_SCATTER:
            groups = dict.fromkeys(range(len(series.taus)), slice(0, series.profile.shape[1]))
        used = sorted((own.start, own.stop, t) for t, own in groups.items() if own.stop > own.start)  # measured first
        self._views = [(t, slice(start, stop)) for start, stop, t in used]
        self._projected = [series.projected(t)[:, columns] for t, columns in self._views]
        parts = [_block_parts(law, series, self.rows, t) for t, _ in self._views]
        self._left = [np.stack(own) for own in zip(*(left for left, _ in parts), strict=True)]
        self._shared = _padded([shared for _, shared in parts])

    def gains(self, parts: Sequence[ColumnProducts]) -> Array:
        """Gains (g, D) of the columns of all blocks at some grid points."""
        shape = len(parts[0].data), self._shared.shape[2]
        squares = [np.zeros((shape[0], own.shape[1])) for own in self._projected]
        across = [np.zeros((*shape, own.shape[1])) for own in self._projected]
        within, coupled = np.zeros((len(self._views), *shape, shape[1])), np.zeros(shape[0], dtype=bool)
        for own, rows, left in zip(parts, self.rows, self._left, strict=True):
            roots = whitener(own.schur(left), own.squares)
            shared = roots @ (own.coordinates @ self._shared[:, None, rows])  # T'w of the identity is shared' w
            here = np.any(np.sum(shared**2, axis=(2, 3)) > MAX_NEGLECTED_SHARE, axis=0)
            for i, (_, columns) in enumerate(self._views):
                for part, products in self._whitened(roots[i], own, columns, self._projected[i][rows]):
                    squares[i][:, part] += np.einsum("gkd,gkd->gd", products, products)
                    if here.any():
                        across[i][:, :, part] += shared[i].transpose(0, 2, 1) @ products
            if here.any():
                coupled |= here
                within += shared.transpose(0, 1, 3, 2) @ shared
        least = np.full((shape[0], self._profile.shape[1]), np.inf)
        for i, (t, columns) in enumerate(self._views):
            if coupled.any():
                root = _inverse_root(np.eye(shape[1]) * (1 + MIN_UNEXPLAINED_SHARE) - within[i, coupled])
                squares[i][coupled] += np.sum((root @ across[i][coupled]) ** 2, axis=1)
            least[:, columns] = np.minimum(least[:, columns], self._profile[t, columns] - squares[i])
        return np.asarray(self._profile.min(axis=0) - least)

    def _whitened(
        self, root: Array, own: ColumnProducts, columns: slice, projected: Array
    ) -> Iterator[tuple[slice, Array | Float32Array]]:
        """Whitened products (g, k, d) with the measured series, with all digits, and with the draws of a view."""
        unit, root = own.coordinates / own.size[:, :, None], root * own.size[:, None, :]
        count = int(columns.start == 0)
        if count:
            measured = (own.data / own.size)[:, :, None] + unit @ projected[:, :1]
            yield slice(0, 1), self._bounded(root @ measured)
        rest = unit.reshape(-1, unit.shape[2]) @ projected[:, count:]  # terms may cancel: in double precision
        products = own.draws[:, :, columns.start + count - 1 : columns.stop - 1]
        products, single = products + rest.astype(np.float32).reshape(products.shape), root.astype(np.float32)
        products = single * products if root.shape[2] == 1 else single @ products
        yield slice(count, None), self._bounded(products)

    def _bounded(self, products: Array | Float32Array) -> Array | Float32Array:
        return products if self._limits == (-np.inf, np.inf) else products.clip(*self._limits)


def _block_parts(
    law: LinearisedModel, series: ScannedSeries, rows: Sequence[NDArray[np.int_]], t: int
) -> tuple[list[Array], Array]:
    """What a scatter of the levels leaves of coordinates by every block, and T (L, p) that couples the blocks."""
    # the friction level of a run absorbs its part alone
    projector = series.residual_projectors[t]
    if len(rows) == 1:
        return [projector[np.ix_(rows[0], rows[0])]], np.zeros((len(projector), 0))
    if t not in series.kept:
        levels, tau = law.level_coordinates * law.basis.random, float(series.taus[t])
        levels = levels * (tau / np.sqrt(1 + tau**2 * np.sum(levels**2, axis=0)))
        size, directions = np.linalg.eigh(np.eye(len(projector)) - projector - levels @ levels.T)
        kept = size > MIN_SHARED_SHARE
        series.kept[t] = levels, directions[:, kept] * np.sqrt(size[kept])
    levels, shared = series.kept[t]
    return [np.eye(len(r)) - levels[r] @ levels[r].T for r in rows], shared


def _coordinate_rows(law: LinearisedModel, pieces: Sequence[int]) -> NDArray[np.int_]:
    """Rows of the coordinates of the runs of some pieces among all L."""
    runs, every = {law.pieces[i].run for i in pieces}, np.arange(len(law.basis_coordinates))
    own = [every[at] for run, at in zip(law.runs, law.coordinate_slices, strict=True) if run in runs]
    return np.concatenate(own)


def _padded(matrices: Sequence[Array]) -> Array:
    """Stack matrices (L, p) of T scatters, those with fewer columns filled up with zeros, (T, L, p)."""
    width = max(m.shape[1] for m in matrices)
    return np.stack([np.pad(m, ((0, 0), (0, width - m.shape[1]))) for m in matrices])


def whitener(schur: Array, full: Array) -> Array:
    """Compute W (..., K, K) with W'W the inverse of projected Gram matrices. Absorbed columns gain nothing.

    `full` (..., K) are the squares of the columns before the projection. W is lower triangular.
    """
    size = np.sqrt(full)
    size[full < MIN_COLUMN_SQUARE] = np.inf
    unit = schur / size[..., :, None] / size[..., None, :]
    root = np.zeros(unit.shape)
    for i in range(unit.shape[-1]):  # Gram-Schmidt: row i, less what the rows before it are of it
        across = root[..., :i, :i] @ unit[..., :i, i, None]
        root[..., i, :i] = -(root[..., :i, :i].swapaxes(-1, -2) @ across)[..., 0]
        root[..., i, i] = 1.0
        left = unit[..., i, i] - np.sum(across[..., 0] ** 2, axis=-1)
        root[..., i, :] /= np.sqrt(np.maximum(left, 0.0) + MIN_UNEXPLAINED_SHARE)[..., None]
    return np.asarray(root / size[..., None, :])


def _inverse_root(gram: Array) -> Array:
    """Compute W (..., K, K) with W'W the inverse of matrices; directions that neglected shares absorb gain nothing."""
    # a difference from the identity may come out indefinite, because small shares of its columns were neglected
    left, axes = np.linalg.eigh(gram)
    floor = np.where(left[..., :1] > 0, 0.0, MAX_ABSORBED_LEFT)
    size = np.where(left > floor, 1 / np.sqrt(np.maximum(left, MIN_UNEXPLAINED_SHARE)), 0.0)
    return np.asarray(size[..., :, None] * np.swapaxes(axes, -1, -2))


def _sign_limits(low: Array, high: Array) -> tuple[float, float]:
    """Limits of the product of a single bounded coefficient: data that ask for the wrong sign gain nothing."""
    if len(low) > 1:
        return -np.inf, np.inf
    return (0.0 if low[0] >= 0 else -np.inf), (0.0 if high[0] <= 0 else np.inf)
