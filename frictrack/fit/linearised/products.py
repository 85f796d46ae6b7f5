"""Compute the products of a candidate's columns with one another, with the model and with the series."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictrack.fit.linearised.gains import BlockSums
from frictrack.fit.linearised.grid import CandidateGrid
from frictrack.fit.linearised.model import LinearisedModel, LinearisedPiece
from frictrack.fit.linearised.series import Float32Array, ScannedSeries, coordinate_rows
from frictrack.fit.linearised.wave_nodes import WaveNodes, wave_nodes
from frictrack.records import Array

MAX_SAMPLES_AT_ONCE = 60_000  # samples evaluated at once, so that they fit into the cache
MAX_SCALE_RATIO = 1e6  # by which columns of later pieces may exceed the scale; float32 ends at 3e38


def block_sums(
    law: LinearisedModel, grid: CandidateGrid, block: Sequence[int], series: ScannedSeries, products: Float32Array
) -> BlockSums:
    """Compute the products of all columns of one block of runs.

    Parameters
    ----------
    law : LinearisedModel
        The fitted model.
    grid : CandidateGrid
        The candidate.
    block : sequence of int
        Positions of the pieces among the members of the grid.
    series : ScannedSeries
        The data.
    products : array of shape (G, k, D), float32
        Is filled with the products with the series.

    Returns
    -------
    BlockSums
        All products.

    """
    count, k = len(grid.values), grid.k
    pieces = [grid.members[m] for m in block]
    rows = coordinate_rows(law, pieces)
    sums = BlockSums(
        np.zeros((count, k, k)), np.zeros((count, k)), np.zeros((count, k)), products, rows,
        np.zeros((count, k, len(rows))),
    )  # fmt: skip
    products[...] = 0.0
    at = 0
    for i in pieces:
        size = law.coordinate_slices[i].stop - law.coordinate_slices[i].start
        _add_piece(_Piece(law, grid, i, series), sums, slice(at, at + size))
        at += size
    sums.scale[sums.scale == 0] = 1.0
    return sums


class _Piece:
    """One piece with its part of the series."""

    def __init__(self, law: LinearisedModel, grid: CandidateGrid, i: int, series: ScannedSeries) -> None:
        self.grid, self.strip = grid, law.pieces[i]
        self.measured, self.residuals = series.measured[law.rows[i]], series.residuals[law.rows[i]]

    def columns(self, points: Array) -> tuple[Array, Array]:
        """Remainders (Q, k, n) of the columns at grid points (Q, d) outside the basis, and coordinates (Q, k, L')."""
        raw = self.grid.raw_columns(self.strip, points)
        whitened = self.strip.whitened_rows(raw.reshape(-1, raw.shape[-1]), self.grid.effect.acts_on == "measurement")
        left, coordinates = self.strip.split(whitened)
        return left.reshape(*raw.shape[:2], -1), coordinates.reshape(*raw.shape[:2], -1)


def _add_piece(piece: _Piece, sums: BlockSums, own: slice) -> None:
    """Add the products of one piece; `own` are its coordinates in the block."""
    waves = wave_nodes(piece.grid, piece.strip)
    if waves:
        for nodes in waves:
            _add_interpolated(piece, nodes, sums, own)
        return
    for part in _chunks(len(piece.grid.values), piece.strip, piece.grid):
        columns, sums.coordinates[part, :, own] = piece.columns(piece.grid.values[part])
        gram = columns @ columns.transpose(0, 2, 1)
        sums.gram[part] += gram
        sums.data[part] += columns @ piece.measured
        _raise_scale(sums, part, np.sqrt(np.einsum("gkk->gk", gram)))
        scale = np.where(sums.scale[part] > 0, sums.scale[part], 1.0)
        unit = (columns / scale[:, :, None]).astype(np.float32).reshape(-1, columns.shape[-1])
        sums.products[part] += (unit @ piece.residuals).reshape(sums.products[part].shape)


def _chunks(count: int, strip: LinearisedPiece, grid: CandidateGrid) -> list[slice]:
    """Slices of points to be evaluated together."""
    size = max(1, MAX_SAMPLES_AT_ONCE // len(strip.path_for(grid.effect).t))
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]


def _raise_scale(sums: BlockSums, part: slice, size: Array) -> None:
    """Give columns (g, k) a scale; columns that exceed the one of earlier pieces by far get a new one."""
    old = sums.scale[part]
    grown = size > MAX_SCALE_RATIO * old
    if grown.any():
        if old[grown].any():
            sums.products[part][grown] *= (old[grown] / size[grown]).astype(np.float32)[:, None]
        old[grown] = size[grown]


def _add_interpolated(piece: _Piece, nodes: WaveNodes, sums: BlockSums, own: slice) -> None:
    """Add the products of waves, interpolated between nodes."""
    parts = [piece.columns(nodes.points[part]) for part in _chunks(len(nodes.points), piece.strip, piece.grid)]
    columns, coordinates = (np.concatenate(p).reshape(2 * len(nodes.points), -1) for p in zip(*parts, strict=True))
    data = columns @ piece.measured
    size = max(float(np.abs(columns).max()), np.finfo(float).tiny) * np.sqrt(columns.shape[1])
    with_series = (columns / size).astype(np.float32) @ piece.residuals
    for targets, near, weights in nodes.chunks():
        used = slice(2 * near.start, 2 * near.stop)
        count = targets.stop - targets.start
        gram = (weights @ (columns[used] @ columns[used].T)).reshape(count, 2, -1) @ weights.reshape(
            count, 2, -1
        ).transpose(0, 2, 1)
        sums.gram[targets] += gram
        sums.data[targets] += (weights @ data[used]).reshape(count, 2)
        sums.coordinates[targets, :, own] = (weights @ coordinates[used]).reshape(count, 2, -1)
        _raise_scale(sums, targets, np.broadcast_to(size, (count, 2)))
        scaled = weights * (size / sums.scale[targets].reshape(-1, 1))
        sums.products[targets] += (scaled.astype(np.float32) @ with_series[used]).reshape(count, 2, -1)
