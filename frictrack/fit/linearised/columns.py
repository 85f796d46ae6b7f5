"""The grid of scanned parameters of a candidate effect, its columns there, and their products."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.effects import Effect, Span, Tie
from frictrack.fit.linearised.model import Float32Array, LinearisedModel, ScannedSeries
from frictrack.fit.linearised.pieces import LinearisedPiece
from frictrack.records import Array

QUADRATURES = (0.0, np.pi / 2)
MIN_COLUMN_SQUARE = 1e-20  # smaller squares belong to places that no run reaches


@dataclass(frozen=True, eq=False)
class CandidateGrid:
    """One effect on a grid of its scanned parameters: G points with K coefficients each.

    Attributes
    ----------
    effect : Effect
        The candidate.
    names : tuple of str
        Scanned parameters.
    values : array of shape (G, d)
        Their values at the grid points.
    shape : tuple of int
        Shape of the grid.
    other_values : dict
        Values of the other non-linear parameters.
    members : tuple of int
        Indices of the pieces on which it acts.
    block : tuple of int
        For every member, which block of k coefficients it uses. Per-run coefficients have K = R k, shared ones K = k.
    k : int
        Coefficients per run.
    low, high : array of shape (K,)
        Bounds of the coefficients; infinite for quadratures.

    """

    effect: Effect
    names: tuple[str, ...]
    values: Array
    shape: tuple[int, ...]
    other_values: dict[str, float]
    members: tuple[int, ...]
    block: tuple[int, ...]
    k: int
    low: Array
    high: Array

    @property
    def size(self) -> int:
        """Number K of coefficients at a grid point."""
        return self.k * (max(self.block) + 1)

    @property
    def blocks(self) -> list[list[int]]:
        """The pieces that share coefficients, for every block."""
        pairs = list(zip(self.members, self.block, strict=True))
        return [[i for i, own in pairs if own == b] for b in range(max(self.block) + 1)]

    @property
    def phases(self) -> list[dict[str, float]]:
        """The quadratures, or the one setting of an effect without free phase."""
        return _phases(self.effect)

    def point(self, g: int) -> dict[str, float]:
        """Return all non-linear values at one grid point, by name."""
        return _apply_ties(self.effect, self.other_values | dict(zip(self.names, self.values[g].tolist(), strict=True)))

    def raw_columns(self, piece: LinearisedPiece, points: Array) -> Array:
        """Compute columns (Q, k, m) at points (Q, d) along one piece, one quadrature after the other."""
        values: dict[str, Any] = self.other_values | dict(zip(self.names, points.T, strict=True))
        values = _apply_ties(self.effect, values)
        parts = [_finite_columns(piece, self.effect, values | phase, len(points)) for phase in self.phases]
        return np.concatenate(parts, axis=1)

    def whitened_columns(self, piece: LinearisedPiece, points: Array) -> Array:
        """Compute whitened columns (Q k, n) at points (Q, d) along one piece."""
        raw = self.raw_columns(piece, points)
        return piece.whitened_rows(raw.reshape(-1, raw.shape[-1]), self.effect.acts_on == "measurement")


def candidate_grids(law: LinearisedModel, effect: Effect) -> list[CandidateGrid]:
    """Create the grids of one effect over the fitted runs.

    Parameters
    ----------
    law : LinearisedModel
        The fitted model.
    effect : Effect
        The candidate.

    Returns
    -------
    list of CandidateGrid
        One grid, or one per run if the scan belongs to single runs. Empty if the runs lack what the effect needs.

    """
    if effect.lacks([s.response.piece.path for s in law.pieces]):
        return []
    layout, every = law.solution.problem.layout, list(range(len(law.pieces)))
    if not effect.single:
        return [_candidate_grid(law, effect, every, layout.span)]
    own = [[i for i in every if law.pieces[i].run == run] for run in law.runs]
    return [_candidate_grid(law, effect, members, layout.spans[law.pieces[members[0]].run]) for members in own]


def _candidate_grid(law: LinearisedModel, effect: Effect, members: list[int], span: Span) -> CandidateGrid:
    names, axes, other_values = _axes(effect, span)
    runs = sorted({law.pieces[i].run for i in members})
    per_run = has_per_run_coefficients(effect)
    block = tuple(runs.index(law.pieces[i].run) if per_run else 0 for i in members)
    phases = len(_phases(effect))
    low, high = np.array([p.bounds for p in effect.linear]).reshape(-1, 2).T
    if phases > 1 or not effect.linear:
        modified = law.pieces[members[0]].modified_columns(effect).shape[1] if effect.modifies else len(effect.linear)
        low, high = np.full(phases * modified, -np.inf), np.full(phases * modified, np.inf)
    box = np.tile(low, max(block) + 1), np.tile(high, max(block) + 1)
    shape = tuple(len(a) for a in axes) or (1,)
    return CandidateGrid(effect, names, _points(axes), shape, other_values, tuple(members), block, len(low), *box)


def scan_points(effect: Effect, span: Span) -> list[dict[str, float]]:
    """Return every combination of the scanned parameters, the others at their value for a scan."""
    names, axes, other_values = _axes(effect, span)
    return [_apply_ties(effect, other_values | dict(zip(names, row.tolist(), strict=True))) for row in _points(axes)]


def _axes(effect: Effect, span: Span) -> tuple[tuple[str, ...], list[Array], dict[str, float]]:
    """Names of the scanned parameters and their values, and the values of the other non-linear parameters."""
    scanned = [p for p in effect.nonlinear if p.scan is not None and p.free]
    scanned.sort(key=lambda p: p.unit == "Hz")  # neighbours share all but the frequency: waves of one envelope
    other_values = {p.name: 1.0 if p.role == "depth" else p.fixed or 0.0 for p in effect.nonlinear if p not in scanned}
    axes = [p.scan(span) for p in scanned if p.scan is not None]
    return tuple(p.name for p in scanned), axes, other_values


def _points(axes: list[Array]) -> Array:
    points = list(product(*axes))
    return np.array(points, dtype=float).reshape(len(points), len(axes))


def _apply_ties(effect: Effect, point: dict[str, Any]) -> dict[str, Any]:
    """A grid point with the parameters filled in that are tied to others of the same effect."""
    for p in effect.nonlinear:
        if p.tie:
            tie = Tie.read(p.tie)
            point[p.name] = tie.factor * point.get(tie.parameter, 0.0)
    return point


def has_per_run_coefficients(effect: Effect) -> bool:
    """Return whether the coefficients of the scan belong to the runs: per-run amplitudes or phases."""
    return any(p.per_run and (p.linear or p.role == "phase") for p in effect.parameters)


def _phases(effect: Effect) -> list[dict[str, float]]:
    names = [p.name for p in effect.nonlinear if p.role == "phase" and p.free]
    return [dict.fromkeys(names, q) for q in QUADRATURES] if names else [{}]


def _finite_columns(piece: LinearisedPiece, effect: Effect, values: dict[str, Any], count: int) -> Array:
    """Columns of a population; zero where those of a user's formula are not finite."""
    try:
        return piece.columns(effect, values, count)
    except FrictrackError:
        if effect.formula is None:
            raise
    if count == 1:
        return np.zeros((1, len(effect.linear), len(piece.path.t)))
    each = [{k: v[[i]] if isinstance(v, np.ndarray) else v for k, v in values.items()} for i in range(count)]
    return np.concatenate([_finite_columns(piece, effect, own, 1) for own in each])


@dataclass(frozen=True, eq=False)
class ColumnProducts:
    """Products of columns, k at each of g grid points, along some pieces.

    Attributes
    ----------
    gram : array of shape (g, k, k)
        Gram matrices of the columns outside the bases of the pieces.
    data : array of shape (g, k)
        Products of these remainders with the measured series.
    coordinates : array of shape (g, k, L_b)
        Coordinates of the columns in the bases of the pieces.
    size : array of shape (g, k)
        Scale of the columns, which keeps `draws` in the range of a float32.
    draws : array of shape (g, k, D - 1), float32
        Products of the remainders, over their scale, with the other series.

    """

    gram: Array
    data: Array
    coordinates: Array
    size: Array
    draws: Float32Array

    @property
    def squares(self) -> Array:
        """Squares of the columns, starts projected out, (g, k)."""
        return np.asarray(np.einsum("gkk->gk", self.gram) + np.einsum("gkl,gkl->gk", *[self.coordinates] * 2))

    def schur(self, projector: Array) -> Array:
        """Gram matrices (..., g, k, k) of what a projector (..., L_b, L_b) leaves of the columns."""
        own = self.coordinates
        left = (own.reshape(-1, own.shape[2]) @ projector).reshape(*projector.shape[:-2], *own.shape)
        return np.asarray(self.gram + left @ own.transpose(0, 2, 1))

    @classmethod
    def of_pieces(cls, parts: Sequence[ColumnProducts]) -> ColumnProducts:
        """Add the products along several pieces, whose columns have the same coefficients."""
        if len(parts) == 1:
            return parts[0]
        size = np.max([p.size for p in parts], axis=0)
        draws = np.zeros_like(parts[0].draws)
        for p in parts:
            draws += (p.size / size).astype(np.float32)[:, :, None] * p.draws
        gram, data = sum(p.gram for p in parts), sum(p.data for p in parts)
        coordinates = np.concatenate([p.coordinates for p in parts], axis=2)
        return cls(np.asarray(gram), np.asarray(data), coordinates, size, draws)

    @classmethod
    def over_points(cls, parts: Sequence[ColumnProducts]) -> ColumnProducts:
        """Join the products at several groups of grid points."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def without_draws(self) -> ColumnProducts:
        """Return the products with the model and the measured series alone."""
        return replace(self, draws=self.draws[:, :, :0])


def column_products(
    piece: LinearisedPiece, whitened: Array, k: int, series: ScannedSeries, frames: slice
) -> ColumnProducts:
    """Compute the products of whitened columns (g k, n) along one piece."""
    left, coordinates = piece.split(whitened)
    columns = left.reshape(-1, k, left.shape[1])
    gram = columns @ columns.transpose(0, 2, 1)
    squares = np.einsum("gkk->gk", gram)
    size = np.sqrt(np.where(squares > MIN_COLUMN_SQUARE, squares, 1.0))  # smaller ones gain nothing
    data, draws = columns @ series.measured[frames], series.residuals[frames, 1:]
    products = (left / size.reshape(-1, 1)).astype(np.float32) @ draws
    shape = *size.shape, -1
    return ColumnProducts(gram, data, coordinates.reshape(shape), size, products.reshape(shape))


@dataclass(frozen=True, eq=False)
class GridProducts:
    """Products of all C columns of several grids with one another.

    Attributes
    ----------
    rows : list of array of shape (G, K)
        Place of the columns of every grid among all.
    gram : array of shape (C, C)
        Gram matrix of the columns outside the bases of the pieces.
    data : array of shape (C,)
        Products of these remainders with the measured series.
    coordinates : array of shape (C, L)
        Coordinates of the columns in the bases of the pieces.

    """

    rows: list[NDArray[np.int_]]
    gram: Array
    data: Array
    coordinates: Array


def products_of_grids(law: LinearisedModel, grids: Sequence[CandidateGrid], series: ScannedSeries) -> GridProducts:
    """Compute the products of the columns of a few small grids with one another."""
    ends = np.cumsum([0, *(len(grid.values) * grid.size for grid in grids)])
    rows = [np.arange(a, b).reshape(len(g.values), -1) for a, b, g in zip(ends, ends[1:], grids, strict=False)]
    count = int(ends[-1])
    out = GridProducts(rows, np.zeros((count, count)), np.zeros(count), np.zeros((count, len(series.coordinates))))
    for i, piece in enumerate(law.pieces):
        acting = [(g, own, g.block[g.members.index(i)]) for g, own in zip(grids, rows, strict=True) if i in g.members]
        if not acting:
            continue
        at = np.concatenate([own[:, b * g.k : (b + 1) * g.k].ravel() for g, own, b in acting])
        left, coordinates = piece.split(np.concatenate([g.whitened_columns(piece, g.values) for g, _, _ in acting]))
        out.gram[at[:, None], at] += left @ left.T
        out.data[at] += left @ series.measured[law.rows[i]]
        out.coordinates[at, law.coordinate_slices[i]] = coordinates
    return out
