"""Scan a candidate effect over a grid: the gain of every grid point beside the fitted model.

A candidate's rows are the response of the measured motion to its force (or measurement shift), with the feedback of
the fitted model. Phases enter as two quadratures with free coefficients; a modifier as the change that it makes at
depth one. The gain is the fall of chi-squared after the whole linearised model has been fitted again, friction levels
held by their scatter.

References
----------
Golub, G. H. & Pereyra, V. (1973). SIAM J. Numer. Anal. 10, 413-432.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.linearised.gains import BlockSums, GainSum, Products, whitener, within_bounds
from frictrack.fit.linearised.grid import CandidateGrid
from frictrack.fit.linearised.model import LinearisedModel
from frictrack.fit.linearised.products import block_sums, is_profiled
from frictrack.fit.linearised.series import Float32Array, ScannedSeries
from frictrack.records import Array

MAX_PRODUCTS_HELD = 2_500_000  # of columns with series; runs beyond are treated one after the other


@dataclass(frozen=True, eq=False)
class CandidateScan:
    """The scan of a candidate grid: its rows beside the model, and their products with the data.

    Attributes
    ----------
    grid : CandidateGrid
        The G points.
    gram : array of shape (G, B, k, k)
        Gram matrices of the columns of every block of runs, outside the bases of the pieces.
    coordinates : list of array of shape (G, k, L_b)
        For every block, coordinates of the columns in the pieces' bases.
    coordinate_rows : list of array of shape (L_b,)
        Which of all L coordinates these are.
    data_products : array of shape (G, B, k)
        Products of these remainders with the data.
    gains : array of shape (G,)
        Fall of chi-squared of the data.
    max_gains : array of shape (D,)
        Largest gain of every series.

    """

    grid: CandidateGrid
    gram: Array
    coordinates: list[Array]
    coordinate_rows: list[NDArray[np.int_]]
    data_products: Array
    gains: Array
    max_gains: Array

    @property
    def squares(self) -> Array:
        """Squares of the columns of every block, starts projected out, (G, B, k)."""
        known = [np.einsum("gkl,gkl->gk", mine, mine) for mine in self.coordinates]
        return np.asarray(np.einsum("gbkk->gbk", self.gram) + np.stack(known, axis=1))

    def schur(self, projector: Array) -> Array:
        """Compute the Gram matrices (G, B, k, k) of every block alone with the model projected out.

        `projector` (L, L) comes from `LinearisedModel.residual_projector`.
        """
        pairs = zip(self.coordinates, self.coordinate_rows, strict=True)
        left = [mine @ projector[np.ix_(rows, rows)] @ mine.transpose(0, 2, 1) for mine, rows in pairs]
        return np.asarray(self.gram + np.stack(left, axis=1))

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
        k = self.grid.k
        gram, coordinates = np.zeros((self.grid.size, self.grid.size)), np.zeros((self.grid.size, len(data)))
        for b, (mine, rows) in enumerate(zip(self.coordinates, self.coordinate_rows, strict=True)):
            own = slice(b * k, (b + 1) * k)
            gram[own, own], coordinates[own, rows] = self.gram[g, b], mine[g]
        schur = gram + coordinates @ projector @ coordinates.T
        root = whitener(schur, np.diag(gram) + np.sum(coordinates**2, axis=1))
        return np.asarray(root.T @ (root @ (self.data_products[g].ravel() + coordinates @ (projector @ data))))


def scan_candidate(law: LinearisedModel, grid: CandidateGrid, series: ScannedSeries) -> CandidateScan:
    """Scan a candidate grid beside a fitted model.

    A small grid is evaluated at every scatter of the levels, because the candidate may explain what looked like
    scatter.

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
    gains = _SeriesGains(law, grid, series)
    held: list[tuple[Array, Array, Array, NDArray[np.int_]]] = []
    for blocks, products in _batches(grid, series.residuals.shape[1]):
        sums = [block_sums(law, grid, grid.blocks[b], series, products[:, place]) for place, b in enumerate(blocks)]
        gains.add(blocks, sums, products)
        held.extend((s.gram, s.data, s.coordinates, s.rows) for s in sums)
    gram, data, coordinates, rows = zip(*held, strict=True)
    of_data, max_gains = gains.total()
    max_gains[0] = of_data.max()
    return CandidateScan(
        grid, np.stack(gram, axis=1), list(coordinates), list(rows), np.stack(data, axis=1), of_data, max_gains
    )


def _batches(grid: CandidateGrid, series: int) -> Iterator[tuple[range, Float32Array]]:
    """Yield blocks of runs to be treated together, and room for their products (G, B, k, D)."""
    count = len(grid.blocks)
    size = int(np.clip(MAX_PRODUCTS_HELD // (len(grid.values) * grid.k * series), 1, count))
    room = np.empty((len(grid.values), size, grid.k, series), dtype=np.float32)
    for first in range(0, count, size):
        blocks = range(first, min(first + size, count))
        yield blocks, room[:, : len(blocks)]


class _SeriesGains:
    """Gains of a grid for all series: each at its own scatter of the levels, or at the best for a small grid."""

    def __init__(self, law: LinearisedModel, grid: CandidateGrid, series: ScannedSeries) -> None:
        self._grid, self._series = grid, series
        self._profiled = is_profiled(grid, series)
        blocks = [[grid.members[m] for m in block] for block in grid.blocks]
        own = next(t for t in series.used if series.groups[t].start == 0)
        scatters, count = range(len(series.taus)) if self._profiled else series.used, len(grid.values)
        absorbed = {t: series.absorbed(law, blocks, t) for t in {*scatters, own}}
        self._of_series = {t: GainSum(absorbed[t], count, len(self._columns(t))) for t in scatters}
        of_data = scatters if self._profiled else [own]
        self._of_data = {t: GainSum(absorbed[t], count, 1, np.float64) for t in of_data}

    def _columns(self, t: int) -> range:
        """Series that are considered at one scatter."""
        every = range(self._series.residuals.shape[1])
        return every if self._profiled else every[self._series.groups[t]]

    def add(self, blocks: Sequence[int], sums: Sequence[BlockSums], products: Float32Array) -> None:
        """Add the products (G, B, k, D) of some blocks."""
        every: Products = products if self._profiled else self._within_bounds(products)
        for t, total in self._of_series.items():
            mine = self._columns(t)
            if self._profiled:
                every = self._at_scatter(sums, products, t)
            total.add(blocks, sums, every[..., mine.start : mine.stop])
        for t, total in self._of_data.items():
            projected = self._series.residual_projectors[t] @ self._series.coordinates[:, :1]
            of_data = [(s.data / s.scale)[:, :, None] + s.from_coordinates(projected[s.rows]) for s in sums]
            total.add(blocks, sums, self._within_bounds(np.stack(of_data, axis=1)))

    def _at_scatter(self, sums: Sequence[BlockSums], products: Products, t: int) -> Products:
        """Products with what the model leaves at scatter `t`; of a column that it absorbs less than 1e-7 is left."""
        across: Array = np.stack([s.from_coordinates(self._series.projected_at(t, s.rows)) for s in sums], axis=1)
        return self._within_bounds(np.asarray(products + across, dtype=np.float32))

    def _within_bounds(self, products: Products) -> Products:
        return within_bounds(products, self._grid.low, self._grid.high)

    def total(self) -> tuple[Array, Array]:
        """Gains of the data (G,), and the largest of every series (D,)."""
        if self._profiled:
            profile = self._series.profile
            data = profile[:, 0].min() - _least([profile[t, 0] - s.total()[:, 0] for t, s in self._of_data.items()])
            every = profile.min(axis=0) - _least([profile[t] - s.total() for t, s in self._of_series.items()])
            return data, np.asarray(every.max(axis=0), dtype=np.float64)
        largest = np.empty(self._series.residuals.shape[1])
        for t, total in self._of_series.items():
            largest[self._series.groups[t]] = total.total().max(axis=0)
        return next(iter(self._of_data.values())).total()[:, 0], largest


def _least(values: list[Array]) -> Array:
    return np.asarray(np.min(values, axis=0))
