"""The fitted model linearised along the measured motion, ready for the forces of candidate effects.

Linearise a model about the measured motion, where its own motion differs from it.

A model that lacks a strong effect moves differently than the mass did. There a texture has another phase, and an
effect is no longer linear. The measured motion is the model's motion plus its smoothed residual. If nothing is
missing, it is the model's own motion, also near stops. One Newton step from it gives the model's motion to second
order in the smoothed residual.

Level times coefficient is not linear. The sensitivities are those at levels of one, where a deviation of the level is
the relative deviation of the force, whatever the coefficient. Levels far from one, because an effect is missing, then
do no harm.

The pieces of a fitted model linearised along the measured motion: maps from forces to whitened data.

Every piece keeps an orthonormal basis of its start and sensitivities. The rows of a candidate are split into their
few coordinates in that basis and the remainder. Only the remainder has to be compared with the long data.

References
----------
Eilers, P. H. C. (2003). A perfect smoother. Analytical Chemistry 75, 3631-3636.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.linalg import solveh_banded
from scipy.sparse import diags_array

from frictrack.base.errors import FrictrackError
from frictrack.effects import Effect, Path
from frictrack.effects.models import Values
from frictrack.fit.least_squares import LeastSquaresProblem, PieceResponse, Solution
from frictrack.fit.penalties import JacobianBasis
from frictrack.fit.pieces import Piece, consecutive_slices
from frictrack.fit.separable.model import DataBlock, path_at_compared, repeat_values, rows_at_compared, tiled_path
from frictrack.records import Array, Mask
from frictrack.simulate.dynamics import CollocationSolution, EdgeResponse, LinearResponse

# smoothing parameters; bandwidths from a tenth of the frame rate downwards
SMOOTHING_STRENGTHS = np.geomspace(10.0, 1e9, 17)
MAX_MISFIT_RATIO = 1e9  # of residuals about the measured motion to those about the own one: it grows without bound
MIN_SINGULAR_VALUE = 1e-9  # relative; smaller singular values are not used
Float32Array = NDArray[np.float32]


def linearise_about_measurement(solution: Solution) -> Solution:
    """Return the solution linearised about the measured motion.

    With memory, or with measured friction, it stays linearised about its own motion.

    Parameters
    ----------
    solution : Solution
        The fit.

    Returns
    -------
    Solution
        The same unknowns; residuals and sensitivities about the measured motion.

    Raises
    ------
    FrictrackError
        If the law leads away from that motion, so that it means nothing there.

    """
    problem = solution.problem
    if not is_linearised_about_measurement(problem):
        return solution
    about = [_response_about_measurement(problem, solution.p, r) for r in solution.responses]
    before, after = (np.linalg.norm(np.concatenate([r.r_full for r in own])) for own in (solution.responses, about))
    if not after < MAX_MISFIT_RATIO * before:
        raise FrictrackError(
            f"{' + '.join(problem.model.names)} leads away from the measured motion, along which it is judged; "
            "check the signs of incline, drive and spring, and the units of mass and scale"
        )
    return replace(solution, responses=about)


def is_linearised_about_measurement(problem: LeastSquaresProblem) -> bool:
    """Return whether solutions of a problem are linearised about the measured motion, at levels of one."""
    return problem.simulates and not problem.model.memory


def _response_about_measurement(problem: LeastSquaresProblem, p: Array, response: PieceResponse) -> PieceResponse:
    """Response of one piece, linearised about its measured motion."""
    piece, motion, linear = response.piece, response.motion, response.linear
    unit_levels = np.array(p)
    unit_levels[problem.layout.levels] = 1.0
    t, smoothed = smooth_residual(piece, piece.coloured(response.r_full))
    if not smoothed.any():
        return problem.linearised_response(piece, unit_levels, (motion, linear), motion.x_edge[piece.at])
    correction = CubicSpline(t, smoothed)
    nodes, edges = piece.panels.t, piece.panels.edges
    x, v = motion.x + correction(nodes), motion.v + correction(nodes, 1)
    acceleration = motion.a + correction(nodes, 2)
    about = CollocationSolution(
        piece.panels, x, v, acceleration, motion.x_edge + correction(edges), motion.v_edge + correction(edges, 1)
    )
    own, linear = problem.law_of(piece, p).linearised(about)
    start_correction = np.array([[-float(correction(edges[0]))], [-float(correction(edges[0], 1))]])
    _, moved = linear.respond((own - acceleration)[:, None], start_correction)
    return problem.linearised_response(
        piece, unit_levels, (about, linear), about.x_edge[piece.at] + moved[piece.at, 0, 0]
    )


def smooth_residual(piece: Piece, residual: Array) -> tuple[Array, Array]:
    """Smooth a residual with the strength that minimises generalised cross-validation.

    Parameters
    ----------
    piece : Piece
        The piece.
    residual : array of shape (n,)
        Residual at its frames, m.

    Returns
    -------
    t : array of shape (m,)
        Times of all frames, missing ones included, s.
    smoothed : array of shape (m,)
        Smoothed residual, m.

    """
    rows = piece.at // piece.per_frame
    n = int(rows[-1]) + 1
    weight, data = np.zeros(n), np.zeros(n)
    weight[rows], data[rows] = 1.0, residual
    differences = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(n - 2, n))
    penalty = differences.T @ differences
    bands = np.array([np.pad(penalty.diagonal(k), (k, 0)) for k in (2, 1, 0)])
    eigenvalues = (2 - 2 * np.cos(np.pi * np.arange(n) / n)) ** 2
    best, out = np.inf, np.zeros(n)
    for strength in SMOOTHING_STRENGTHS[::-1]:
        banded = strength * bands
        banded[2] += weight
        found = solveh_banded(banded, data, check_finite=False)
        degrees_of_freedom = float(np.sum(1 / (1 + strength * eigenvalues))) * len(rows) / n
        score = float(np.sum((residual - found[rows]) ** 2)) / (len(rows) - degrees_of_freedom) ** 2
        if score < best:
            best, out = score, found
    return piece.panels.edges[:: piece.per_frame], out


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
        reshaped = [e.name for e in effect.changed(model.effects)]
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

        def at_unit_level(path: Path) -> Path:
            return model.pressed(replace(path, load=path.load / self.path_level), self.values)

        path = at_unit_level(self.path)
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
            compared_path=None if compared is None else at_unit_level(compared),
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
    """The linear response of the model, with one panel per frame."""
    if response.piece.per_frame == 1:
        return response.linear
    motion, piece = response.motion, response.piece.refined(1)
    nodes = piece.panels.t
    x, v = (CubicSpline(motion.panels.edges, q)(nodes) for q in (motion.x_edge, motion.v_edge))
    edges = (q[:: response.piece.per_frame] for q in (motion.x_edge, motion.v_edge))
    return problem.law_of(piece, p).linearised(CollocationSolution(piece.panels, x, v, np.zeros_like(x), *edges))[1]


def _edge_path(response: PieceResponse, level: float) -> Path:
    """The path at the edges of panels, one panel per frame interval."""
    piece, motion = response.piece, response.motion
    step = slice(None, None, piece.per_frame)
    x, v, t = motion.x_edge[step], motion.v_edge[step], motion.panels.edges[step]
    s = piece.mean_direction(v) if piece.turns else np.full_like(x, piece.path.s[0])
    series = {name: getattr(piece.path, name) for name in ("drive", "lift", "angle")}
    read: dict[str, Any] = {
        k: make_interp_spline(piece.panels.t, q, k=1)(t) for k, q in series.items() if q is not None
    }
    return replace(piece.path, t=t, x=x, v=v, s=s, load=piece.path.load * level, **read).pressed()


@dataclass(eq=False)
class LinearisedModel:
    """A fitted model ready for candidates: its pieces, and its orthonormal basis in the coordinates of theirs.

    Attributes
    ----------
    solution : Solution
        The fit, linearised about the measured motion.
    pieces : list of LinearisedPiece
        The pieces.
    rows : list of slice
        Rows of every piece among all N frames.
    spaces : list of array of shape (L_r, L')
        For every run, orthonormal: what the model spans of the bases of its pieces, together L' directions.
    coordinate_slices : list of slice
        Coordinates of every run among all L.
    basis : JacobianBasis
        Orthonormal basis (N, P') of the model.
    basis_coordinates : array of shape (L, P')
        Coordinates of `basis` in the spaces of the runs.
    unbounded : tuple of JacobianBasis and array
        Basis and its coordinates with the sensitivities to the unknowns that a bound holds.

    """

    solution: Solution
    pieces: list[LinearisedPiece]
    rows: list[slice]
    spaces: list[Array]
    coordinate_slices: list[slice]
    basis: JacobianBasis
    basis_coordinates: Array
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
        """Coordinates (L, R) of the sensitivities to the friction levels."""
        return self.coordinates(self.solution.jac[:, self.solution.problem.layout.levels])

    def coordinates(self, series: Array | Float32Array) -> Array:
        """Compute the coordinates (L, D) of whitened data (N, D) in the spaces of the runs."""
        return _in_spaces(self.spaces, _coordinates(self.pieces, self.rows, series))

    def members(self, run: int) -> list[int]:
        """Return the indices of the pieces of a run, which follow one another."""
        return [i for i, piece in enumerate(self.pieces) if piece.run == run]

    def outside_space(self, run: int, series: Array | Float32Array) -> Array:
        """Compute the coordinates (L_r, D) of whitened data (N, D) in the pieces of a run, outside its space."""
        at, space = self.members(run), self.spaces[self.runs.index(run)]
        inside = _coordinates([self.pieces[i] for i in at], [self.rows[i] for i in at], series)
        return inside - space @ (space.T @ inside)

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
    free = linearise_about_measurement(solution)
    pieces = [linearised_piece(free, r) for r in free.responses]
    rows = consecutive_slices(len(r.r) for r in free.responses)
    spanned = _coordinates(pieces, rows, free.basis.u)
    spaces = _spaces(pieces, spanned)
    unbounded = free.basis, _in_spaces(spaces, spanned)
    parts = pieces, rows, spaces, consecutive_slices(space.shape[1] for space in spaces)
    if not np.any(solution.held):
        return LinearisedModel(free, *parts, *unbounded, unbounded)
    bounded = _without_held(free, solution.held)
    own = bounded.basis, _in_spaces(spaces, _coordinates(pieces, rows, bounded.basis.u))
    return LinearisedModel(bounded, *parts, *own, unbounded)


def _coordinates(pieces: Sequence[LinearisedPiece], rows: Sequence[slice], series: Array | Float32Array) -> Array:
    """Coordinates (L, D) of whitened data (N, D) in the bases of pieces."""
    parts = [s.basis[:, s.starts :].T @ series[own] for s, own in zip(pieces, rows, strict=True)]
    return np.asarray(np.concatenate(parts), dtype=np.float64)


def _spaces(pieces: Sequence[LinearisedPiece], spanned: Array) -> list[Array]:
    """What the model, with coordinates (L, P') in the bases of pieces, spans of those of every run."""
    # a run in hundreds of pieces has thousands of coordinates, of which the model spans as many as it has unknowns
    out, end = [], 0
    for _, own in groupby(pieces, key=lambda piece: piece.run):
        sizes = [piece.basis.shape[1] - piece.starts for piece in own]
        begin, end = end, end + sum(sizes)
        u, size, _ = np.linalg.svd(spanned[begin:end], full_matrices=False)
        several = len(sizes) > 1
        out.append(u[:, size > MIN_SINGULAR_VALUE * max(float(size[0]), 1e-300)] if several else np.eye(end - begin))
    return out


def _in_spaces(spaces: Sequence[Array], coordinates: Array) -> Array:
    """Coordinates (L', D) in the spaces of the runs of those (L, D) in the bases of their pieces."""
    parts = np.split(coordinates, np.cumsum([len(space) for space in spaces])[:-1])
    return np.concatenate([space.T @ own for space, own in zip(spaces, parts, strict=True)])


def _projector(basis: JacobianBasis, coordinates: Array, tau: float) -> Array:
    """Projector (L, L) on what a basis of given coordinates leaves at one scatter of the levels."""
    return np.asarray(np.eye(len(coordinates)) - coordinates @ basis.shrink(tau) @ coordinates.T)


def _without_held(solution: Solution, held: Mask) -> Solution:
    """The solution without sensitivities to some unknowns (P,)."""
    responses = [replace(r, jac=np.where(held[r.active], 0.0, r.jac)) for r in solution.responses]
    fewer = replace(solution, responses=responses)
    vars(fewer)["held"] = held  # without their sensitivities it does not show
    return fewer


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
        Coordinates of the series in the spaces of the runs.
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

    def projected(self, t: int) -> Array:
        """Return what the model leaves of the coordinates of all series at one scatter of the levels, (L, D)."""
        if ("projected", t) not in self.kept:
            self.kept["projected", t] = self.residual_projectors[t] @ self.coordinates
        return np.asarray(self.kept["projected", t])

    def divided(self, count: int) -> Iterator[ScannedSeries]:
        """Divide the draws into `count` of them, evenly from all groups, and the others; each with the measured one."""
        draws = self.residuals.shape[1] - 1
        is_first = np.zeros(draws, dtype=bool)
        is_first[np.linspace(0, draws - 1, min(count, draws)).round().astype(int)] = True
        for part in (is_first, ~is_first):
            if part.any():
                yield self._of(np.append(0, 1 + np.flatnonzero(part)))

    def _of(self, kept: NDArray[np.int_]) -> ScannedSeries:
        ends = [np.searchsorted(kept, (own.start, own.stop)).tolist() for own in self.groups]
        return replace(
            self,
            residuals=self.residuals[:, kept],
            coordinates=self.coordinates[:, kept],
            groups=[slice(*own) for own in ends],
            profile=self.profile[:, kept],
            kept={},
        )


def measured_series(law: LinearisedModel) -> ScannedSeries:
    """Return the measured data alone, at the fitted scatter of the levels."""
    data = law.solution.random_effect_data()
    tau, coordinates = law.solution.tau, law.coordinates(data[:, None])
    left = data[:, None] - law.basis.u @ law.fitted_coordinates(coordinates, tau)
    projectors = [law.residual_projector(tau)]
    return ScannedSeries(
        data, left.astype(np.float32), coordinates, np.array([tau]), projectors, [slice(0, 1)], np.zeros((1, 1))
    )
