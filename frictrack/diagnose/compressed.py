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

from frictrack.effects import Path
from frictrack.fit.least_squares import PieceResponse, Solution
from frictrack.fit.linearised import is_linearised_about_measurement, linearise_about_measurement
from frictrack.fit.parameters import jacobian_basis, prior_jacobian
from frictrack.fit.pieces import Rows
from frictrack.records import Array

MAX_COMPONENTS = 800  # over all pieces, approximately
MIN_COMPONENTS_PER_PIECE = 4
POINTS_PER_SPLINE = 3  # points per spline at which a force is read
SPLINE_DEGREE = 3
MIN_REDUCED_CHI2_FAR = 100.0  # above which a model is far from the data, whatever it explains

Force = Callable[[Path], Array]  # along one piece (n,): columns (n, k), N


@dataclass(frozen=True)
class CompressedResidual:
    """The compressed residual of a fit, and the maps from forces to their traces in it.

    Parameters
    ----------
    paths
        Path of every piece at the n_i points where a force is read.
    force_maps
        Map (m_i, n_i) from a force at these points to its trace, by piece.
    rows
        Rows of the points among the frames of the piece.
    shift_maps
        Map (m_i, frames) from a shift of the picture, m, by piece.
    displacement_basis
        Displacement (frames, m_i) per component, m, by piece.
    runs
        Index of the run, by piece.
    model_directions, model_shares
        Directions (M, P) of the model and the shares (P,) that it removes.
    residual
        The compressed residual, (M,).
    n_frames
        Number of frames.
    excess
        Chi-squared above its expectation.
    leakage
        Largest share of the square of a model column that the projection leaves.

    """

    paths: list[Path]
    force_maps: list[Array]
    rows: list[Rows]
    shift_maps: list[Array]
    displacement_basis: list[Array]
    runs: list[int]
    model_directions: Array
    model_shares: Array
    residual: Array
    n_frames: int
    excess: float  # chi-squared above its expectation
    leakage: float = 0.0

    def project_out_model(self, traces: Array) -> Array:
        """Project the model out of traces (M, k)."""
        return np.asarray(
            traces - self.model_directions @ (self.model_shares[:, None] * (self.model_directions.T @ traces))
        )

    def traces_of(self, columns: Sequence[Array]) -> Array:
        """Traces of forces, with the model projected out.

        Parameters
        ----------
        columns
            Forces (n_i, k) at the points of every piece, N.

        Returns
        -------
        ndarray, shape (M, k)

        """
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
    held = solution.held
    about_measurement = about_measurement and is_linearised_about_measurement(solution.problem)
    if about_measurement:
        solution = linearise_about_measurement(solution)
    responses, layout = solution.responses, solution.problem.layout
    per_piece = max(MAX_COMPONENTS // len(responses), MIN_COMPONENTS_PER_PIECE)
    parts = [_compress_piece(solution, r, per_piece, unit_level=about_measurement) for r in responses]
    jac, data = solution.jac, solution.random_effect_data()
    removed = np.array([slot.effect == without for slot in layout.slots])
    data = data + jac[:, removed] @ np.where([s.linear for s in layout.slots], solution.p, 0.0)[removed]
    prior_jac = np.array(prior_jacobian(layout, solution.p))
    jac[:, removed | held], prior_jac[:, removed] = 0.0, 0.0
    basis = jacobian_basis(jac, layout.levels, prior_jac)
    starts = np.cumsum([0, *(len(r.r) for r in responses)])
    on_law = []
    projected = []
    for (q, *_), a, b in zip(parts, starts[:-1], starts[1:], strict=True):
        projected.append(q.T @ data[a:b])
        on_law.append(q.T @ basis.u[a:b])
    model_directions, model_shares = _square_root(np.concatenate(on_law), basis.shrink(solution.tau))
    on_basis = basis.u.T @ data
    chi2 = float(data @ data - on_basis @ basis.shrink(solution.tau) @ on_basis)
    free = len(data) - 2 * len(responses) - basis.u.shape[1]
    on_traces = np.concatenate(projected)
    compressed = CompressedResidual(
        paths=[path for _, path, *_ in parts],
        force_maps=[m for _, _, m, _ in parts],
        rows=[rows for *_, rows in parts],
        shift_maps=[r.piece.whitened_transposed(q).T for (q, *_), r in zip(parts, responses, strict=True)],
        displacement_basis=[r.piece.coloured(q) for (q, *_), r in zip(parts, responses, strict=True)],
        runs=[r.piece.run for r in responses],
        model_directions=model_directions,
        model_shares=model_shares,
        residual=on_traces - model_directions @ (model_shares * (model_directions.T @ on_traces)),
        n_frames=solution.problem.n_frames,
        excess=chi2 - free,
    )
    not_projected = {without, *(slot.effect for slot, one in zip(layout.slots, held, strict=True) if one)}
    return replace(compressed, leakage=_leakage(compressed, solution, not_projected))


def _leakage(compressed: CompressedResidual, solution: Solution, without: set[str]) -> float:
    """Largest share of the square of a model column that the projection leaves, `without` some effects."""
    layout = solution.problem.layout
    columns_by_piece = [
        layout.model.force_columns(p, layout.values(solution.p, r)[0])
        for p, r in zip(compressed.paths, compressed.runs, strict=True)
    ]
    shares = [0.0]
    for name in columns_by_piece[0].keys() - without:
        rows = np.concatenate([m @ own[name] for m, own in zip(compressed.force_maps, columns_by_piece, strict=True)])
        squares = np.sum(rows**2, axis=0)
        shares += (np.sum(compressed.project_out_model(rows) ** 2, axis=0)[squares > 0] / squares[squares > 0]).tolist()
    return max(shares)


def _square_root(on_law: Array, shrink: Array) -> tuple[Array, Array]:
    """Directions (M, P) and shares (P,) such that (I - u S u')^2 = I - w c w'."""
    q, upper = np.linalg.qr(on_law)
    values, vectors = np.linalg.eigh(upper @ shrink @ upper.T)
    return q @ vectors, 1 - np.sqrt(1 - np.clip(values, 0.0, 1.0))


def _compress_piece(
    solution: Solution, response: PieceResponse, max_components: int, *, unit_level: bool
) -> tuple[Array, Path, Array, Rows]:
    """Orthonormal traces (n, m) of one piece, its path at the points of a force, the map to the traces, and rows."""
    piece = response.piece
    count = max(min(len(piece.t) // 3, max_components), MIN_COMPONENTS_PER_PIECE)
    knots = _knots(piece.t[0], piece.t[-1], count)
    nodes = BSpline.design_matrix(np.clip(piece.panels.t, piece.t[0], piece.t[-1]), knots, SPLINE_DEGREE).toarray()
    edges = response.linear.edge_states(-nodes / piece.mass, np.zeros((2, count)))
    moved = piece.whitened((1 + response.shift_slope)[:, None] * edges[piece.at, 0])
    moved -= response.q @ (response.q.T @ moved)
    scale = np.linalg.norm(moved, axis=0)
    u, s, vt = np.linalg.svd(moved / np.where(scale > 0, scale, 1.0), full_matrices=False)
    keep = s > 1e-7 * s[0]
    rows = np.unique(np.linspace(0, len(piece.t) - 1, POINTS_PER_SPLINE * count).round().astype(int))
    read = np.linalg.pinv(BSpline.design_matrix(piece.t[rows], knots, SPLINE_DEGREE).toarray())
    back = (s[keep, None] * vt[keep]) * scale
    return u[:, keep], _path_at_rows(solution, response, rows, unit_level=unit_level), back @ read, rows


def _knots(first: float, last: float, count: int) -> Array:
    inner = np.linspace(first, last, count - SPLINE_DEGREE + 1)
    return np.concatenate([[first] * SPLINE_DEGREE, inner, [last] * SPLINE_DEGREE])


def _path_at_rows(solution: Solution, response: PieceResponse, rows: Rows, *, unit_level: bool) -> Path:
    """Path of one piece at some of its frames, at its own friction level or at one."""
    piece, motion = response.piece, response.motion
    level = 1.0 if unit_level else solution.problem.layout.values(solution.p, piece.run)[1]
    path = piece.at_frames(motion.x_edge[piece.at], motion.v_edge[piece.at], level)
    n = len(piece.t)
    series = vars(path).items()
    at_rows: dict[str, Any] = {k: q[rows] for k, q in series if isinstance(q, np.ndarray) and q.shape == (n,)}
    return replace(path, **at_rows)
