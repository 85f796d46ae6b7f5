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

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.linearised.gains import GridGains, sign_limits, whitener
from frictrack.fit.linearised.grid import CandidateGrid
from frictrack.fit.linearised.model import LinearisedModel
from frictrack.fit.linearised.products import block_sums
from frictrack.fit.linearised.series import ScannedSeries, coordinate_rows
from frictrack.fit.linearised.small_grids import SmallGrids, in_batches, is_small, products_of_grids
from frictrack.fit.linearised.wave_nodes import constant_waves
from frictrack.records import Array
from frictrack.threads import map_in_threads


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
    """Scan one candidate grid beside a fitted model; see `scan_candidates`."""
    return scan_candidates(law, [grid], series)[0]


def scan_candidates(law: LinearisedModel, grids: Sequence[CandidateGrid], series: ScannedSeries) -> list[CandidateScan]:
    """Scan candidate grids beside a fitted model.

    Parameters
    ----------
    law : LinearisedModel
        The fitted model.
    grids : sequence of CandidateGrid
        The candidates.
    series : ScannedSeries
        The data.

    Returns
    -------
    list of CandidateScan
        Gains and products of all grid points, grid by grid.

    """
    small = [i for i, grid in enumerate(grids) if is_small(grid)]
    scans = dict(zip(small, _scan_small(law, [grids[i] for i in small], series), strict=True))
    equal = _equal_waves(law, grids)
    large = [i for i in range(len(grids)) if i not in scans and i not in equal]
    made = map_in_threads(lambda i: _scan_large(law, grids[i], series), large)
    scans |= dict(zip(large, made, strict=True))
    scans |= {i: _rescaled(scans[of], grids[i], sizes) for i, (of, sizes) in equal.items()}
    return [scans[i] for i in range(len(grids))]


def _equal_waves(law: LinearisedModel, grids: Sequence[CandidateGrid]) -> dict[int, tuple[int, list[float]]]:
    """Grids whose columns are those of an earlier one, each block times a number: which one, and the numbers.

    Waves of a constant load are those of a force, and gain the same.
    """
    first: dict[Hashable, tuple[int, list[float]]] = {}
    out = {}
    for i, grid in enumerate(grids):
        waves = None if is_small(grid) else constant_waves(law, grid)
        if waves is None:
            continue
        key, sizes = waves
        of, before = first.setdefault(key, (i, sizes))
        if of != i:
            out[i] = of, [a / b for a, b in zip(sizes, before, strict=True)]
    return out


def _rescaled(scan: CandidateScan, grid: CandidateGrid, sizes: Sequence[float]) -> CandidateScan:
    """The scan of a grid whose columns are those of another, block by block times a size."""
    size = np.array(sizes)[:, None]
    coordinates = [own * factor for own, factor in zip(scan.coordinates, sizes, strict=True)]
    gram, data = scan.gram * size[:, :, None] ** 2, scan.data_products * size
    return replace(scan, grid=grid, gram=gram, coordinates=coordinates, data_products=data)


def _scan_small(law: LinearisedModel, grids: Sequence[CandidateGrid], series: ScannedSeries) -> list[CandidateScan]:
    """Scan all small grids at once, each point at the scatter of the levels that suits it best."""
    scans = []
    for together in in_batches(grids):
        sums = products_of_grids(law, together, series)
        scans += [
            _small_scan(law, grid, (sums, rows), gains)
            for grid, rows, gains in zip(together, sums.rows, sums.gains(series), strict=True)
        ]
    return scans


def _small_scan(
    law: LinearisedModel, grid: CandidateGrid, found: tuple[SmallGrids, NDArray[np.int_]], gains: tuple[Array, Array]
) -> CandidateScan:
    """The scan of one small grid; `found` are the sums of all and the rows (G, K) of this one."""
    sums, rows = found
    of_data, every = gains
    blocks = rows.reshape(len(rows), -1, grid.k)  # (G, B, k)
    places = [coordinate_rows(law, [grid.members[m] for m in block]) for block in grid.blocks]
    max_gains = every.max(axis=0)
    max_gains[0] = of_data.max()
    return CandidateScan(
        grid, sums.gram[blocks[..., :, None], blocks[..., None, :]],
        [sums.coordinates[blocks[:, b, :, None], place] for b, place in enumerate(places)], places,
        sums.data[blocks], of_data, max_gains,
    )  # fmt: skip


def _scan_large(law: LinearisedModel, grid: CandidateGrid, series: ScannedSeries) -> CandidateScan:
    """Scan a large grid, every series at its own scatter of the levels."""
    blocks = [[grid.members[m] for m in block] for block in grid.blocks]
    absorbed = {t: series.absorbed(law, blocks, t) for t in series.used}
    total = GridGains(absorbed, series.groups, len(grid.values), sign_limits(grid.low, grid.high))
    own = next(t for t in series.used if series.groups[t].start == 0)
    measured = series.residual_projectors[own] @ series.coordinates[:, 0]
    held = []
    for b, block in enumerate(grid.blocks):
        rows = coordinate_rows(law, blocks[b])
        parts = []
        for sums in block_sums(law, grid, block, series):
            total.add(b, rows, sums, sums.of_data(measured[rows]))
            parts.append((sums.gram, sums.data, sums.coordinates))
        held.append((*(np.concatenate(part) for part in zip(*parts, strict=True)), rows))
    gram, data, coordinates, places = zip(*held, strict=True)
    of_data, max_gains = total.totals()
    max_gains[0] = of_data.max()
    return CandidateScan(
        grid, np.stack(gram, axis=1), list(coordinates), list(places), np.stack(data, axis=1), of_data, max_gains
    )
