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

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.effects import Effect, Span, Tie
from frictrack.errors import FrictrackError
from frictrack.fit.linearised.model import LinearisedModel, LinearisedPiece, columns_one_by_one
from frictrack.records import Array

MIN_UNEXPLAINED_SHARE = 1e-10  # smallest share of a column outside the model
MIN_COLUMN_SQUARE = 1e-20  # smaller squares belong to places that no run reaches
QUADRATURES = (0.0, np.pi / 2)
MAX_FORMS_PROFILED = 200  # grid points times coefficients up to which tau is estimated at every grid point
MAX_SAMPLES_AT_ONCE = 60_000  # samples evaluated at once, so that they fit into the cache
Float32Array = NDArray[np.float32]


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
    low: Array  # (K,), bounds of the coefficients
    high: Array

    @property
    def size(self) -> int:
        """Number K of coefficients at a grid point."""
        return self.k * (max(self.block) + 1)

    def point(self, g: int) -> dict[str, float]:
        """Return all non-linear values at one grid point, by name."""
        return _apply_ties(self.effect, self.other_values | dict(zip(self.names, self.values[g].tolist(), strict=True)))

    def chunks(self, strips: list[LinearisedPiece]) -> Iterator[slice]:
        """Yield slices of grid points to be evaluated together."""
        longest = max(len(strips[i].path_for(self.effect).t) for i in self.members)
        chunk_size = max(1, MAX_SAMPLES_AT_ONCE // longest)
        for first in range(0, len(self.values), chunk_size):
            yield slice(first, min(first + chunk_size, len(self.values)))

    def raw_columns(self, piece: LinearisedPiece, points: Array) -> Array:
        """Compute columns (Q, k, m) at points (Q, d) along one piece, one quadrature after the other."""
        values: dict[str, Any] = self.other_values | {n: np.array(c) for n, c in zip(self.names, points.T, strict=True)}
        values = _apply_ties(self.effect, values)
        parts = [_raw_columns(piece, self.effect, values | phase, len(points)) for phase in _phases(self.effect)]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)


@dataclass(frozen=True, eq=False)
class CandidateScan:
    """The scan of a candidate grid: its rows beside the model, and their products with the data.

    Attributes
    ----------
    grid : CandidateGrid
        The G points.
    unexplained_gram : array of shape (G, K, K)
        Gram matrices of the remainders outside the pieces' bases.
    coordinates : array of shape (G, K, L)
        Coordinates in these bases.
    data_products : array of shape (G, K)
        Products of the remainders with the data.
    gains : array of shape (G,)
        Fall of chi-squared of the data.
    max_gains : array of shape (D,)
        Largest gain of every series.

    """

    grid: CandidateGrid
    unexplained_gram: Array
    coordinates: Array
    data_products: Array
    gains: Array
    max_gains: Array

    def schur(self, projector: Array, g: slice | int = slice(None)) -> Array:
        """Compute the Gram matrices (G, K, K) with the model projected out.

        `projector` (L, L) comes from `LinearisedModel.residual_projector`, `g` selects grid points.
        """
        coordinates = self.coordinates[g]
        return np.asarray(self.unexplained_gram[g] + coordinates @ projector @ np.swapaxes(coordinates, -1, -2))

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
        data_products = self.data_products[g] + self.coordinates[g] @ (projector @ data)
        root = whitener(self.schur(projector, g)[None], self.full(g)[None])[0]
        return np.asarray(root.T @ (root @ data_products))

    def full(self, g: slice | int = slice(None)) -> Array:
        """Compute the squares of the columns, starts projected out, (G, K)."""
        return np.asarray(
            np.einsum("...kk->...k", self.unexplained_gram[g])
            + np.einsum("...kl,...kl->...k", self.coordinates[g], self.coordinates[g])
        )


def whitener(schur: Array, full: Array) -> Array:
    """Compute W (G, K, K) with W'W the inverse of projected Gram matrices. Absorbed columns gain nothing.

    `full` (G, K) are the squares of the columns before the projection.
    """
    size = np.sqrt(full)
    size[full < MIN_COLUMN_SQUARE] = np.inf
    unit_gram = schur / size[:, :, None] / size[:, None, :]
    if unit_gram.shape[1] == 1:
        return np.asarray(1 / np.sqrt(np.maximum(unit_gram, 0.0) + MIN_UNEXPLAINED_SHARE) / size[:, None, :])
    unit_gram[:, np.arange(unit_gram.shape[1]), np.arange(unit_gram.shape[1])] += MIN_UNEXPLAINED_SHARE
    return np.asarray(np.linalg.inv(np.linalg.cholesky(unit_gram)) / size[:, None, :])


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
    layout = law.solution.problem.layout
    if effect.single:
        each = [[i for i, s in enumerate(law.pieces) if s.run == r] for r in law.runs]
        return [
            _candidate_grid(law, effect, series_columns, layout.spans[law.pieces[series_columns[0]].run])
            for series_columns in each
        ]
    return [_candidate_grid(law, effect, list(range(len(law.pieces))), layout.span)]


def scan_points(effect: Effect, span: Span) -> list[dict[str, float]]:
    """Return every combination of the scanned parameters, the others at their value for a scan."""
    names, axes, other_values = _grid(effect, span)
    return [_apply_ties(effect, other_values | dict(zip(names, row.tolist(), strict=True))) for row in _points(axes)]


def _grid(effect: Effect, span: Span) -> tuple[tuple[str, ...], list[Array], dict[str, float]]:
    scanned = [p for p in effect.nonlinear if p.scan is not None and p.free]
    scanned.sort(key=lambda p: p.unit == "Hz")  # neighbours share all but the frequency, which some effects make use of
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


def _candidate_grid(law: LinearisedModel, effect: Effect, members: list[int], span: Span) -> CandidateGrid:
    names, axes, other_values = _grid(effect, span)
    runs = sorted({law.pieces[i].run for i in members})
    per_run = has_per_run_coefficients(effect)
    block = tuple(runs.index(law.pieces[i].run) if per_run else 0 for i in members)
    phases = len(_phases(effect))
    low, high = np.array([p.bounds for p in effect.linear]).reshape(-1, 2).T
    if phases > 1 or not effect.linear:
        k = phases * (
            law.pieces[members[0]].modified_columns(effect).shape[1] if effect.modifies else len(effect.linear)
        )
        low, high = np.full(k, -np.inf), np.full(k, np.inf)
    count = max(block) + 1
    shape = tuple(len(a) for a in axes) or (1,)
    box = np.tile(low, count), np.tile(high, count)
    return CandidateGrid(effect, names, _points(axes), shape, other_values, tuple(members), block, len(low), *box)


def _raw_columns(piece: LinearisedPiece, effect: Effect, values: dict[str, Any], count: int) -> Array:
    """Columns of a population; those of a user's formula one by one if some are not finite."""
    try:
        return piece.columns(effect, values, count)
    except FrictrackError:
        if effect.formula is None:
            raise
        return columns_one_by_one(piece, effect, values, count)


@dataclass(eq=False)
class ScannedSeries:
    """Whitened data series to scan; the first column is the measured one.

    Attributes
    ----------
    data : array of shape (N, D), float32
        The series.
    coordinates : array of shape (L, D)
        Their coordinates in the pieces' bases.
    residual_projectors : list of array of shape (L, L)
        For every considered scatter of the levels, the projector on what the model leaves.
    groups : list of slice
        The columns whose own estimate each scatter is.
    profile : array of shape (T, D)
        Restricted likelihood of the model alone at the T scatters.

    """

    data: Float32Array
    coordinates: Array
    residual_projectors: list[Array]
    groups: list[slice]
    profile: Array
    projected: list[Float32Array] = field(init=False)

    def __post_init__(self) -> None:
        pairs = zip(self.residual_projectors, self.groups, strict=True)
        self.projected = [
            (projector @ self.coordinates[:, series_columns]).astype(np.float32) for projector, series_columns in pairs
        ]


def measured_series(law: LinearisedModel) -> ScannedSeries:
    """Return the measured data alone, at the fitted scatter of the levels."""
    data = law.solution.random_effect_data()[:, None]
    tau = law.solution.tau
    return ScannedSeries(
        data.astype(np.float32), law.coordinates(data), [law.residual_projector(tau)], [slice(0, 1)], np.zeros((1, 1))
    )


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
    g, size, d = len(grid.values), grid.size, series.data.shape[1]
    unexplained_gram, coordinates = np.zeros((g, size, size)), np.zeros((g, size, len(law.basis_coordinates)))
    data_products, gains, max_gains = np.zeros((g, size)), np.zeros(g), np.zeros(d)
    compute_gains = (
        _gains_at_best_scatter
        if g * size <= MAX_FORMS_PROFILED and len(series.residual_projectors) > 1
        else _gains_at_own_scatter
    )
    for part in grid.chunks(law.pieces):
        products = np.zeros((part.stop - part.start, size, d), dtype=np.float32)
        for i, b in zip(grid.members, grid.block, strict=True):
            columns = slice(b * grid.k, (b + 1) * grid.k)
            _accumulate_piece(
                law,
                grid,
                i,
                part,
                (
                    unexplained_gram[part, columns, columns],
                    coordinates[part, columns],
                    products[:, columns],
                    series,
                ),
            )
        data_products[part] = products[:, :, 0]
        gain = compute_gains((unexplained_gram[part], coordinates[part], products), series, (grid.low, grid.high))
        gains[part] = gain[:, 0]
        np.maximum(max_gains, gain.max(axis=0), out=max_gains)
    return CandidateScan(grid, unexplained_gram, coordinates, data_products, gains, max_gains)


def _accumulate_piece(
    law: LinearisedModel, grid: CandidateGrid, i: int, part: slice, into: tuple[Array, Array, Array, ScannedSeries]
) -> None:
    """Add the products of one piece: Gram matrices, coordinates, products with the data."""
    piece, (unexplained_gram, coordinates, products, series) = law.pieces[i], into
    raw_columns = grid.raw_columns(piece, grid.values[part])
    count, k = raw_columns.shape[:2]
    unexplained, own_coordinates = piece.split(
        piece.whitened_rows(raw_columns.reshape(count * k, -1), grid.effect.acts_on == "measurement")
    )
    cube = unexplained.reshape(count, k, -1)
    unexplained_gram += cube @ cube.transpose(0, 2, 1)
    coordinates[:, :, law.coordinate_slices[i]] += own_coordinates.reshape(count, k, -1)
    products += (unexplained.astype(np.float32) @ series.data[law.rows[i]]).reshape(products.shape)


# Gram matrices (G, K, K), coordinates (G, K, L), products with series (G, K, D)
ScanProducts = tuple[Array, Array, Array]


def _gains_at_own_scatter(
    scan_products: ScanProducts, series: ScannedSeries, bounds: tuple[Array, Array]
) -> Array | Float32Array:
    """Fall of chi-squared (G, D) for every series, each at its own scatter."""
    out = np.empty((len(scan_products[0]), series.data.shape[1]), dtype=np.float32)
    for projector, columns, projected in zip(series.residual_projectors, series.groups, series.projected, strict=True):
        if columns.stop > columns.start:
            out[:, columns] = _gain_at_scatter(scan_products, (projector, projected), columns, bounds)
    return out


def _gains_at_best_scatter(scan_products: ScanProducts, series: ScannedSeries, bounds: tuple[Array, Array]) -> Array:
    """Fall of chi-squared (G, D) for every series, the scatter estimated again."""
    whole = slice(0, series.data.shape[1])
    best = np.full((len(scan_products[0]), whole.stop), np.inf)
    for projector, baseline in zip(series.residual_projectors, series.profile, strict=True):
        projector_and_coordinates = projector, (projector @ series.coordinates).astype(np.float32)
        np.minimum(best, baseline - _gain_at_scatter(scan_products, projector_and_coordinates, whole, bounds), out=best)
    return np.asarray(series.profile.min(axis=0) - best)


def _gain_at_scatter(
    scan_products: ScanProducts,
    projector_and_coordinates: tuple[Array, Float32Array],
    columns: slice,
    bounds: tuple[Array, Array],
) -> Float32Array:
    """Fall of chi-squared (G, D') at one scatter.

    A single coefficient keeps its bounds: data that ask for the wrong sign gain nothing.
    """
    (unexplained_gram, coordinates, products), (projector, projected) = scan_products, projector_and_coordinates
    g, size = products.shape[:2]
    full = np.einsum("gkk->gk", unexplained_gram) + np.einsum("gkl,gkl->gk", coordinates, coordinates)
    root = whitener(unexplained_gram + coordinates @ projector @ coordinates.transpose(0, 2, 1), full).astype(
        np.float32
    )
    products_with_data = (coordinates.reshape(g * size, -1).astype(np.float32) @ projected).reshape(g, size, -1)
    products_with_data += products[:, :, columns]
    whitened = root @ products_with_data
    if size == 1 and bounds[0][0] >= 0:
        np.maximum(whitened, 0.0, out=whitened)
    if size == 1 and bounds[1][0] <= 0:
        np.minimum(whitened, 0.0, out=whitened)
    gain: Float32Array = np.einsum("gkd,gkd->gd", whitened, whitened)
    return gain
