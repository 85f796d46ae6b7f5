"""Compress the residual of a fit to few numbers, and map forces along the runs to their traces in them.

Fine detail of a force is below the camera's noise after double integration. Each piece is described by the responses of
its motion to a few splines in time, orthonormalised: the noise stays white, a thousand frames become a hundred numbers,
and a trial force costs one small product. The model's own columns, with friction levels held by their scatter, are
projected out of all of it.

References
----------
Golub & Pereyra (1973), SIAM J. Numer. Anal. 10, 413-432.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import qr

from frictrack.effects import Path
from frictrack.fit.least_squares import PieceResponse, Solution
from frictrack.fit.linearised import is_linearised_about_measurement, linearise_about_measurement
from frictrack.fit.penalties import jacobian_basis, prior_jacobian
from frictrack.fit.pieces import Rows
from frictrack.records import Array

MAX_COMPONENTS = 800  # over all pieces, approximately
MIN_COMPONENTS_PER_PIECE = 4
POINTS_PER_SPLINE = 3  # points per spline at which a force is read
SPLINE_DEGREE = 3
MIN_COMPONENT_SHARE = 1e-7  # of the largest one
MIN_REDUCED_CHI2_FAR = 100.0  # above which a model is far from the data, whatever it explains


@dataclass(frozen=True)
class CompressedResidual:
    """The compressed residual of a fit, and the maps from forces to their traces in it; lists are by piece."""

    paths: list[Path]  # at the n_i points where a force is read
    force_maps: list[Array]  # (m_i, n_i) from a force at these points to its trace
    rows: list[Rows]  # of the points among the frames
    components: list[Array]  # (frames, m_i) orthonormal, of the whitened displacement
    runs: list[int]  # index of the run
    model_directions: Array  # (M, P)
    model_shares: Array  # (P,) that the model removes of these directions
    residual: Array  # (M,)
    n_frames: int
    excess: float  # chi-squared above its expectation
    leakage: float = 0.0  # largest share of the square of a model column that the projection leaves

    def project_out_model(self, traces: Array) -> Array:
        """Project the model out of traces (M, ...)."""
        return np.asarray(traces - (self.model_directions * self.model_shares) @ (self.model_directions.T @ traces))

    def traces_of(self, columns: Sequence[Array]) -> Array:
        """Traces (M, k) of forces (n_i, k) at the points of every piece, with the model projected out."""
        return self.project_out_model(np.concatenate([m @ c for m, c in zip(self.force_maps, columns, strict=True)]))

    def concatenate(self, of: Callable[[Path], Array]) -> Array:
        """Evaluate a function of the path on all pieces, concatenated, (N,)."""
        return np.concatenate([of(path) for path in self.paths])

    def split_by_piece(self, columns: Array) -> list[Array]:
        """Split columns (N, k) along all pieces by piece."""
        return np.split(columns, np.cumsum([len(p.t) for p in self.paths])[:-1])


def is_far_from_data(solution: Solution) -> bool:
    """Whether the simulated motion is so far from the measured one that a force acts elsewhere along it."""
    return solution.chi2 > MIN_REDUCED_CHI2_FAR * solution.problem.n_frames


def compress_residual(solution: Solution, without: str = "", *, about_measurement: bool = False) -> CompressedResidual:
    """Compress the residual of a fit, linearised about its own motion.

    Parameters
    ----------
    solution
        The fit.
    without
        Name of an effect whose force counts as residual.
    about_measurement
        Linearise about the measured motion, if the problem allows it.

    Returns
    -------
    CompressedResidual

    """
    held, layout = solution.held, solution.problem.layout
    about_measurement = about_measurement and is_linearised_about_measurement(solution.problem)
    if about_measurement:
        solution = linearise_about_measurement(solution)
    responses = solution.responses
    per_piece = max(MAX_COMPONENTS // len(responses), MIN_COMPONENTS_PER_PIECE)
    components, force_maps, rows = zip(*(_compress_piece(r, per_piece) for r in responses), strict=True)
    removed = np.array([slot.effect == without for slot in layout.slots])
    jac, prior_jac = solution.jac, np.array(prior_jacobian(layout, solution.p))
    data = solution.random_effect_data()
    data = data + jac[:, removed] @ np.where([s.linear for s in layout.slots], solution.p, 0.0)[removed]
    jac[:, removed | held], prior_jac[:, removed] = 0.0, 0.0
    basis = jacobian_basis(jac, layout.levels, prior_jac)
    shrink, on_basis = basis.shrink(solution.tau), basis.u.T @ data
    whole = np.column_stack([data, basis.u])
    parts = np.split(whole, np.cumsum([len(r.r) for r in responses])[:-1])
    compressed = np.concatenate([q.T @ part for q, part in zip(components, parts, strict=True)])
    directions, shares = _square_root(compressed[:, 1:], shrink)
    made = CompressedResidual(
        paths=[_path_at(solution, r, at, about_measurement) for r, at in zip(responses, rows, strict=True)],
        force_maps=list(force_maps),
        rows=list(rows),
        components=list(components),
        runs=[r.piece.run for r in responses],
        model_directions=directions,
        model_shares=shares,
        residual=compressed[:, 0],
        n_frames=solution.problem.n_frames,
        excess=float(data @ data - on_basis @ shrink @ on_basis) - (len(data) - 2 * len(responses) - basis.u.shape[1]),
    )
    free = {slot.effect for slot in layout.slots} - {s.effect for s, one in zip(layout.slots, held, strict=True) if one}
    return replace(
        made, residual=made.project_out_model(made.residual), leakage=_leakage(made, solution, free - {without})
    )


def _leakage(compressed: CompressedResidual, solution: Solution, names: set[str]) -> float:
    """Largest share of the square of a column of some effects that the projection leaves."""
    layout = solution.problem.layout
    columns_by_piece = [
        layout.model.force_columns(path, layout.values(solution.p, run)[0])
        for path, run in zip(compressed.paths, compressed.runs, strict=True)
    ]
    shares = [0.0]
    for name in columns_by_piece[0].keys() & names:
        rows = np.concatenate([m @ own[name] for m, own in zip(compressed.force_maps, columns_by_piece, strict=True)])
        squares, left = np.sum(rows**2, axis=0), np.sum(compressed.project_out_model(rows) ** 2, axis=0)
        shares += (left[squares > 0] / squares[squares > 0]).tolist()
    return max(shares)


def _square_root(on_law: Array, shrink: Array) -> tuple[Array, Array]:
    """Directions (M, P) and shares (P,) such that (I - u S u')^2 = I - w c w'."""
    q, upper = np.linalg.qr(on_law)
    values, vectors = np.linalg.eigh(upper @ shrink @ upper.T)
    return q @ vectors, 1 - np.sqrt(1 - np.clip(values, 0.0, 1.0))


def _compress_piece(response: PieceResponse, max_components: int) -> tuple[Array, Array, Rows]:
    """Orthonormal traces (n, m) of one piece, the map to them from a force at some of its points, and their rows."""
    piece = response.piece
    count = max(min(len(piece.t) // 3, max_components), MIN_COMPONENTS_PER_PIECE)
    knots = _knots(piece.t[0], piece.t[-1], count)
    nodes = BSpline.design_matrix(np.clip(piece.panels.t, piece.t[0], piece.t[-1]), knots, SPLINE_DEGREE).toarray()
    edges = response.linear.edge_states(-nodes / piece.mass, np.zeros((2, count)))
    moved = piece.whitened((1 + response.shift_slope)[:, None] * edges[piece.at, 0])
    moved -= response.q @ (response.q.T @ moved)
    scale = np.linalg.norm(moved, axis=0)
    q, upper, order = qr(moved / np.where(scale > 0, scale, 1.0), mode="economic", pivoting=True)
    kept = np.abs(np.diag(upper)) > MIN_COMPONENT_SHARE * np.abs(upper[0, 0])
    rows = np.unique(np.linspace(0, len(piece.t) - 1, POINTS_PER_SPLINE * count).round().astype(int))
    read = np.linalg.pinv(BSpline.design_matrix(piece.t[rows], knots, SPLINE_DEGREE).toarray())
    return np.asarray(q[:, kept]), (upper[kept] * scale[order]) @ read[order], rows


def _knots(first: float, last: float, count: int) -> Array:
    inner = np.linspace(first, last, count - SPLINE_DEGREE + 1)
    return np.concatenate([[first] * SPLINE_DEGREE, inner, [last] * SPLINE_DEGREE])


def _path_at(solution: Solution, response: PieceResponse, rows: Rows, unit_level: bool) -> Path:
    """Path of one piece at some of its frames, at its own friction level or at one."""
    piece, motion = response.piece, response.motion
    level = 1.0 if unit_level else solution.problem.layout.values(solution.p, piece.run)[1]
    path = piece.at_frames(motion.x_edge[piece.at], motion.v_edge[piece.at], level)
    series: dict[str, Any] = {
        k: q[rows] for k, q in vars(path).items() if isinstance(q, np.ndarray) and q.shape == piece.t.shape
    }
    return replace(path, **series)
