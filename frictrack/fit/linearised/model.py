"""The fitted model linearised along the measured motion, ready for the forces of candidate effects.

Every piece keeps an orthonormal basis of its start and sensitivities. The rows of a candidate are split into their
few coordinates in that basis and the remainder. Only the remainder has to be compared with the long data.
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
from frictrack.fit.least_squares import LeastSquaresProblem, PieceResponse, Solution
from frictrack.fit.linearised.measured_motion import is_linearised_about_measurement, linearise_about_measurement
from frictrack.fit.linearised.stacked_pieces import ForceMap, stack_blocks
from frictrack.fit.parameters import JacobianBasis
from frictrack.fit.separable import BlockStack, DataBlock, path_at_compared, rows_at_compared, tiled_path
from frictrack.models import Model, Values
from frictrack.records import Array, Mask
from frictrack.simulate.dynamics import EdgeResponse, LinearResponse, linearise_acceleration

MIN_SINGULAR_VALUE = 1e-9  # relative; smaller singular values are not used
Float32Array = NDArray[np.float32]


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
    compared_path : Path, optional
        The path at the compared frames only, where friction was measured and these are few.

    """

    problem: LeastSquaresProblem
    response: PieceResponse
    values: Values
    level: float
    path_level: float  # the level of `path`
    path: Path
    basis: Array
    starts: int
    _rows: EdgeResponse | None = field(repr=False)
    compared_path: Path | None = None
    _tiled: dict[tuple[int, int], Path] = field(default_factory=dict, repr=False)

    @property
    def run(self) -> int:
        """Index of its run."""
        return self.response.piece.run

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
        tiled = path if count == 1 else self._tile_path(path, count)
        spread = {k: _repeat_values(v, n, effect.parameter(k).role == "depth") for k, v in values.items()}
        if effect.modifies:
            inner = self.modified_columns(effect)
            columns = effect.columns(tiled, spread, np.tile(inner, (count, 1)))
            if effect.sized:
                columns = columns - np.tile(inner, (count, 1))
        else:
            columns = effect.columns(tiled, spread)
        return np.asarray(columns.T.reshape(columns.shape[1], count, n).transpose(1, 0, 2))

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
        if is_measurement or self._rows is None:  # a measured friction shows the force directly
            return piece.whitened(rows_at_compared(raw, frames).T).T
        moved = self._rows(raw)[:, frames] * (-(1 + self.response.shift_slope) / piece.mass)
        return piece.whitened(moved.T).T

    def without_start(self, whitened: Array) -> Array:
        """Project the start out of whitened rows (k, n)."""
        q = self.basis[:, : self.starts]
        return whitened - (whitened @ q) @ q.T

    def split(self, whitened: Array) -> tuple[Array, Array]:
        """Split whitened rows (k, n) into their remainder outside the basis (k, n) and their coordinates in it.

        The coordinates (k, L') exclude those of the start.
        """
        own_basis = whitened @ self.basis
        return whitened - own_basis @ self.basis.T, own_basis[:, self.starts :]

    def modified_columns(self, effect: Effect) -> Array:
        """Return what a modifier reshapes: the fitted force (m, 1), or columns (m, k) if it has no amplitude.

        A delay has no amplitude. Every column of the delayed effects then has its own coefficient.
        """
        model: Model = self.problem.model
        columns = model.force_columns(self.path_for(effect), self.values)
        reshaped = [e.name for e in model.effects if e.kind in effect.modifies and e.name in columns]
        if not effect.sized:
            return np.concatenate([columns[name] for name in reshaped], axis=1)
        force: Array = np.sum([columns[name] @ model.coefficients(name, self.values) for name in reshaped], axis=0)
        return force[:, None]

    @property
    def forces(self) -> ForceMap | None:
        """The map from forces to the data, where pieces can be joined; None where friction was measured."""
        if self._rows is None or self._rows.stiff:
            return None
        factor = -(1 + self.response.shift_slope) / self.response.piece.mass
        return ForceMap(self.response.piece, self._rows, factor, self.basis[:, : self.starts])

    def block(self) -> DataBlock:
        """Return the piece as data that forces along its path explain linearly. Its level is one there."""
        model, response = self.problem.model, self.response
        unit_level_path = replace(self.path, load=self.path.load / self.path_level)
        path = replace(unit_level_path, load=unit_level_path.load * self.level)
        forces = model.force(path, self.values)[None]
        about_measurement = self.whitened_rows(forces, False)
        for name, columns in model.measurement_columns(self.path, self.values).items():
            about_measurement = about_measurement + self.whitened_rows(
                (columns @ model.coefficients(name, self.values))[None], True
            )
        return DataBlock(
            run=self.run,
            path=unit_level_path,
            data=response.r + self.without_start(about_measurement)[0],
            forward=lambda rows: _map_rows(
                rows, lambda unit_level_path: self.without_start(self.whitened_rows(unit_level_path, False))
            ),
            picture=lambda rows: _map_rows(
                rows, lambda unit_level_path: self.without_start(self.whitened_rows(unit_level_path, True))
            ),
            friction=forces[0],
            compared_path=None
            if self.compared_path is None
            else replace(self.compared_path, load=self.compared_path.load / self.path_level),
        )

    def path_for(self, effect: Effect) -> Path:
        """Return the path on which an effect is evaluated: the compared frames only, unless memory is involved."""
        has_memory = effect.memory or (effect.modifies and self.problem.model.memory)
        return self.path if self.compared_path is None or has_memory else self.compared_path

    def _tile_path(self, path: Path, count: int) -> Path:
        """One path through the individuals of a population laid end to end."""
        n = len(path.t)
        if (count, n) not in self._tiled:
            self._tiled[count, n] = tiled_path(path, count)
        return self._tiled[count, n]


def _map_rows(rows: Array, of: Callable[[Array], Array]) -> Array:
    """Apply a map of rows (k, m) to rows (..., m)."""
    return of(rows.reshape(-1, rows.shape[-1])).reshape(*rows.shape[:-1], -1)


def _repeat_values(value: Any, n: int, deep: bool) -> Any:
    if not isinstance(value, np.ndarray):
        return value
    if len(value) == 1:
        return float(value[0])
    tiled = np.repeat(value, n)
    return tiled[:, None] if deep else tiled


@dataclass(eq=False)
class LinearisedModel:
    """A fitted model ready for candidates: its pieces, and its orthonormal basis in the coordinates of theirs.

    Attributes
    ----------
    solution : Solution
        The fit, linearised about the measured motion.
    basis : JacobianBasis
        Orthonormal basis (N, P') of the model.
    pieces : list of LinearisedPiece
        The pieces.
    basis_coordinates : array of shape (L, P')
        Coordinates of `basis` in the bases of the pieces.
    rows : list of slice
        Rows of every piece among all N frames.
    coordinate_slices : list of slice
        Coordinates of every piece among all L.
    unbounded : tuple of JacobianBasis and array
        Basis and its coordinates with the sensitivities to the unknowns that a bound holds.

    """

    solution: Solution
    basis: JacobianBasis
    pieces: list[LinearisedPiece]
    basis_coordinates: Array
    rows: list[slice]
    coordinate_slices: list[slice]
    unbounded: tuple[JacobianBasis, Array]

    @property
    def runs(self) -> list[int]:
        """Indices of the runs, in order."""
        return sorted({s.run for s in self.pieces})

    @cached_property
    def blocks(self) -> list[DataBlock]:
        """The pieces as data that forces along the measured motion explain."""
        return [s.block() for s in self.pieces]

    @cached_property
    def level_coordinates(self) -> Array:
        """Coordinates (L, R) of the sensitivities to the friction levels in the bases of the pieces."""
        return self.coordinates(self.solution.jac[:, self.solution.problem.layout.levels])

    @cached_property
    def stacks(self) -> list[BlockStack]:
        """The same data, those pieces together that can be evaluated together."""
        return stack_blocks(self.blocks, [s.forces for s in self.pieces])

    def coordinates(self, series: Array | NDArray[np.float32]) -> Array:
        """Compute the coordinates (L, D) of whitened data (N, D) in the bases of the pieces."""
        basis_parts = [s.basis[:, s.starts :].T @ series[rows] for s, rows in zip(self.pieces, self.rows, strict=True)]
        return np.asarray(np.concatenate(basis_parts), dtype=np.float64)

    def residual_projector(self, tau: float) -> Array:
        """Compute the projector (L, L) on what the refitted model leaves of coordinates.

        `tau` is the scatter of the friction levels.
        """
        return _projector(self.basis, self.basis_coordinates, tau)

    def unbounded_projector(self, tau: float) -> Array:
        """Compute the same projector (L, L) as if no bound held an unknown.

        A missing effect moves such an unknown away from its bound before it leaves any misfit.
        """
        return _projector(*self.unbounded, tau)

    def fitted_coordinates(self, coordinates: Array, tau: float) -> Array:
        """Compute the coordinates (P', D) in `basis` of the fits to data with coordinates (L, D), at one scatter."""
        return np.asarray(self.basis.shrink(tau) @ (self.basis_coordinates.T @ coordinates))


def _projector(basis: JacobianBasis, coordinates: Array, tau: float) -> Array:
    """Projector (L, L) on what a basis of given coordinates leaves at one scatter of the levels."""
    return np.asarray(np.eye(len(coordinates)) - coordinates @ basis.shrink(tau) @ coordinates.T)


def linearise(solution: Solution) -> LinearisedModel:
    """Prepare a fitted model for the scan of candidate effects.

    Parameters
    ----------
    solution : Solution
        The fit.

    Returns
    -------
    LinearisedModel
        Its linearisation about the measured motion. Unknowns that a bound holds are not free: the misfit that they
        would take up beyond it is left for candidates.

    """
    about_measurement = linearise_about_measurement(solution)
    pieces = [_linearised_piece(about_measurement, r) for r in about_measurement.responses]
    frame_slices = [
        slice(a, b) for a, b in pairwise(np.cumsum([0, *[len(r.r) for r in about_measurement.responses]]).tolist())
    ]

    def coordinates_of(basis: JacobianBasis) -> list[Array]:
        return [s.basis[:, s.starts :].T @ basis.u[rows] for s, rows in zip(pieces, frame_slices, strict=True)]

    bounded, unbounded = about_measurement, about_measurement.basis
    unbounded_parts = coordinates_of(unbounded)
    basis, basis_parts = unbounded, unbounded_parts
    if np.any(solution.held):
        bounded = _without_held(about_measurement, solution.held)
        basis = bounded.basis
        basis_parts = coordinates_of(basis)
    coordinate_slices = [
        slice(a, b) for a, b in pairwise(np.cumsum([0, *[len(part) for part in basis_parts]]).tolist())
    ]
    return LinearisedModel(
        bounded,
        basis,
        pieces,
        np.concatenate(basis_parts),
        frame_slices,
        coordinate_slices,
        (unbounded, np.concatenate(unbounded_parts)),
    )


def _without_held(solution: Solution, held: Mask) -> Solution:
    """The solution without sensitivities to some unknowns (P,)."""
    responses = [replace(r, jac=np.where(held[r.active], 0.0, r.jac)) for r in solution.responses]
    fewer = replace(solution, responses=responses)
    vars(fewer)["held"] = held  # without their sensitivities it does not show
    return fewer


def _linearised_piece(solution: Solution, response: PieceResponse) -> LinearisedPiece:
    problem, piece, motion = solution.problem, response.piece, response.motion
    values, level = problem.layout.values(solution.p, piece.run)
    path_level = 1.0 if is_linearised_about_measurement(problem) else level
    u, size, _ = np.linalg.svd(response.jac / np.maximum(np.linalg.norm(response.jac, axis=0), 1e-300), False)
    own_basis = u[:, size > MIN_SINGULAR_VALUE * max(float(size[0]), 1e-300)]
    basis = np.concatenate([response.q, own_basis], axis=1)
    if not problem.simulates:
        path, rows, compared_path = (
            piece.path_at_nodes(motion.x, motion.v, path_level),
            None,
            path_at_compared(piece, motion.x, motion.v, path_level),
        )
    else:
        path, rows, compared_path = (
            _edge_path(response, path_level),
            EdgeResponse(_linear(problem, solution.p, response)),
            None,
        )
    return LinearisedPiece(
        problem, response, values, level, path_level, path, basis, response.q.shape[1], rows, compared_path
    )


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


@dataclass(eq=False)
class ScannedSeries:
    """Whitened data series to scan; the first one is measured.

    Attributes
    ----------
    measured : array of shape (N,)
        The measured series.
    residuals : array of shape (N, D), float32
        What the refitted model leaves of every series, at its own scatter of the levels.
    coordinates : array of shape (L, D)
        Coordinates of the series in the pieces' bases.
    taus : array of shape (T,)
        The considered scatters of the levels.
    residual_projectors : list of array of shape (L, L)
        For every scatter, the projector on what the model leaves.
    groups : list of slice
        The series whose own estimate each scatter is.
    profile : array of shape (T, D)
        Restricted likelihood of the model alone at the T scatters.
    kept : dict
        What scans of several grids share: products of plain waves in time, and what couples the runs.

    """

    measured: Array
    residuals: Float32Array
    coordinates: Array
    taus: Array
    residual_projectors: list[Array]
    groups: list[slice]
    profile: Array
    kept: dict[Any, Any] = field(default_factory=dict, repr=False)


def measured_series(law: LinearisedModel) -> ScannedSeries:
    """Return the measured data alone, at the fitted scatter of the levels."""
    data = law.solution.random_effect_data()
    tau, coordinates = law.solution.tau, law.coordinates(data[:, None])
    left = data[:, None] - law.basis.u @ law.fitted_coordinates(coordinates, tau)
    projectors = [law.residual_projector(tau)]
    return ScannedSeries(
        data, left.astype(np.float32), coordinates, np.array([tau]), projectors, [slice(0, 1)], np.zeros((1, 1))
    )
