"""What a candidate stands beside: the fitted law linearised along the measured motion, ready for rows of forces.

Every piece keeps an orthonormal basis of its own start and sensitivities. Rows of a candidate are split into what that
basis explains, a few coordinates, and the rest, which is all that must be held against long data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, make_interp_spline

from frictrack.effects import Effect, Path
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import LeastSquaresProblem, PieceResponse, Solution
from frictrack.fit.linearised.measured_motion import is_linearised_about_measurement, linearise_about_measurement
from frictrack.fit.parameters import JacobianBasis
from frictrack.fit.separable import DataBlock, path_at_compared, rows_at_compared
from frictrack.models import Model, Values
from frictrack.records import Array
from frictrack.simulate.dynamics import EdgeResponse, LinearResponse, linearise_acceleration

MIN_SINGULAR_VALUE = 1e-9  # singular value, over the largest, of a direction in which a piece answers the law


@dataclass(eq=False)
class LinearisedPiece:
    """One piece: rows of forces along its path (k, m) to whitened rows (k, n) at the frames.

    `path` is the motion about which the law is linearised, at the edges of the panels, its level one where laws are
    `linearise_about_measurement`; the run's own is `level`. `basis` (n, L) is orthonormal: the start's two columns
    first. `path_at_compared` is the path at the compared frames alone, where friction was measured and they are few.
    """

    problem: LeastSquaresProblem
    response: PieceResponse
    values: Values
    level: float
    shown: float  # the level of `path`
    path: Path
    basis: Array
    starts: int
    _rows: EdgeResponse | None = field(repr=False)
    compared_path: Path | None = None
    _long: dict[tuple[int, int], Path] = field(default_factory=dict, repr=False)

    @property
    def run(self) -> int:
        """Its run."""
        return self.response.piece.run

    def columns(self, effect: Effect, values: Mapping[str, Any], count: int) -> Array:
        """Raw columns of a population along the path, (count, k, m): N, or m of a picture.

        `values` holds numbers that all have in common, and arrays (count,).
        """
        path = self.path_for(effect)
        n = len(path.t)
        long = path if count == 1 else self._end_to_end(path, count)
        spread = {k: _repeat_values(v, n, effect.parameter(k).role == "depth") for k, v in values.items()}
        if effect.modifies:
            inner = self.modified_columns(effect)
            made = effect.columns(long, spread, np.tile(inner, (count, 1)))
            if effect.sized:
                made = made - np.tile(inner, (count, 1))
        else:
            made = effect.columns(long, spread)
        return np.asarray(made.T.reshape(made.shape[1], count, n).transpose(1, 0, 2))

    def whitened_rows(self, raw: Array, pictured: bool) -> Array:
        """What raw columns (k, m), of forces or of a picture, add to what is measured: whitened rows (k, n)."""
        piece = self.response.piece
        frames = piece.at // piece.per_frame
        if pictured or self._rows is None:  # where friction itself is measured, a force is seen as it is
            return piece.whitened(rows_at_compared(raw, frames).T).T
        moved = self._rows(raw)[:, frames] * (-(1 + self.response.shift_slope) / piece.mass)
        return piece.whitened(moved.T).T

    def without_start(self, white: Array) -> Array:
        """Whitened rows (k, n) without what another start explains."""
        q = self.basis[:, : self.starts]
        return white - (white @ q) @ q.T

    def split(self, white: Array) -> tuple[Array, Array]:
        """What of whitened rows (k, n) the basis does not explain, and their coordinates in it, (k, L), no starts."""
        own = white @ self.basis
        return white - own @ self.basis.T, own[:, self.starts :]

    def modified_columns(self, effect: Effect) -> Array:
        """What a modifier reshapes: the force that is there (m, 1), or for one without a size its columns (m, k).

        A delay has no size to grow with a coefficient: the columns that it makes of the others' have each their own.
        """
        model: Model = self.problem.model
        columns = model.force_columns(self.path_for(effect), self.values)
        reshaped = [e.name for e in model.effects if e.kind in effect.modifies and e.name in columns]
        if not effect.sized:
            return np.concatenate([columns[name] for name in reshaped], axis=1)
        force: Array = np.sum([columns[name] @ model.coefficients(name, self.values) for name in reshaped], axis=0)
        return force[:, None]

    def block(self) -> DataBlock:
        """The piece as data that forces along its path explain, linear in them; its level is one there."""
        model, response = self.problem.model, self.response
        flat = replace(self.path, load=self.path.load / self.shown)
        path = replace(flat, load=flat.load * self.level)
        forces = model.force(path, self.values)[None]
        seen = self.whitened_rows(forces, False)
        for name, columns in model.measurement_columns(self.path, self.values).items():
            seen = seen + self.whitened_rows((columns @ model.coefficients(name, self.values))[None], True)
        return DataBlock(
            run=self.run,
            path=flat,
            data=response.r + self.without_start(seen)[0],
            forward=lambda rows: _map_rows(rows, lambda flat: self.without_start(self.whitened_rows(flat, False))),
            picture=lambda rows: _map_rows(rows, lambda flat: self.without_start(self.whitened_rows(flat, True))),
            friction=forces[0],
            compared_path=None
            if self.compared_path is None
            else replace(self.compared_path, load=self.compared_path.load / self.shown),
        )

    def path_for(self, effect: Effect) -> Path:
        """Where an effect is evaluated: what neither remembers nor reshapes what does, where friction is compared."""
        remembers = effect.memory or (effect.modifies and self.problem.model.memory)
        return self.path if self.compared_path is None or remembers else self.compared_path

    def _end_to_end(self, path: Path, count: int) -> Path:
        """One path through the individuals of a population laid end to end."""
        n = len(path.t)
        if (count, n) not in self._long:
            long: dict[str, Any] = {
                name: np.tile(value, count)
                for name, value in vars(path).items()
                if isinstance(value, np.ndarray) and value.shape == (n,)
            }
            self._long[count, n] = replace(path, starts=tuple(range(0, n * count, n)), **long)
        return self._long[count, n]


def _map_rows(rows: Array, of: Callable[[Array], Array]) -> Array:
    """A map of rows (k, m) to rows (k, n), of rows (..., m)."""
    return of(rows.reshape(-1, rows.shape[-1])).reshape(*rows.shape[:-1], -1)


def _repeat_values(value: Any, n: int, deep: bool) -> Any:
    if not isinstance(value, np.ndarray):
        return value
    if len(value) == 1:
        return float(value[0])
    long = np.repeat(value, n)
    return long[:, None] if deep else long


@dataclass(eq=False)
class LinearisedModel:
    """A fitted law as candidates see it: its pieces, and the basis of the whole in the coordinates of theirs.

    `basis_coordinates` (L, P') are the coordinates of the law's orthonormal basis; `rows` and `places` are where the
    frames of each piece stand among all frames, and its coordinates among all L.
    """

    solution: Solution
    basis: JacobianBasis
    pieces: list[LinearisedPiece]
    basis_coordinates: Array
    rows: list[slice]
    places: list[slice]

    @property
    def runs(self) -> list[int]:
        """The runs, in order."""
        return sorted({s.run for s in self.pieces})

    @cached_property
    def blocks(self) -> list[DataBlock]:
        """The pieces as data that forces along the measured motion explain."""
        return [s.block() for s in self.pieces]

    def coordinates(self, series: Array | NDArray[np.float32]) -> Array:
        """Coordinates (L, D) of whitened data (N, D) in the bases of the pieces."""
        parts = [s.basis[:, s.starts :].T @ series[rows] for s, rows in zip(self.pieces, self.rows, strict=True)]
        return np.asarray(np.concatenate(parts), dtype=np.float64)

    def residual_projector(self, tau: float) -> Array:
        """What the law leaves of coordinates once its unknowns, levels held by their spread, have followed, (L, L)."""
        taken = self.basis_coordinates @ self.basis.shrink(tau) @ self.basis_coordinates.T
        return np.asarray(np.eye(len(taken)) - taken)


def linearise(solution: Solution) -> LinearisedModel:
    """A fitted law made ready for candidates."""
    seen = linearise_about_measurement(solution)
    basis = seen.basis
    pieces = [_linearised_piece(seen, r) for r in seen.responses]
    ends = [slice(a, b) for a, b in pairwise(np.cumsum([0, *[len(r.r) for r in seen.responses]]).tolist())]
    parts = [s.basis[:, s.starts :].T @ basis.u[rows] for s, rows in zip(pieces, ends, strict=True)]
    places = [slice(a, b) for a, b in pairwise(np.cumsum([0, *[len(part) for part in parts]]).tolist())]
    return LinearisedModel(seen, basis, pieces, np.concatenate(parts), ends, places)


def _linearised_piece(solution: Solution, response: PieceResponse) -> LinearisedPiece:
    problem, piece, motion = solution.problem, response.piece, response.motion
    values, level = problem.layout.values(solution.p, piece.run)
    shown = 1.0 if is_linearised_about_measurement(problem) else level
    u, size, _ = np.linalg.svd(response.jac / np.maximum(np.linalg.norm(response.jac, axis=0), 1e-300), False)
    own = u[:, size > MIN_SINGULAR_VALUE * max(float(size[0]), 1e-300)]
    basis = np.concatenate([response.q, own], axis=1)
    if not problem.simulates:
        path, rows, few = (
            piece.path_at_nodes(motion.x, motion.v, shown),
            None,
            path_at_compared(piece, motion.x, motion.v, shown),
        )
    else:
        path, rows, few = _edge_path(response, shown), EdgeResponse(_linear(problem, solution.p, response)), None
    return LinearisedPiece(problem, response, values, level, shown, path, basis, response.q.shape[1], rows, few)


def _linear(problem: LeastSquaresProblem, p: Array, response: PieceResponse) -> LinearResponse:
    """The law's own response without memory, one panel per frame."""
    if isinstance(response.linear, LinearResponse) and response.piece.per_frame == 1:
        return response.linear
    motion, piece = response.motion, response.piece.refined(1)
    where = CubicSpline(motion.panels.edges, motion.x_edge)(piece.panels.t)
    speed = CubicSpline(motion.panels.edges, motion.v_edge)(piece.panels.t)
    start = float(motion.x_edge[0]), float(motion.v_edge[0])
    law = problem.acceleration(piece, p)
    return linearise_acceleration(law, piece.panels, (where, speed), start, memory=problem.model.memory)[1]


def _edge_path(response: PieceResponse, level: float) -> Path:
    """The path at the edges of one panel per frame interval."""
    piece, motion = response.piece, response.motion
    step = slice(None, None, piece.per_frame)
    x, v, t = motion.x_edge[step], motion.v_edge[step], motion.panels.edges[step]
    path = piece.path_at_nodes(x, v, level) if piece.turns else replace(piece.path, load=piece.path.load * level)
    s = path.s if piece.turns else np.full_like(x, piece.path.s[0])
    series = {name: getattr(piece.path, name) for name in ("drive", "lift", "angle")}
    read: dict[str, Any] = {
        k: make_interp_spline(piece.panels.t, q, k=1)(t) for k, q in series.items() if q is not None
    }
    return replace(path, t=t, x=x, v=v, s=s, **read)


def columns_one_by_one(strip: LinearisedPiece, effect: Effect, points: Mapping[str, Array], count: int) -> Array:
    """Raw columns (count, k, m) of forms taken one by one; nothing where a user's formula is no number."""
    out = []
    for i in range(count):  # one after the other: only some are wrong
        try:
            out.append(strip.columns(effect, {k: _value_of(v, i) for k, v in points.items()}, 1)[0])
        except FrictrackError:
            out.append(np.zeros((len(effect.linear), len(strip.path.t))))
    return np.stack(out)


def _value_of(value: Any, i: int) -> float:
    return float(value[i if len(value) > 1 else 0]) if isinstance(value, np.ndarray) else float(value)
