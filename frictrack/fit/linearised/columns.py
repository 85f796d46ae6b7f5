"""The grid of scanned parameters of a candidate effect, its columns there, and their products."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError
from frictrack.base.workers import rows_at_once
from frictrack.effects import Effect, Span, Tie
from frictrack.fit.linearised.model import Float32Array, LinearisedModel, LinearisedPiece, ScannedSeries
from frictrack.records import Array

QUADRATURES = (0.0, np.pi / 2)
MIN_COLUMN_SQUARE = 1e-20  # smaller squares belong to places that no run reaches
ROOM = 8.0  # of the scale of a sum for longer columns, before all is scaled again


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
        parts = np.array_split(points, -(-len(points) // rows_at_once(len(piece.path_for(self.effect).t))))
        raw = (self.raw_columns(piece, part) for part in parts)
        is_measurement = self.effect.acts_on == "measurement"
        return np.concatenate([piece.whitened_rows(own.reshape(-1, own.shape[-1]), is_measurement) for own in raw])


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
        Gram matrices of the columns outside the bases of the pieces, or outside the spaces of the runs.
    data : array of shape (g, k)
        Products of these remainders with the measured series.
    coordinates : array of shape (g, k, L_b)
        Coordinates of the columns in these bases or spaces.
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
    def of_run(cls, parts: Iterable[ColumnProducts]) -> ColumnProducts:
        """Add the products along the pieces of a run, in place of the first; their coordinates are those in its space.

        They count what is inside the space as outside of it, too: it is taken out at the end.
        """
        total = _added(parts, operator.add)
        inside = total.coordinates
        return replace(total, gram=total.gram - inside @ inside.transpose(0, 2, 1))

    @classmethod
    def of_runs(cls, parts: Iterable[ColumnProducts]) -> ColumnProducts:
        """Add the products along several runs, in place of the first; each has coordinates of its own."""
        return _added(parts, lambda one, other: np.concatenate([one, other], axis=2))

    @classmethod
    def over_points(cls, parts: Sequence[ColumnProducts]) -> ColumnProducts:
        """Join the products at several groups of grid points."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def without_draws(self) -> ColumnProducts:
        """Return the products with the model and the measured series alone."""
        return replace(self, draws=self.draws[:, :, :0])


def _added(parts: Iterable[ColumnProducts], joined: Callable[[Array, Array], Array]) -> ColumnProducts:
    """Sum of products, held in the memory of the first; their coordinates are joined."""
    parts = iter(parts)
    total = next(parts)
    for p in parts:
        size = np.where(p.size > total.size, ROOM * p.size, total.size)
        for q in (total, p):
            if not np.array_equal(q.size, size):
                np.multiply(q.draws, (q.size / size).astype(np.float32)[:, :, None], out=q.draws)
        np.add(total.draws, p.draws, out=total.draws)
        inside = joined(total.coordinates, p.coordinates)
        total = replace(total, gram=total.gram + p.gram, data=total.data + p.data, coordinates=inside, size=size)
    return total


@dataclass(frozen=True, eq=False)
class SeriesOfPiece:
    """The measured series (n,) and the draws (n, D - 1) along one piece, outside its basis.

    In a run of several pieces, the rows of their coordinates outside the `space` (L, L') of the run follow.
    """

    measured: Array
    draws: Float32Array
    space: Array | None = None


def series_of_run(law: LinearisedModel, run: int, series: ScannedSeries) -> list[SeriesOfPiece]:
    """Return the series along every piece of a run."""
    rows = [law.rows[i] for i in law.members(run)]
    parts = [SeriesOfPiece(series.measured[own], series.residuals[own, 1:]) for own in rows]
    if len(parts) == 1:
        return parts
    if ("of run", run) in series.kept:
        return list(series.kept["of run", run])
    measured = law.outside_space(run, series.measured[:, None])[:, 0]
    draws = law.outside_space(run, series.residuals[:, 1:]).astype(np.float32)
    ends = np.cumsum([law.pieces[i].basis.shape[1] - law.pieces[i].starts for i in law.members(run)])[:-1]
    cut = zip(*(np.split(whole, ends) for whole in (measured, draws, law.spaces[law.runs.index(run)])), strict=True)
    made = [
        SeriesOfPiece(np.append(p.measured, m), np.vstack([p.draws, d]), v)
        for p, (m, d, v) in zip(parts, cut, strict=True)
    ]
    series.kept["of run", run] = made
    return made


def column_products(piece: LinearisedPiece, whitened: Array, k: int, series: SeriesOfPiece) -> ColumnProducts:
    """Compute the products of whitened columns (g k, n) along one piece."""
    left, coordinates = piece.split(whitened)
    if series.space is not None:
        left, coordinates = np.hstack([left, coordinates]), coordinates @ series.space
    columns = left.reshape(-1, k, left.shape[1])
    gram = columns @ columns.transpose(0, 2, 1)
    squares = np.einsum("gkk->gk", gram)
    size = np.sqrt(np.where(squares > MIN_COLUMN_SQUARE, squares, 1.0))  # smaller ones gain nothing
    products = (left / size.reshape(-1, 1)).astype(np.float32) @ series.draws
    shape = *size.shape, -1
    return ColumnProducts(gram, columns @ series.measured, coordinates.reshape(shape), size, products.reshape(shape))


@dataclass(frozen=True, eq=False)
class GridProducts:
    """Products of all C columns of several grids with one another.

    Attributes
    ----------
    rows : list of array of shape (G, K)
        Place of the columns of every grid among all.
    gram : array of shape (C, C)
        Gram matrix of the columns outside the spaces of the runs.
    data : array of shape (C,)
        Products of these remainders with the measured series.
    coordinates : array of shape (C, L)
        Coordinates of the columns in the spaces of the runs.

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
    for run, coordinates in zip(law.runs, law.coordinate_slices, strict=True):
        members = law.members(run)
        here = [(g, own) for g, own in zip(grids, rows, strict=True) if members[0] in g.members]
        if not here:
            continue
        blocks = [g.block[g.members.index(members[0])] for g, _ in here]
        at = np.concatenate([own[:, b * g.k : (b + 1) * g.k].ravel() for (g, own), b in zip(here, blocks, strict=True)])
        parts = []
        for piece, own in zip([law.pieces[i] for i in members], series_of_run(law, run, series), strict=True):
            whitened = np.concatenate([g.whitened_columns(piece, g.values) for g, _ in here])
            parts.append(column_products(piece, whitened, len(at), own))
        total = ColumnProducts.of_run(parts) if len(parts) > 1 else parts[0]
        out.gram[at[:, None], at] += total.gram[0]
        out.data[at] += total.data[0]
        out.coordinates[at, coordinates] = total.coordinates[0]
    return out
