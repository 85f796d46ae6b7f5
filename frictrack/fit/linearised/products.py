"""Compute the products of a candidate's columns with one another, with the model and with the series."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from frictrack.fit.linearised.gains import MIN_COLUMN_SQUARE, ColumnSums, SeriesProducts
from frictrack.fit.linearised.grid import CandidateGrid
from frictrack.fit.linearised.model import LinearisedModel, LinearisedPiece
from frictrack.fit.linearised.series import Float32Array, ScannedSeries, coordinate_rows
from frictrack.fit.linearised.wave_nodes import NodeProducts, WaveNodes, WaveStretch, wave_stretches
from frictrack.records import Array

MAX_SAMPLES_AT_ONCE = 60_000  # samples evaluated at once, so that they fit into the cache
MAX_POINTS_AT_ONCE = 200  # grid points of stored products mixed at once, so that they fit into the cache
MIN_COLUMNS_COMPARED = 8  # from which differences between columns are worth a look
MIN_LEFT_SHARE = 1e-3  # of the size of columns, outside the basis, from which float32 products of whole columns do
MAX_PRODUCTS_KEPT = 20_000_000  # of plain waves with the series, over all pieces
MAX_SCALE_RATIO = 1e6  # by which columns of later pieces may exceed the scale; float32 ends at 3e38


def block_sums(
    law: LinearisedModel, grid: CandidateGrid, block: Sequence[int], series: ScannedSeries
) -> Iterator[ColumnSums]:
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

    Yields
    ------
    ColumnSums
        The products at some grid points; together they cover the grid.

    """
    pieces = [_Piece(law, grid, grid.members[m], series) for m in block]
    if len(pieces) == 1:
        yield from _piece_sums(pieces[0])
        return
    count, k, d = len(grid.values), grid.k, series.residuals.shape[1]
    stored = StoredProducts(slice(0, count), np.zeros((count, k, d), dtype=np.float32), np.zeros((count, k)))
    rows = coordinate_rows(law, [p.key[0] for p in pieces])
    total = ColumnSums(
        slice(0, count), np.zeros((count, k, k)), np.zeros((count, k)), np.zeros((count, k, len(rows))), []
    )
    at = 0
    for piece in pieces:
        for sums in _piece_sums(piece):
            total.gram[sums.points] += sums.gram
            total.data[sums.points] += sums.data
            total.coordinates[sums.points, :, at : at + len(piece.projected)] = sums.coordinates
            squares = np.maximum(np.einsum("gkk->gk", total.gram[sums.points]), 0.0)  # what is left after a projection
            stored.raise_scale(sums.points, np.sqrt(squares))
            for products in sums.products:
                stored.add(products)
        at += len(piece.projected)
    total.products.extend(stored.parts())
    yield total


@dataclass(frozen=True, eq=False)
class StoredProducts:
    """Products (c, k, D), float32, of columns over their scale (c, k), which keeps squares in the range of a float32.

    A scale of zero belongs to columns that are zero so far.
    """

    points: slice
    values: Float32Array
    scale: Array

    def mixed(self, mix: Array, series: slice) -> Float32Array:
        """Compute products (c, q, d) of combinations `mix` (c, q, k) with some of the series."""
        factors = (mix * self.scale[:, None]).astype(np.float32)
        own = self.values[:, :, series]
        out = np.multiply(factors[:, :, :1], own[:, :1])
        for j in range(1, own.shape[1]):
            out += factors[:, :, j : j + 1] * own[:, j : j + 1]
        return out

    def parts(self) -> Iterator[StoredProducts]:
        """Yield the same products, some points at a time."""
        for first in range(0, len(self.values), MAX_POINTS_AT_ONCE):
            part = slice(first, min(first + MAX_POINTS_AT_ONCE, len(self.values)))
            yield StoredProducts(part, self.values[part], self.scale[part])

    def add(self, products: SeriesProducts) -> None:
        """Add those of another piece, whose scale was raised before."""
        scale = self.scale[products.points]
        over_scale = np.eye(scale.shape[1]) / np.where(scale > 0, scale, 1.0)[:, :, None]
        self.values[products.points] += products.mixed(over_scale, slice(0, self.values.shape[2]))

    def raise_scale(self, part: slice, size: Array) -> None:
        """Give columns (g, k) a scale; columns that exceed the one of earlier pieces by far get a new one."""
        old = self.scale[part]
        grown = size > MAX_SCALE_RATIO * old
        if grown.any():
            if old[grown].any():
                self.values[part][grown] *= (old[grown] / size[grown]).astype(np.float32)[:, None]
            old[grown] = size[grown]


@dataclass(frozen=True, eq=False)
class WaveProducts:
    """Waves as sums of few plain ones: weights (c, k, m), and products (m, D) of the plain waves with the series."""

    points: slice
    weights: Array
    plain: Float32Array

    def mixed(self, mix: Array, series: slice) -> Float32Array:
        """Compute products (c, q, d) of combinations `mix` (c, q, k) with some of the series."""
        weights = mix[:, :, :1] * self.weights[:, :1]
        for j in range(1, self.weights.shape[1]):
            weights += mix[:, :, j : j + 1] * self.weights[:, j : j + 1]
        flat: Float32Array = weights.reshape(-1, len(self.plain)).astype(np.float32)
        return (flat @ self.plain[:, series]).reshape(*mix.shape[:2], -1)


class _Piece:
    """One piece with its part of the series."""

    def __init__(self, law: LinearisedModel, grid: CandidateGrid, i: int, series: ScannedSeries) -> None:
        self.grid, self.strip, self.series = grid, law.pieces[i], series
        self.n_pieces = len(law.pieces)
        self.key = i, grid.effect.acts_on
        self.measured, self.residuals = series.measured[law.rows[i]], series.residuals[law.rows[i]]
        self.projected = series.projected[law.coordinate_slices[i]]
        self.last_column: tuple[Array, Float32Array] | None = None  # (n,) and its products (D,), to go on from

    def whole_product(self, column: Array) -> tuple[Array, Float32Array]:
        """Return a whitened column (n,) and its products (D,) with the series."""
        size = max(float(np.abs(column).max()), np.finfo(float).tiny)
        of_series: Float32Array = (column / size).astype(np.float32) @ self.residuals
        return column, of_series * np.float32(size)

    def whitened(self, points: Array) -> Array:
        """Whitened columns (Q k, n) at grid points (Q, d)."""
        return whitened_columns(self.grid, self.strip, points)

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
        samples, n = nodes.columns(base), len(self.measured)
        left, coordinates = np.empty((len(samples), n)), np.empty((len(samples), len(self.projected)))
        step = max(1, MAX_SAMPLES_AT_ONCE // samples.shape[1])
        for first in range(0, len(samples), step):
            part = slice(first, first + step)
            rows = self.strip.whitened_rows(samples[part], self.key[1] == "measurement")
            left[part], coordinates[part] = self.strip.split(rows)
        gram = left @ left.T
        squares = gram.diagonal() + np.einsum("cd,cd->c", coordinates, coordinates)  # a wave may leave no remainder
        size = np.maximum(np.sqrt(squares), np.finfo(float).tiny)
        products = self.with_series(left, coordinates, size)
        return NodeProducts(nodes, gram, coordinates, left @ self.measured, products, size)

    def with_series(self, left: Array, coordinates: Array, scale: Array) -> Float32Array:
        """Products (C, D) of columns over their scale (C,) with the series, from remainders and coordinates."""
        out: Float32Array = (left / scale[:, None]).astype(np.float32) @ self.residuals
        out += (coordinates / scale[:, None]).astype(np.float32) @ self.projected
        return out


def whitened_columns(grid: CandidateGrid, piece: LinearisedPiece, points: Array) -> Array:
    """Compute whitened columns (Q k, n) of a grid at points (Q, d) along one piece."""
    raw = grid.raw_columns(piece, points)
    return piece.whitened_rows(raw.reshape(-1, raw.shape[-1]), grid.effect.acts_on == "measurement")


def _piece_sums(piece: _Piece) -> Iterator[ColumnSums]:
    """Products of one piece at some grid points."""
    stretches = wave_stretches(piece.grid, piece.strip)
    if stretches:
        for stretch in stretches:
            yield _wave_sums(piece, stretch)
        return
    count = len(piece.grid.values)
    size = max(1, MAX_SAMPLES_AT_ONCE // len(piece.strip.path_for(piece.grid.effect).t))
    for first in range(0, count, size):
        yield _direct_sums(piece, slice(first, min(first + size, count)))


def _direct_sums(piece: _Piece, points: slice) -> ColumnSums:
    """Products of columns computed one by one."""
    whitened = piece.whitened(piece.grid.values[points])
    left, coordinates = piece.strip.split(whitened)
    shape = (points.stop - points.start, piece.grid.k, -1)
    columns = left.reshape(shape)
    gram = columns @ columns.transpose(0, 2, 1)
    size = np.sqrt(np.einsum("gkk->gk", gram))
    scale = np.where(size > np.sqrt(MIN_COLUMN_SQUARE), size, 1.0).ravel()  # smaller ones gain nothing
    products = _neighbour_products(piece, whitened, scale)
    if products is None:
        products = piece.with_series(left, coordinates, scale)
    stored = StoredProducts(points, products.reshape(shape), size)
    return ColumnSums(points, gram, columns @ piece.measured, coordinates.reshape(shape), [stored])


def _neighbour_products(piece: _Piece, columns: Array, scale: Array) -> Float32Array | None:
    """Products (C, D) of columns (C, n) over their scale, from those of the column before and few differences to it.

    None where columns differ in many frames, or where little of them is outside the basis: products with whole columns
    lose its digits.
    """
    before = piece.last_column
    piece.last_column = None
    window = _window_of_differences(columns, columns[0] if before is None else before[0], float(scale.min()))
    if window is None:
        return None
    reference, of_reference = before or piece.whole_product(columns[0])
    size = float(scale.max())
    differences = ((columns[:, window] - reference[window]) / size).astype(np.float32)
    out: Float32Array = differences @ piece.residuals[window] + of_reference / np.float32(size)
    piece.last_column = columns[-1], out[-1] * np.float32(size)
    out *= (size / scale[:, None]).astype(np.float32)
    return out


def _window_of_differences(columns: Array, reference: Array, left: float) -> slice | None:
    """Frames in which columns (C, n) differ from a reference (n,), if these are few; None otherwise.

    `left` is the smallest size of their remainders outside the basis.
    """
    if len(columns) < MIN_COLUMNS_COMPARED or 2 * np.sum(reference != columns[-1]) > columns.shape[1]:
        return None
    if not left > MIN_LEFT_SHARE * max(float(np.linalg.norm(columns[i])) for i in (0, -1)):
        return None
    differing = np.flatnonzero(np.any(columns != reference, axis=0))
    window = slice(int(differing[0]), int(differing[-1]) + 1) if len(differing) else slice(0, 0)
    return window if 2 * (window.stop - window.start) < columns.shape[1] else None


def _wave_sums(piece: _Piece, stretch: WaveStretch) -> ColumnSums:
    """Products of waves of one envelope, as sums of plain waves, or of waves with that envelope."""
    plain = piece.plain_waves(stretch)
    waves = plain.nodes.sums(stretch.envelope, stretch.q)
    if waves is None:
        plain = piece.node_products(stretch.nodes(), stretch.envelope)
        waves = plain.nodes.sums(np.ones(len(stretch.u)), stretch.q)
        assert waves is not None
    count, first = len(stretch.q), stretch.points.start
    out = ColumnSums(
        stretch.points, np.empty((count, 2, 2)), np.empty((count, 2)), np.empty((count, 2, len(piece.projected))), []
    )
    for part, near, flat in waves.chunks():
        used, shape = slice(2 * near.start, 2 * near.stop), (part.stop - part.start, 2, -1)
        weights = flat.reshape(shape)
        out.gram[part] = (flat @ plain.gram[used, used]).reshape(shape) @ weights.transpose(0, 2, 1)
        out.data[part] = (flat @ plain.data[used]).reshape(shape[:2])
        out.coordinates[part] = (flat @ plain.coordinates[used]).reshape(shape)
        points = slice(part.start + first, part.stop + first)
        out.products.append(WaveProducts(points, weights * plain.size[used], plain.products[used]))
    return out
