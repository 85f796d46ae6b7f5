"""Compute the products of a candidate's columns with one another, with the model and with the series."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictrack.fit.linearised.gains import BlockSums
from frictrack.fit.linearised.grid import CandidateGrid
from frictrack.fit.linearised.model import LinearisedModel, LinearisedPiece
from frictrack.fit.linearised.series import Float32Array, ScannedSeries, coordinate_rows
from frictrack.fit.linearised.wave_nodes import NodeProducts, WaveNodes, WaveStretch, wave_stretches
from frictrack.records import Array

MAX_SAMPLES_AT_ONCE = 60_000  # samples evaluated at once, so that they fit into the cache
MAX_FORMS_PROFILED = 200  # grid points times coefficients up to which tau is estimated at every grid point
MIN_COLUMNS_COMPARED = 8  # from which differences between columns are worth a look
MIN_LEFT_SHARE = 1e-3  # of the size of columns, outside the basis, from which float32 products of whole columns do
MAX_PRODUCTS_KEPT = 20_000_000  # of plain waves with the series, over all pieces
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
        self.grid, self.strip, self.series = grid, law.pieces[i], series
        self.n_pieces = len(law.pieces)
        self.key = i, grid.effect.acts_on
        self.measured, self.residuals = series.measured[law.rows[i]], series.residuals[law.rows[i]]
        self.projected = series.projected[law.coordinate_slices[i]]
        self.profiled = is_profiled(grid, series)

    def whitened(self, points: Array) -> Array:
        """Whitened columns (Q k, n) at grid points (Q, d)."""
        raw = self.grid.raw_columns(self.strip, points)
        return self.strip.whitened_rows(raw.reshape(-1, raw.shape[-1]), self.key[1] == "measurement")

    def with_series(self, whitened: Array, parts: tuple[Array, Array], scale: Array) -> Float32Array:
        """Products (C, D) of columns (C, n) over their scale with the residuals of the series.

        `parts` are remainders and coordinates. Only a profiled grid adds the coordinates later, with more digits.
        """
        left, coordinates = ((q / scale[:, None]).astype(np.float32) for q in parts)
        window = _window_of_differences(whitened, float(scale.min()))
        if window is None:
            out = left @ self.residuals
        else:  # neighbours differ in few frames, such as columns that begin one frame later each
            first = whitened[0] / scale[0]
            differences = ((whitened[:, window] - whitened[0, window]) / scale[:, None]).astype(np.float32)
            out = differences @ self.residuals[window]
            out += (scale[0] / scale[:, None]).astype(np.float32) * (first.astype(np.float32) @ self.residuals)
        if self.profiled != (window is None):  # either with the coordinates by mistake, or without
            out += (-coordinates if self.profiled else coordinates) @ self.projected
        return out

    def plain_waves(self, stretch: WaveStretch) -> NodeProducts:
        """Products of plain waves; those of waves in time are kept for other effects."""
        held = self.series.waves.get(self.key)
        if held is not None and held.nodes.reaches(stretch.u, stretch.q):
            return held
        made = self.node_products(stretch.nodes(), 1.0)
        room = MAX_PRODUCTS_KEPT // (self.n_pieces * made.products.size)
        if stretch.is_time and held is None and room:
            self.series.waves[self.key] = made
        return made

    def node_products(self, nodes: WaveNodes, base: Array | float) -> NodeProducts:
        """Compute the products of plain waves times `base` (m,)."""
        samples = nodes.columns(base)
        step = max(1, MAX_SAMPLES_AT_ONCE // samples.shape[1])
        chunks = (samples[first : first + step] for first in range(0, len(samples), step))
        parts = [self.strip.split(self.strip.whitened_rows(c, self.key[1] == "measurement")) for c in chunks]
        left, coordinates = (np.concatenate(part) for part in zip(*parts, strict=True))
        size = max(float(np.abs(left).max()), np.finfo(float).tiny) * np.sqrt(left.shape[1])
        products = (left / size).astype(np.float32) @ self.residuals
        products += (coordinates / size).astype(np.float32) @ self.projected
        return NodeProducts(nodes, left @ left.T, coordinates, left @ self.measured, products, size)


def is_profiled(grid: CandidateGrid, series: ScannedSeries) -> bool:
    """Return whether a grid is small enough to be evaluated at every scatter of the levels."""
    return len(grid.values) * grid.size <= MAX_FORMS_PROFILED and len(series.taus) > 1


def _window_of_differences(columns: Array, left: float) -> slice | None:
    """Frames in which columns (C, n) differ from the first, if these are few; None otherwise.

    `left` is the smallest size of their remainders outside the basis: products with whole columns lose its digits.
    """
    if len(columns) < MIN_COLUMNS_COMPARED or 2 * np.sum(columns[0] != columns[-1]) > columns.shape[1]:
        return None
    if not left > MIN_LEFT_SHARE * max(float(np.linalg.norm(columns[i])) for i in (0, -1)):
        return None
    differing = np.flatnonzero(np.any(columns != columns[0], axis=0))
    window = slice(int(differing[0]), int(differing[-1]) + 1) if len(differing) else slice(0, 0)
    return window if 2 * (window.stop - window.start) < columns.shape[1] else None


def _add_piece(piece: _Piece, sums: BlockSums, own: slice) -> None:
    """Add the products of one piece; `own` are its coordinates in the block."""
    stretches = wave_stretches(piece.grid, piece.strip)
    for stretch in stretches:
        _add_waves(piece, stretch, sums, own)
    if stretches:
        return
    for part in _chunks(len(piece.grid.values), piece.strip, piece.grid):
        whitened = piece.whitened(piece.grid.values[part])
        left, coordinates = piece.strip.split(whitened)
        shape = (part.stop - part.start, sums.gram.shape[1], -1)
        columns = left.reshape(shape)
        gram = columns @ columns.transpose(0, 2, 1)
        sums.gram[part] += gram
        sums.data[part] += columns @ piece.measured
        sums.coordinates[part, :, own] = coordinates.reshape(shape)
        _raise_scale(sums, part, np.sqrt(np.einsum("gkk->gk", gram)))
        scale = np.where(sums.scale[part] > 0, sums.scale[part], 1.0).ravel()
        sums.products[part] += piece.with_series(whitened, (left, coordinates), scale).reshape(shape)


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


def _add_waves(piece: _Piece, stretch: WaveStretch, sums: BlockSums, own: slice) -> None:
    """Add the products of waves of one envelope, as sums of plain waves, or of waves with that envelope."""
    plain = piece.plain_waves(stretch)
    waves = plain.nodes.sums(stretch.envelope, stretch.q)
    if waves is None:
        plain = piece.node_products(stretch.nodes(), stretch.envelope)
        waves = plain.nodes.sums(np.ones(len(stretch.u)), stretch.q)
        assert waves is not None
    for part, near, weights in waves.chunks():
        used, targets = slice(2 * near.start, 2 * near.stop), _shifted(part, stretch.points.start)
        shape = (part.stop - part.start, 2, -1)
        across = (weights @ plain.gram[used, used]).reshape(shape)
        sums.gram[targets] += across @ weights.reshape(shape).transpose(0, 2, 1)
        sums.data[targets] += (weights @ plain.data[used]).reshape(shape[:2])
        sums.coordinates[targets, :, own] = (weights @ plain.coordinates[used]).reshape(shape)
        size = np.sqrt(np.einsum("gkk->gk", sums.gram[targets]))
        _raise_scale(sums, targets, size)
        scaled = weights * (plain.size / np.where(sums.scale[targets] > 0, sums.scale[targets], 1.0).reshape(-1, 1))
        sums.products[targets] += (scaled.astype(np.float32) @ plain.products[used]).reshape(shape)


def _shifted(part: slice, by: int) -> slice:
    return slice(part.start + by, part.stop + by)
