"""Lay out the grid of scanned parameters on which a candidate effect is tried, and compute its columns there."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from frictrack.effects import Effect, Span, Tie
from frictrack.errors import FrictrackError
from frictrack.fit.linearised.model import LinearisedModel, LinearisedPiece, columns_one_by_one
from frictrack.records import Array

QUADRATURES = (0.0, np.pi / 2)


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

    @property
    def phases(self) -> list[dict[str, float]]:
        """The quadratures, or the one setting of an effect without free phase."""
        return _phases(self.effect)

    @property
    def blocks(self) -> list[list[int]]:
        """Positions among the members that share coefficients, for every block."""
        return [[m for m, own in enumerate(self.block) if own == b] for b in range(max(self.block) + 1)]

    def raw_columns(self, piece: LinearisedPiece, points: Array) -> Array:
        """Compute columns (Q, k, m) at points (Q, d) along one piece, one quadrature after the other."""
        values: dict[str, Any] = self.other_values | {n: np.array(c) for n, c in zip(self.names, points.T, strict=True)}
        values = _apply_ties(self.effect, values)
        parts = [_raw_columns(piece, self.effect, values | phase, len(points)) for phase in self.phases]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)


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
