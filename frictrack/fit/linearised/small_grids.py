"""Scan all small grids together: their columns side by side, every scatter of the levels in turn.

A small grid is evaluated at every scatter of the levels, because the candidate may explain what looked like scatter.
Its columns are few, so that those of all small grids are compared with the series in one product per piece.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.linearised.gains import MIN_COLUMN_SQUARE, sign_limits, whitener
from frictrack.fit.linearised.grid import CandidateGrid
from frictrack.fit.linearised.model import LinearisedModel
from frictrack.fit.linearised.products import whitened_columns
from frictrack.fit.linearised.series import ScannedSeries
from frictrack.records import Array

MAX_COLUMNS_SMALL = 200  # grid points times coefficients of a small grid
MAX_COLUMNS_TOGETHER = 1000  # of all grids of one product; effects with a coefficient per run have many in many runs

Indices = NDArray[np.int_]


def is_small(grid: CandidateGrid) -> bool:
    """Return whether a grid is small enough to be evaluated at every scatter of the levels."""
    return len(grid.values) * grid.size <= MAX_COLUMNS_SMALL


def in_batches(grids: Sequence[CandidateGrid]) -> list[list[CandidateGrid]]:
    """Divide grids, in their order, into batches of at most `MAX_COLUMNS_TOGETHER` columns."""
    batches: list[list[CandidateGrid]] = []
    columns = MAX_COLUMNS_TOGETHER
    for grid in grids:
        own = len(grid.values) * grid.size
        if columns + own > MAX_COLUMNS_TOGETHER:
            batches.append([])
            columns = 0
        batches[-1].append(grid)
        columns += own
    return batches


@dataclass(frozen=True, eq=False)
class SmallGrids:
    """Products of the columns of all small grids, C of them, one grid after the other.

    Attributes
    ----------
    grids : sequence of CandidateGrid
        The grids.
    rows : list of array of shape (G, K)
        Place of the columns of every grid among all.
    gram : array of shape (C, C)
        Gram matrix of the columns outside the bases of the pieces.
    data : array of shape (C,)
        Products of these remainders with the measured series.
    products : array of shape (C, D)
        Their products with the residuals of the series.
    coordinates : array of shape (C, L)
        Coordinates of the columns in the bases of the pieces.

    """

    grids: Sequence[CandidateGrid]
    rows: list[Indices]
    gram: Array
    data: Array
    products: Array
    coordinates: Array

    def gains(self, series: ScannedSeries) -> list[tuple[Array, Array]]:
        """Compute the gains of the measured series (G,) and of all series (G, D), for every grid."""
        out: list[tuple[Array, Array] | None] = [None] * len(self.grids)
        for size in {grid.size for grid in self.grids}:
            chosen = [i for i, grid in enumerate(self.grids) if grid.size == size]
            data, every = self._gains_of(chosen, series)
            ends = np.cumsum([len(self.rows[i]) for i in chosen])[:-1]
            for i, *gains in zip(chosen, np.split(data, ends), np.split(every, ends), strict=True):
                out[i] = gains[0], gains[1]
        return [gains for gains in out if gains is not None]

    def _gains_of(self, chosen: Sequence[int], series: ScannedSeries) -> tuple[Array, Array]:
        """Gains (n,) and (n, D) at the n points of some grids with equally many coefficients."""
        rows = np.concatenate([self.rows[i] for i in chosen])
        limits = np.concatenate(
            [np.tile(sign_limits(self.grids[i].low, self.grids[i].high), (len(self.rows[i]), 1)) for i in chosen]
        )
        coordinates, gram = self.coordinates[rows], self.gram[rows[:, :, None], rows[:, None, :]]
        full = np.einsum("nkk->nk", gram) + np.einsum("nkl,nkl->nk", coordinates, coordinates)
        series_products = np.concatenate([self.data[rows][:, :, None], self.products[rows]], axis=2)
        # the first column is the measured series with all digits
        left = np.concatenate([series.coordinates[:, :1], series.coordinates], axis=1)
        profile = np.concatenate([series.profile[:, :1], series.profile], axis=1)
        least = np.full((len(rows), left.shape[1]), np.inf)
        for projector, bare in zip(series.residual_projectors, profile, strict=True):
            projected = coordinates @ projector  # few rows, many series: in this order
            root = whitener(gram + projected @ coordinates.transpose(0, 2, 1), full)
            mixed = root @ (series_products + projected @ left)
            if np.isfinite(limits).any():
                mixed = np.clip(mixed, limits[:, :1, None], limits[:, 1:, None])
            np.minimum(least, bare - np.einsum("nkd,nkd->nd", mixed, mixed), out=least)
        gains = profile.min(axis=0) - least
        return gains[:, 0], gains[:, 1:]


def products_of_grids(law: LinearisedModel, grids: Sequence[CandidateGrid], series: ScannedSeries) -> SmallGrids:
    """Compute the products of the columns of small grids, piece by piece."""
    ends = np.cumsum([0, *(len(grid.values) * grid.size for grid in grids)])
    rows = [np.arange(a, b).reshape(len(g.values), -1) for a, b, g in zip(ends, ends[1:], grids, strict=False)]
    count = int(ends[-1])
    out = SmallGrids(
        grids, rows, np.zeros((count, count)), np.zeros(count), np.zeros((count, series.residuals.shape[1])),
        np.zeros((count, len(series.coordinates))),
    )  # fmt: skip
    for i in range(len(law.pieces)):
        _add_piece(law, out, i, series)
    return out


def _add_piece(law: LinearisedModel, sums: SmallGrids, i: int, series: ScannedSeries) -> None:
    """Add the products of the columns along one piece."""
    piece, frames = law.pieces[i], law.rows[i]
    own, columns = [], []
    for grid, rows in zip(sums.grids, sums.rows, strict=True):
        if i in grid.members:
            block = grid.block[grid.members.index(i)]
            own.append(rows[:, block * grid.k : (block + 1) * grid.k].ravel())
            columns.append(whitened_columns(grid, piece, grid.values))
    if not own:
        return
    at = np.concatenate(own)
    left, coordinates = piece.split(np.concatenate(columns))
    sums.gram[at[:, None], at] += left @ left.T
    sums.data[at] += left @ series.measured[frames]
    sums.coordinates[at, law.coordinate_slices[i]] = coordinates
    size = np.linalg.norm(left, axis=1)[:, None]
    size = np.where(size > np.sqrt(MIN_COLUMN_SQUARE), size, 1.0)  # smaller ones gain nothing
    sums.products[at] += size * ((left / size).astype(np.float32) @ series.residuals[frames])
