"""Fit a measured friction force from scratch, and compute its covariance and held-out error.

The white noise of the load cell comes from fifth differences. The misfit of a model is mostly far above it and
correlated between frames. So the covariance comes from the scatter of blocks of frames that are longer than this
correlation, and blocks are held out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise, product

import numpy as np

from frictrack.distributions import student_ppf
from frictrack.errors import FrictrackError
from frictrack.fit.global_search import search_parameters, searched_scatter
from frictrack.fit.least_squares import (
    HIDDEN_SIGMA_FACTOR,
    Solution,
    covariance_of,
    fit_with_scatter,
    is_predictable,
    refine,
)
from frictrack.fit.measured_friction.problem import MeasuredFrictionProblem, friction_spans
from frictrack.fit.parameters import ParameterLayout, penalty_jacobian
from frictrack.fit.pieces import Piece
from frictrack.fit.separable import (
    DataBlock,
    PopulationMisfit,
    ProjectedProblem,
    ReducedPopulationMisfit,
    SeparableModel,
    SeparableSolution,
    path_at_compared,
    rows_at_compared,
    variable_projection,
)
from frictrack.models import Model
from frictrack.records import Array, Mask

MAX_GRID_STARTS = 3  # points of a grid that are refined
MAX_GRID_POINTS = 200  # grid points over the parameters of modifiers
BLOCK_CORRELATION_TIMES = 2.0  # block length over the correlation of the residual
MIN_BLOCKS = 8  # least number of blocks per run
MIN_BLOCKS_PER_UNKNOWN = 2  # least number of blocks per unknown
NORMAL_QUANTILE_975 = 1.96


def fit_measured_friction(model: Model, pieces: Sequence[Piece], names: tuple[str, ...], fps: float) -> Solution:
    """Fit a model from scratch: variable projection along the measured motion, then all unknowns together.

    Parameters
    ----------
    model : Model
        The model.
    pieces : sequence of Piece
        One `MeasuredFrictionPiece` per run.
    names : tuple of str
        Names of the runs.
    fps : float
        Frame rate, 1/s.

    Returns
    -------
    Solution
        The fit.

    Raises
    ------
    FrictrackError
        If the runs lack what an effect needs.

    """
    layout = _layout(model, pieces, names, fps)
    separable = SeparableModel(layout, [_block(p) for p in pieces])
    state = _refine_modifiers(ProjectedProblem(separable, separable.data), variable_projection(separable)())
    problem = MeasuredFrictionProblem(model, layout, pieces)
    return fit_with_scatter(problem, separable.law(state.nonlinear_values, state.coefficients), problem.first_starts())


def search_measured_friction(
    model: Model,
    pieces: Sequence[Piece],
    names_and_rate: tuple[tuple[str, ...], float],
    search_settings: tuple[str, str, np.random.Generator],
) -> tuple[Solution, tuple[Array, Array]]:
    """Fit a model by a global search, without further refinement.

    Parameters
    ----------
    model : Model
        The model.
    pieces : sequence of Piece
        One `MeasuredFrictionPiece` per run.
    names_and_rate : tuple of (tuple of str, float)
        Names of the runs, and the frame rate, 1/s.
    search_settings : tuple of (str, str, numpy.random.Generator)
        Method; what is searched, "all" or "nonlinear"; source of random numbers.

    Returns
    -------
    solution : Solution
        The best point.
    optima : tuple of (array of shape (k, P), array of shape (k,))
        The "group of feasible solutions" and their sums of squares, N^2.

    """
    (names, fps), (method, over, rng) = names_and_rate, search_settings
    layout = _layout(model, pieces, names, fps)
    kind = ReducedPopulationMisfit if over == "nonlinear" else PopulationMisfit
    misfit = kind(layout, [_block(p) for p in pieces], unit=float(pieces[0].sigma[0]) ** 2)
    optima, costs = search_parameters(misfit, method, rng, np.ones(len(layout.slots)))
    problem = MeasuredFrictionProblem(model, layout, pieces)
    penalty = np.zeros(len(layout.slots), dtype=bool)
    tau = searched_scatter(layout, optima[0])
    return refine(problem, optima[0], problem.first_starts(), tau=tau, free=penalty, max_steps=0), (optima, costs)


def _layout(model: Model, pieces: Sequence[Piece], names: tuple[str, ...], fps: float) -> ParameterLayout:
    """The layout of a model over these runs; FrictrackError if they lack what an effect needs."""
    lacking = [e.lacks([p.path for p in pieces]) for e in model.effects]
    if any(lacking):
        raise FrictrackError(next(filter(None, lacking)))
    return ParameterLayout(model, names, friction_spans(pieces, fps))


def _block(piece: Piece) -> DataBlock:
    """The compared frames of a run as data of the separable model."""
    weight = 1.0 / piece.sigma
    return DataBlock(
        run=piece.run,
        path=piece.path,
        data=piece.y * weight,
        forward=lambda rows: rows_at_compared(rows, piece.at) * weight,
        picture=lambda rows: np.zeros_like(rows_at_compared(rows, piece.at)),
        friction=-piece.a_hat / piece.path.load,
        compared_path=path_at_compared(piece, piece.path.x, piece.path.v, 1.0),
    )


def _refine_modifiers(problem: ProjectedProblem, state: SeparableSolution) -> SeparableSolution:
    """Search the parameters of modifiers without a coefficient, which no scan covers, over a coarse grid."""
    for g, group in enumerate(problem.separable.groups):
        if not any(e.modifies and not e.linear for e in group.model.effects):
            continue
        found = [
            problem.at(nonlinear_values, state, {g}) for nonlinear_values in _grid(problem, state.nonlinear_values, g)
        ]
        best = sorted(found, key=lambda s: s.misfit)[:MAX_GRID_STARTS]
        state = min((problem.refine(s) for s in [state, *best]), key=lambda s: s.misfit)
    return state


def _grid(problem: ProjectedProblem, nonlinear_values: Array, g: int) -> list[Array]:
    """Parameter vectors (P,) at the points of a coarse grid over the scanned parameters of a group."""
    layout = problem.layout
    scanned = {}
    for i in problem.separable.groups[g].nonlinear_slots:
        slot = layout.slots[i]
        parameter = next(e for e in layout.model.effects if e.name == slot.effect).parameter(slot.parameter)
        if parameter.scan is not None:
            scanned[i] = parameter.scan(layout.span if slot.run is None else layout.spans[slot.run])
    points_per_axis = max(int(MAX_GRID_POINTS ** (1 / max(len(scanned), 1))), 2)
    axes = [
        axis[np.linspace(0, len(axis) - 1, min(points_per_axis, len(axis))).round().astype(int)]
        for axis in scanned.values()
    ]
    out = []
    for point in product(*axes):
        out.append(nonlinear_values.copy())
        out[-1][list(scanned)] = point
    return out


def correlated_frames(r: Array) -> int:
    """Compute the lag at which the autocorrelation of a residual (n,) falls below 1/e, frames; 0 for white noise.

    Examples
    --------
    >>> correlated_frames(np.sin(np.linspace(0, 6, 100))) > 10
    True

    """
    n = len(r)
    if n < 8:
        return 0
    spectrum = np.abs(np.fft.rfft(r - r.mean(), 2 * n)) ** 2
    rho = np.fft.irfft(spectrum)[: n // 2]
    rho = rho / max(float(rho[0]), 1e-300)
    if rho[1] < 3.0 / np.sqrt(n):
        return 0
    below = np.flatnonzero(rho < np.exp(-1.0))
    return int(below[0]) if len(below) else n // 2


def blocks(solution: Solution) -> list[list[slice]]:
    """Cut every run into blocks of frames, longer than the correlation of the residual, enough for the unknowns.

    Parameters
    ----------
    solution : Solution
        The fit.

    Returns
    -------
    list of list of slice
        Blocks of every run.

    """
    min_blocks = max(MIN_BLOCKS, -(-MIN_BLOCKS_PER_UNKNOWN * len(solution.p) // len(solution.responses)))
    return [_blocks_of_frames(len(r.r), correlated_frames(r.r), min_blocks) for r in solution.responses]


def _blocks_of_frames(n: int, correlation: int, min_blocks: int) -> list[slice]:
    length = min(max(int(np.ceil(BLOCK_CORRELATION_TIMES * correlation)), 1), max(n // min_blocks, 1))
    edges = np.linspace(0, n, max(n // length, 1) + 1).round().astype(int)
    return [slice(int(a), int(b)) for a, b in pairwise(edges)]


def block_covariance(solution: Solution) -> Array:
    """Compute the covariance of the unknowns from the scatter of blocks (cluster-robust sandwich).

    For a white residual it is the covariance of white noise.

    Parameters
    ----------
    solution : Solution
        The fit.

    Returns
    -------
    array of shape (P, P)
        Covariance, widened to Student's t for the number of blocks.

    References
    ----------
    Liang, K.-Y. & Zeger, S. L. (1986). Longitudinal data analysis. Biometrika 73, 13-22.
    Huber, P. J. (1967). Proc. Fifth Berkeley Symposium 1, 221-233.
    White, H. (1980). Econometrica 48, 817-838.

    """
    white_noise, _ = covariance_of(solution)
    if all(correlated_frames(r.r) == 0 for r in solution.responses):
        return white_noise
    gradients = []
    for r, cut in zip(solution.responses, blocks(solution), strict=True):
        for rows in cut:
            gradients.append(np.zeros(len(solution.p)))
            gradients[-1][r.active] = r.jac[rows].T @ r.r[rows]
    count = len(gradients)
    widening = (student_ppf(0.975, count - 1) / NORMAL_QUANTILE_975) ** 2 * count / (count - 1)
    penalty = penalty_jacobian(solution.problem.layout, solution.tau or 0.03)
    block_gradients = np.array(gradients)
    return np.asarray(
        white_noise @ (widening * block_gradients.T @ block_gradients + penalty.T @ penalty) @ white_noise
    )


def heldout_rms(solution: Solution, by: str | None = None) -> tuple[float, str]:
    """Compute the root mean square of the held-out residual.

    By run: shared parameters come from the other runs, the run's own from its even blocks; its odd blocks are scored.
    Otherwise the even blocks of all runs are fitted and the odd ones scored.

    Parameters
    ----------
    solution : Solution
        The fit.
    by : {"run", "frames"}, optional
        What is held out. By default runs, wherever the other runs can predict every run.

    Returns
    -------
    rms : float
        Held-out error, N.
    by : str
        What was held out: "run" or "frames".

    """
    problem = solution.problem
    hidden = [_odd_blocks(len(r.r), cut) for r, cut in zip(solution.responses, blocks(solution), strict=True)]
    if by == "frames" or len(problem.pieces) < 2 or (by is None and not is_predictable(solution)):
        even_problem = problem.rebuild(
            problem.layout, [_with_hidden_frames(p, h) for p, h in zip(problem.pieces, hidden, strict=True)]
        )
        found = refine(even_problem, solution.p, solution.starts, tau=solution.tau or 0.03, max_steps=10)
        return _rms(found, hidden), "frames"
    squares = [_rms_left_out(solution, i, h) ** 2 for i, h in enumerate(hidden)]
    return float(np.sqrt(np.average(squares, weights=[np.sum(h) for h in hidden]))), "run"


def _rms_left_out(solution: Solution, i: int, hidden: Mask) -> float:
    """Root mean square residual, N, over the hidden frames of one run, predicted by the others."""
    problem, layout = solution.problem, solution.problem.layout
    piece = problem.pieces[i]
    own = np.array([s.run == piece.run for s in layout.slots])
    others = problem.rebuild(layout, [p for p in problem.pieces if p is not piece])
    names_and_rate = refine(
        others, solution.p, others.first_starts(), tau=solution.tau or 0.03, free=~own, max_steps=10
    )
    alone = problem.rebuild(replace(layout, levels_free=True), [_with_hidden_frames(piece, hidden)])
    return _rms(refine(alone, names_and_rate.p, alone.first_starts(), free=own, max_steps=10), [hidden])


def _odd_blocks(n: int, cut: Sequence[slice]) -> Mask:
    out = np.zeros(n, dtype=bool)
    for rows in cut[1::2]:
        out[rows] = True
    return out


def _with_hidden_frames(piece: Piece, hidden: Mask) -> Piece:
    return replace(piece, sigma=np.where(hidden, HIDDEN_SIGMA_FACTOR, 1.0) * piece.sigma)


def _rms(solution: Solution, hidden: Sequence[Mask]) -> float:
    left = [(r.piece.y - r.model_y)[h] for r, h in zip(solution.responses, hidden, strict=True)]
    return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))
