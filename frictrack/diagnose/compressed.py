"""Compress the residual of a fit to few numbers, map forces along the runs to these, find the likeliest smooth force.

Fine detail of a force is below the camera's noise after double integration. Each piece is described by the responses of
its motion to a few splines in time, orthonormalised: the noise stays white, a thousand frames become a hundred numbers,
and a trial force costs one small product. The model's own columns, with friction levels held by their scatter, are
projected out of all of it.

A smooth force over place, time since release, speed, or phase of an oscillating motion is a Gaussian process
(Matern 5/2) on spline coefficients. Its amplitude and length maximise the restricted likelihood.

References
----------
Golub & Pereyra (1973), SIAM J. Numer. Anal. 10, 413-432.
Rasmussen & Williams (2006), Gaussian Processes for Machine Learning, ch. 5.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded, cholesky_banded, qr
from scipy.sparse import csr_array

from frictrack.effects import Path
from frictrack.fit.least_squares import PieceResponse, Solution
from frictrack.fit.linearised import is_linearised_about_measurement, linearise_about_measurement
from frictrack.fit.penalties import jacobian_basis, prior_jacobian
from frictrack.fit.pieces import Rows
from frictrack.fit.smooth_functions import SmoothProcess, matern_root, most_likely_process
from frictrack.records import Array

MAX_COMPONENTS = 800  # over all pieces, approximately
MIN_COMPONENTS_PER_PIECE = 4
POINTS_PER_SPLINE = 3  # points per spline at which a force is read
SPLINE_DEGREE = 3
SPLINES_AT_ONCE = 64  # of whose responses several copies are held
MIN_PIVOT = 1e-3  # of the splines at the points where a force is read; less are too few points
MIN_COMPONENT_SHARE = 1e-7  # of the largest one
MIN_REDUCED_CHI2_FAR = 100.0  # above which a model is far from the data, whatever it explains
N_SPLINES = 60  # of a smooth force, per axis
LENGTH_RATIOS = np.array([1.0, 0.5, 0.25, 0.125, 0.0625, 0.03, 0.015])  # correlation lengths over the axis
N_CURVE_POINTS = 81  # of the curve of a smooth force
MIN_LOAD_RATIO = 1.2  # above which runs differ in load
MIN_REVERSALS = 2  # of a motion with a phase


@dataclass(frozen=True)
class CompressedResidual:
    """The compressed residual of a fit, and the maps from forces to their traces in it; lists are by piece.

    Columns of forces (N, k) are at the points of all pieces, one piece after the other.
    """

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

    def raw_traces(self, columns: Array) -> Array:
        """Traces (M, k) of forces, N, model included."""
        parts = np.split(columns, np.cumsum([len(p.t) for p in self.paths])[:-1])
        return np.concatenate([m @ c for m, c in zip(self.force_maps, parts, strict=True)])

    def traces_of(self, columns: Array) -> Array:
        """Traces (M, k) of forces, N, with the model projected out."""
        return self.project_out_model(self.raw_traces(columns))

    def concatenate(self, of: Callable[[Path], Array]) -> Array:
        """Evaluate a function of the path on all pieces, concatenated, (N, ...)."""
        return np.concatenate([of(path) for path in self.paths])

    @cached_property
    def smooth(self) -> list[SmoothForce]:
        """The most likely smooth force over every axis that the runs can distinguish, largest gain first."""
        return smooth_forces(self, candidate_axes(self))


def is_far_from_data(solution: Solution) -> bool:
    """Whether the simulated motion is so far from the measured one that a force acts elsewhere along it."""
    return solution.chi2 > MIN_REDUCED_CHI2_FAR * solution.problem.n_frames


def compress_near_data(solution: Solution, without: str = "") -> CompressedResidual:
    """Compress the residual of a fit, about the measured motion where its own is far from the data."""
    return compress_residual(solution, without, about_measurement=is_far_from_data(solution))


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
    prior_jac = np.array(prior_jacobian(layout, solution.p))
    jac, data = _with_force_in_data(solution, without)
    jac[:, removed | held], prior_jac[:, removed] = 0.0, 0.0
    basis = jacobian_basis(jac, layout.levels, prior_jac)
    shrink, on_basis = basis.shrink(solution.tau), basis.u.T @ data
    whole = np.column_stack([data, basis.u])
    parts = np.split(whole, np.cumsum([len(r.r) for r in responses])[:-1])
    compressed = np.concatenate([q.T @ part for q, part in zip(components, parts, strict=True)])
    directions, shares = _square_root(compressed[:, 1:], shrink)
    of_force = [e for e in layout.model.effects if e.name == without]
    unit_level = about_measurement or any(e.level_is_chosen and not e.linear[0].loaded for e in of_force)
    made = CompressedResidual(
        paths=[_path_at(solution, r, at, unit_level) for r, at in zip(responses, rows, strict=True)],
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
    # effects of which no unknown is held
    free = {slot.effect for slot in layout.slots} - {s.effect for s, one in zip(layout.slots, held, strict=True) if one}
    return replace(
        made, residual=made.project_out_model(made.residual), leakage=_leakage(made, solution, free - {without})
    )


def _with_force_in_data(solution: Solution, name: str) -> tuple[Array, Array]:
    """Whitened Jacobian (N, P) and data (N,) in which the force of an effect is data, also where levels multiply it."""
    jac, data, layout = solution.jac, solution.random_effect_data(), solution.problem.layout
    sizes = [i for i, s in enumerate(layout.slots) if s.effect == name and s.linear]
    follow = {p.name for e in layout.model.effects if e.name == name for p in e.linear if p.loaded}
    ends = np.cumsum([0, *(len(r.r) for r in solution.responses)])
    for response, rows in zip(solution.responses, (slice(a, b) for a, b in pairwise(ends)), strict=True):
        traces = jac[rows][:, sizes] * solution.p[sizes]
        data[rows] += np.sum(traces, axis=1)
        for i in (i for i in layout.levels if layout.slots[i].run == response.piece.run):
            own = np.sum(traces[:, [layout.slots[k].parameter in follow for k in sizes]], axis=1) / solution.p[i]
            jac[rows, i] -= own
            data[rows] -= own * (solution.p[i] - 1)
    return jac, data


def _leakage(compressed: CompressedResidual, solution: Solution, names: set[str]) -> float:
    """Largest share of the square of a column of some effects that the projection leaves."""
    layout = solution.problem.layout
    columns_by_piece = [
        layout.model.force_columns(path, layout.values(solution.p, run)[0])
        for path, run in zip(compressed.paths, compressed.runs, strict=True)
    ]
    shares = [0.0]
    for name in columns_by_piece[0].keys() & names:
        rows = compressed.raw_traces(np.concatenate([own[name] for own in columns_by_piece]))
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
    moved, nodes = np.empty((len(piece.t), count)), _sparse_splines(piece.panels.t, knots).tocsc()
    for part in (slice(k, k + SPLINES_AT_ONCE) for k in range(0, count, SPLINES_AT_ONCE)):
        edges = response.linear.edge_states(-nodes[:, part].toarray() / piece.mass)
        moved[:, part] = piece.whitened((1 + response.shift_slope)[:, None] * edges[piece.at, 0])
    moved -= response.q @ (response.q.T @ moved)
    scale = np.linalg.norm(moved, axis=0)
    q, upper, order = qr(moved / np.where(scale > 0, scale, 1.0), mode="economic", pivoting=True)
    kept = np.abs(np.diag(upper)) > MIN_COMPONENT_SHARE * np.abs(upper[0, 0])
    rows = np.unique(np.linspace(0, len(piece.t) - 1, POINTS_PER_SPLINE * count).round().astype(int))
    read = _nearest_splines(_splines(piece.t[rows], knots))
    return np.asarray(q[:, kept]), (upper[kept] * scale[order]) @ read[order], rows


def _nearest_splines(at_points: Array) -> Array:
    """Map (K, n) from values at some points to the coefficients of the nearest splines, whose values are (n, K)."""
    gram = at_points.T @ at_points  # (B'B)^-1 B', of which B'B is banded
    bands = np.array([np.pad(np.diag(gram, -k), (0, k)) for k in range(SPLINE_DEGREE + 1)])
    with suppress(np.linalg.LinAlgError):
        factor = cholesky_banded(bands, lower=True)
        if factor[0].min() > MIN_PIVOT:
            return np.asarray(cho_solve_banded((factor, True), at_points.T))
    return np.asarray(np.linalg.pinv(at_points), dtype=np.float64)  # the points do not determine every spline


def _knots(low: float, high: float, count: int = N_SPLINES) -> Array:
    """Knots of so many splines between two ends."""
    inner = np.linspace(low, high, count - SPLINE_DEGREE + 1)
    return np.concatenate([[low] * SPLINE_DEGREE, inner, [high] * SPLINE_DEGREE])


def _splines(u: Array, knots: Array) -> Array:
    """Values (n, m) of the splines at u (n,), constant beyond their ends."""
    return np.asarray(_sparse_splines(u, knots).toarray())


def _sparse_splines(u: Array, knots: Array) -> csr_array:
    return BSpline.design_matrix(np.clip(u, knots[0], knots[-1]), knots, SPLINE_DEGREE)


def _path_at(solution: Solution, response: PieceResponse, rows: Rows, unit_level: bool) -> Path:
    """Path of one piece at some of its frames, at its own friction level or at one."""
    piece, motion = response.piece, response.motion
    level = 1.0 if unit_level else solution.problem.layout.values(solution.p, piece.run)[1]
    path = piece.at_frames(motion.x_edge[piece.at], motion.v_edge[piece.at], level)
    series: dict[str, Any] = {
        k: q[rows] for k, q in vars(path).items() if isinstance(q, np.ndarray) and q.shape == piece.t.shape
    }
    return replace(path, **series)


FACTORS: dict[str, Callable[[Path], Any]] = {  # what may multiply a force, as in a study file
    "L": lambda p: p.load,
    "s": lambda p: p.s,
    "x": lambda p: p.x,
    "t": lambda p: p.t,
    "abs(v)": lambda p: p.speed,
    "mass": lambda p: p.mass,
    "mass^(-1/2)": lambda p: np.asarray(p.mass, dtype=float) ** (-1 / 2),
    "mass^(-1/3)": lambda p: np.asarray(p.mass, dtype=float) ** (-1 / 3),
}


@dataclass(frozen=True)
class Axis:
    """A variable over which a force may repeat."""

    name: str  # "x", "t", "v" or "phase"
    of: Callable[[Path], Array]  # from a path to the variable, (n,)
    factor: str  # on the force along the path, as in a study file: a product of `FACTORS`, such as "L * s", or ""

    def times(self, path: Path) -> Array:
        """Factor on the force along a path, (n,)."""
        out = np.ones_like(path.t)
        for one in self.factor.split(" * ") if self.factor else ():
            out = out * FACTORS[one](path)
        return out


@dataclass(frozen=True)
class SmoothForce:
    """The most likely smooth force over one axis."""

    axis: Axis
    gain: float  # twice the rise of the log restricted likelihood
    at: Array  # values of the axis, (k,)
    force: Array  # N, (k,)
    sigma: Array  # its standard deviation, (k,)
    share: float  # of the chi-squared above its expectation
    traces: Array  # (M, k) of its k independent components of unit variance, model included


def smooth_forces(compressed: CompressedResidual, axes: Sequence[Axis]) -> list[SmoothForce]:
    """Find the most likely smooth force over every axis; the largest gain comes first."""
    return sorted((_smooth(compressed, axis) for axis in axes), key=lambda s: -s.gain)


@dataclass(frozen=True)
class SeparateCurves:
    """A smooth force over time in every run, with common amplitude and length: one process on splines, run by run."""

    process: SmoothProcess
    runs: list[int]
    knots: Array

    def at(self, run: int, t: Array) -> tuple[Array, Array]:
        """Mean and variance (n,) of the force in one run at times since release."""
        k = self.runs.index(run)
        own, basis = slice(k * N_SPLINES, (k + 1) * N_SPLINES), _splines(t, self.knots)
        return basis @ self.process.mean[own], np.sum((basis @ self.process.spread[own]) ** 2, axis=1)


def separate_curves(compressed: CompressedResidual, known: Array | None = None) -> SeparateCurves:
    """Find the most likely smooth force over time if every run has its own.

    `known`: traces (M, k) of forces that explain a part of it.
    """
    t, runs = compressed.concatenate(lambda p: p.t), sorted(set(compressed.runs))
    knots = _knots(float(t.min()), float(t.max()))
    of = np.repeat(compressed.runs, [len(p.t) for p in compressed.paths])
    basis = _splines(t, knots)
    traces = compressed.traces_of(np.hstack([basis * (of == run)[:, None] for run in runs]))
    residual = compressed.residual
    if known is not None:
        q, _ = np.linalg.qr(known)
        traces, residual = traces - q @ (q.T @ traces), residual - q @ (q.T @ residual)
    roots = [np.asarray(np.kron(np.eye(len(runs)), root), np.float64) for root in _roots()]
    return SeparateCurves(most_likely_process(traces.T @ traces, traces.T @ residual, roots), runs, knots)


def candidate_axes(compressed: CompressedResidual) -> list[Axis]:
    """Axes that these runs can distinguish; a phase needs a motion that reverses repeatedly."""
    steady = compressed.paths[0].steady
    named: dict[str, Callable[[Path], Array]] = {} if steady else {"x": lambda p: p.x, "t": lambda p: p.t}
    named["v"] = lambda p: p.speed
    if not steady and min(_count_reversals(compressed, run) for run in set(compressed.runs)) >= MIN_REVERSALS:
        named["phase"] = _phase_function(compressed)
    loads = compressed.concatenate(lambda p: np.broadcast_to(p.mass_ratio * p.gravity, p.t.shape))  # at level one
    one_way = np.ptp(compressed.concatenate(lambda p: p.s)) == 0
    factors = ["L * s"] + ([] if one_way else [""]) + (["s"] if np.max(loads) > MIN_LOAD_RATIO * np.min(loads) else [])
    return [Axis(name, of, factor) for name, of in named.items() for factor in factors]


def _count_reversals(compressed: CompressedResidual, run: int) -> int:
    """Number of reversals of a run."""
    s = np.concatenate([p.s for p, r in zip(compressed.paths, compressed.runs, strict=True) if r == run])
    return int(np.sum(np.diff(s[s != 0]) != 0))


def _phase_function(compressed: CompressedResidual) -> Callable[[Path], Array]:
    """Phase of an oscillating motion, rad: 0 at its middle going up, pi/2 at its upper end."""
    x, v = compressed.concatenate(lambda p: p.x), compressed.concatenate(lambda p: p.v)
    middle, reach, fast = (x.max() + x.min()) / 2, np.ptp(x) / 2, np.abs(v).max()
    return lambda p: np.arctan2((p.x - middle) / reach, p.v / fast)


def _smooth(compressed: CompressedResidual, axis: Axis) -> SmoothForce:
    """The most likely process over one axis."""
    u, residual = compressed.concatenate(axis.of), compressed.residual
    knots = _knots(float(u.min()), float(u.max()))
    raw = compressed.raw_traces(_splines(u, knots) * compressed.concatenate(axis.times)[:, None])
    traces = compressed.project_out_model(raw)
    grid = np.linspace(knots[0], knots[-1], N_CURVE_POINTS)
    found = most_likely_process(traces.T @ traces, traces.T @ residual, _roots())
    basis = _splines(grid, knots)
    explained = float(residual @ residual - np.sum((residual - traces @ found.mean) ** 2))
    return SmoothForce(
        axis=axis,
        gain=found.gain,
        at=grid,
        force=basis @ found.mean,
        sigma=np.linalg.norm(basis @ found.spread, axis=1),
        share=float(np.clip(explained / max(compressed.excess, explained, 1e-300), 0.0, 1.0)),
        traces=raw @ found.prior,
    )


@cache
def _roots() -> list[Array]:
    """Roots (m, m) of the covariance of the spline coefficients for every length ratio."""
    knots = _knots(0.0, 1.0)
    centres = np.array([knots[i + 1 : i + SPLINE_DEGREE + 1].mean() for i in range(N_SPLINES)])
    return [matern_root(centres, length) for length in LENGTH_RATIOS.tolist()]
