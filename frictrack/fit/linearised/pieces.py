"""The pieces of a fitted model linearised along the measured motion: maps from forces to whitened data.

Every piece keeps an orthonormal basis of its start and sensitivities. The rows of a candidate are split into their
few coordinates in that basis and the remainder. Only the remainder has to be compared with the long data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline

from frictrack.effects import Effect, Path
from frictrack.effects.models import Values
from frictrack.fit.least_squares import LeastSquaresProblem, PieceResponse, Solution
from frictrack.fit.linearised.measured_motion import is_linearised_about_measurement
from frictrack.fit.separable import (
    DataBlock,
    path_at_compared,
    repeat_values,
    rows_at_compared,
    tiled_path,
)
from frictrack.records import Array
from frictrack.simulate.dynamics import EdgeResponse, LinearResponse, linearise_acceleration

MIN_SINGULAR_VALUE = 1e-9  # relative; smaller singular values are not used


@dataclass(eq=False)
class LinearisedPiece:
    """One piece: maps forces along its path (k, m) to whitened rows (k, n) at the frames.

    Attributes
    ----------
    problem : LeastSquaresProblem
        The problem of the fit.
    response : PieceResponse
        The piece, linearised.
    values : dict
        Parameter values of its run.
    level : float
        Friction level of its run.
    path_level : float
        Friction level of `path`: one where the model is linearised about the measured motion.
    path : Path
        Motion about which the model is linearised, at the edges of the panels.
    basis : array of shape (n, L)
        Orthonormal basis; the columns of the start first.
    starts : int
        Number of columns of the start.
    moved : EdgeResponse, optional
        Response of the motion to an acceleration; none where friction was measured, which shows the force directly.
    compared_path : Path, optional
        The path at the compared frames only, where friction was measured and these are few.

    """

    problem: LeastSquaresProblem
    response: PieceResponse
    values: Values
    level: float
    path_level: float
    path: Path
    basis: Array
    starts: int
    moved: EdgeResponse | None
    compared_path: Path | None = None

    @property
    def run(self) -> int:
        """Index of its run."""
        return self.response.piece.run

    @property
    def factor(self) -> Array:
        """Measured shift at the frames per displacement that a unit acceleration against the motion causes, 1/kg."""
        return np.asarray(-(1 + self.response.shift_slope) / self.response.piece.mass)

    def columns(self, effect: Effect, values: Mapping[str, Any], count: int) -> Array:
        """Compute the columns of an effect along the path for a population of its non-linear parameters.

        Parameters
        ----------
        effect : Effect
            The effect.
        values : mapping
            Parameter name to value: a number for all individuals, or an array (count,).
        count : int
            Number of individuals.

        Returns
        -------
        array of shape (count, k, m)
            N per unit coefficient, or m for a measurement effect.

        """
        path = self.path_for(effect)
        n = len(path.t)
        spread = {k: repeat_values(v, n, effect.parameter(k).role == "depth") for k, v in values.items()}
        inner = [np.tile(self.modified_columns(effect), (count, 1))] if effect.modifies else []
        columns = effect.columns(tiled_path(path, count), spread, *inner)
        if inner and effect.sized:
            columns = columns - inner[0]
        return np.asarray(columns.T.reshape(columns.shape[1], count, n).transpose(1, 0, 2))

    def modified_columns(self, effect: Effect) -> Array:
        """Return what a modifier reshapes: the fitted force (m, 1), or columns (m, k) if it has no amplitude.

        A delay has no amplitude. Every column of the delayed effects then has its own coefficient.
        """
        model = self.problem.model
        columns = model.force_columns(self.path_for(effect), self.values)
        reshaped = [e.name for e in model.effects if e.kind in effect.modifies and e.name in columns]
        if not effect.sized:
            return np.concatenate([columns[name] for name in reshaped], axis=1)
        force: Array = np.sum([columns[name] @ model.coefficients(name, self.values) for name in reshaped], axis=0)
        return force[:, None]

    def path_for(self, effect: Effect) -> Path:
        """Return the path on which an effect is evaluated: the compared frames only, unless memory is involved."""
        has_memory = effect.memory or (effect.modifies and self.problem.model.memory)
        return self.path if self.compared_path is None or has_memory else self.compared_path

    def whitened_rows(self, raw: Array, is_measurement: bool) -> Array:
        """Compute the change in the measurement that columns make.

        Parameters
        ----------
        raw : array of shape (k, m)
            Forces along the path, N, or measurement shifts, m.
        is_measurement : bool
            Whether the columns are measurement shifts.

        Returns
        -------
        array of shape (k, n)
            Rows at the frames, in standard deviations.

        """
        piece = self.response.piece
        frames = piece.at // piece.per_frame
        if is_measurement or self.moved is None:
            return piece.whitened(rows_at_compared(raw, frames).T).T
        return piece.whitened((self.moved(raw)[:, frames] * self.factor).T).T

    def data_of(self, rows: Array, is_measurement: bool) -> Array:
        """Map forces, N, or measurement shifts, m, (..., m) to whitened data (..., n), the start projected out."""
        white = self.whitened_rows(rows.reshape(-1, rows.shape[-1]), is_measurement)
        q = self.basis[:, : self.starts]
        return np.asarray((white - (white @ q) @ q.T).reshape(*rows.shape[:-1], -1))

    def split(self, whitened: Array) -> tuple[Array, Array]:
        """Split whitened rows (k, n) into their remainder outside the basis (k, n) and their coordinates in it.

        The coordinates (k, L') exclude those of the start.
        """
        own_basis = whitened @ self.basis
        return whitened - own_basis @ self.basis.T, own_basis[:, self.starts :]

    def block(self) -> DataBlock:
        """Return the piece as data that forces along its path explain linearly. Its level is one there."""
        model, compared = self.problem.model, self.compared_path
        path = replace(self.path, load=self.path.load / self.path_level)
        friction = model.force(replace(path, load=path.load * self.level), self.values)
        data = self.response.r + self.data_of(friction, False)
        for name, columns in model.measurement_columns(self.path, self.values).items():
            data = data + self.data_of(columns @ model.coefficients(name, self.values), True)
        return DataBlock(
            run=self.run,
            path=path,
            data=data,
            forward=partial(self.data_of, is_measurement=False),
            picture=partial(self.data_of, is_measurement=True),
            friction=friction,
            compared_path=None if compared is None else replace(compared, load=compared.load / self.path_level),
        )


def linearised_piece(solution: Solution, response: PieceResponse) -> LinearisedPiece:
    """Linearise one piece of a solution about the motion of its response."""
    problem, piece, motion = solution.problem, response.piece, response.motion
    values, level = problem.layout.values(solution.p, piece.run)
    path_level = 1.0 if is_linearised_about_measurement(problem) else level
    u, size, _ = np.linalg.svd(response.jac / np.maximum(np.linalg.norm(response.jac, axis=0), 1e-300), False)
    basis = np.concatenate([response.q, u[:, size > MIN_SINGULAR_VALUE * max(float(size[0]), 1e-300)]], axis=1)
    if problem.simulates:
        path, compared_path = _edge_path(response, path_level), None
        moved = EdgeResponse(_linear(problem, solution.p, response))
    else:
        path, moved = piece.path_at_nodes(motion.x, motion.v, path_level), None
        compared_path = path_at_compared(piece, motion.x, motion.v, path_level)
    own = basis, response.q.shape[1], moved, compared_path
    return LinearisedPiece(problem, response, values, level, path_level, path, *own)


def _linear(problem: LeastSquaresProblem, p: Array, response: PieceResponse) -> LinearResponse:
    """The linear response of the model without memory, with one panel per frame."""
    if isinstance(response.linear, LinearResponse) and response.piece.per_frame == 1:
        return response.linear
    motion, piece = response.motion, response.piece.refined(1)
    where = CubicSpline(motion.panels.edges, motion.x_edge)(piece.panels.t)
    speed = CubicSpline(motion.panels.edges, motion.v_edge)(piece.panels.t)
    start = float(motion.x_edge[0]), float(motion.v_edge[0])
    acceleration = problem.acceleration(piece, p)
    return linearise_acceleration(acceleration, piece.panels, (where, speed), start, memory=problem.model.memory)[1]


def _edge_path(response: PieceResponse, level: float) -> Path:
    """The path at the edges of panels, one panel per frame interval."""
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
