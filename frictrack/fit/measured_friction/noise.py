"""Estimate the noise of a measured friction force independently of the model that is tested.

The white part comes from the series itself (fifth differences). A slow part counts as noise only where it is known
not to be friction: from the differences between repeated strokes over the same positions, or from the specification
of the instrument. With one record and no repeat, slow misfit counts as misfit.

Correlated frames repeat the same information, so every frame has the weight of one over the integrated correlation
time. Of long series every short block is one frame.

References
----------
Sokal, A. (1997). Monte Carlo methods in statistical mechanics. Functional Integration, NATO ASI 361, 131-192.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.fit.least_squares import PieceResponse, Solution, refine
from frictrack.fit.measured_friction.problem import MeasuredFrictionPiece
from frictrack.fit.pieces import Piece, Rows
from frictrack.fit.smooth_functions import correlation_time_frames
from frictrack.records import Array

FRAMES_PER_CORRELATION = 4  # frames kept per correlation time
MAX_FRAMES = 3000  # of longer series every block is one frame
MIN_STROKES = 3  # strokes over the same positions
MIN_SHARE = 0.5  # shortest comparable stroke over the longest one
MIN_REVERSAL_SHARE = 0.25  # smallest reversal over the range of the coordinate
MAX_SPEED_DIFFERENCE = 0.1  # relative difference of the median speeds of strokes that are compared
STROKE_END_SHARE = 0.005  # share left out at either end, next to the reversals
STROKE_POINTS = 128  # positions at which strokes are compared
MIN_SLOW_NOISE_RATIO = 1.3  # ratio to the white noise; means of few strokes scatter as well


@dataclass(frozen=True)
class FrictionNoise:
    """The noise of a measured friction force.

    Attributes
    ----------
    rms : float
        All noise, N.
    correlation_frames : float
        Integrated correlation time, frames.
    white : float
        Part that is independent from frame to frame, N.
    stroke_count : int
        Number of repeated strokes from which the slow part is known; 0 if it is not.

    """

    rms: float
    correlation_frames: float
    white: float
    stroke_count: int = 0


def weight_by_noise(solution: Solution) -> tuple[Solution, FrictionNoise]:
    """Weight every frame by the noise of the measurement.

    Of correlated frames only some are kept; of long series every block is one frame. The noise is always that of all
    frames: a model that was refined on few of them is first refined on all.

    Parameters
    ----------
    solution : Solution
        The fit.

    Returns
    -------
    solution : Solution
        The same unknowns over the weighted frames.
    noise : FrictionNoise
        The noise.

    """
    solution = _over_all_frames(solution)
    noise = friction_noise(solution)
    stride = max(int(noise.correlation_frames / FRAMES_PER_CORRELATION), 1)
    block = -(-solution.problem.n_frames // MAX_FRAMES)
    reduce = _every_nth_frame if stride >= block else _averaged
    step = max(stride, block)
    pieces = [reduce(r, step) for r in solution.responses]
    return _refit_pieces(
        solution, pieces, noise.rms * float(np.sqrt(max(noise.correlation_frames, 1.0) / step)), step
    ), noise


def _over_all_frames(solution: Solution) -> Solution:
    """The same model refined on all frames, where only some of them were kept."""
    pieces = [p.whole if isinstance(p, MeasuredFrictionPiece) else None for p in solution.problem.pieces]
    whole = [p for p in pieces if p is not None]
    if not whole:
        return solution
    layout = solution.problem.layout
    steps = [p.every for p in solution.problem.pieces if isinstance(p, MeasuredFrictionPiece)]
    spans = tuple(replace(s, fps=s.fps * steps[0]) for s in layout.spans)
    problem = solution.problem.rebuild(replace(layout, spans=spans), whole)
    return refine(problem, solution.p, solution.starts, tau=solution.tau)


def friction_noise(solution: Solution) -> FrictionNoise:
    """Estimate the noise of all runs together.

    Parameters
    ----------
    solution : Solution
        The fit.

    Returns
    -------
    FrictionNoise
        The white part, or the part that does not repeat between strokes where that is larger.

    """
    white = float(np.sqrt(np.mean(np.concatenate([r.piece.sigma for r in solution.responses]) ** 2)))
    differences = [d for r in solution.responses for d in _stroke_differences(r.piece, r.r * r.piece.sigma)]
    if not differences:
        return FrictionNoise(white, 1.0, white)
    all_differences = np.concatenate([d for d, _ in differences])
    strokes = sum(n for _, n in differences)
    rms = float(np.sqrt(np.mean(all_differences**2)))
    if rms < MIN_SLOW_NOISE_RATIO * white:
        return FrictionNoise(white, 1.0, white, strokes)
    return FrictionNoise(rms, max(correlation_time_frames(d) for d, _ in differences), white, strokes)


def _stroke_differences(piece: Piece, residual: Array) -> Iterator[tuple[Array, int]]:
    """Yield, for every group of comparable strokes, the residual that does not repeat, and the number of strokes."""
    rows = piece.at if isinstance(piece, MeasuredFrictionPiece) else np.arange(len(piece.t))
    x, v = piece.path.x[rows], np.abs(piece.path.v[rows])
    for coordinate in (x, v):
        groups = list(_comparable_strokes(strokes(coordinate), coordinate, v))
        if groups:
            for group in groups:
                yield _unrepeated_residual(group, coordinate, residual), len(group)
            return


def strokes(coordinate: Array) -> list[Rows]:
    """Split a coordinate into strokes of one direction; reversals below a quarter of its range are ignored.

    Parameters
    ----------
    coordinate : array of shape (n,)
        Position or speed.

    Returns
    -------
    list of array of int
        Rows of every stroke.

    Examples
    --------
    >>> [len(s) for s in strokes(np.array([0.0, 1.0, 2.0, 1.9, 2.0, 1.0, 0.0]))]
    [2, 5]

    """
    min_reversal = MIN_REVERSAL_SHARE * float(np.ptp(coordinate))
    reversals, direction, extreme = [0], 0, 0
    for i in range(1, len(coordinate)):
        step = coordinate[i] - coordinate[extreme]
        if direction == 0 and abs(step) >= min_reversal > 0:
            direction = 1 if step > 0 else -1
            extreme = i
        elif direction * step > 0:
            extreme = i
        elif direction and -direction * step >= min_reversal:
            reversals.append(extreme)
            direction, extreme = -direction, i
    return [np.arange(a, b) for a, b in zip(reversals, [*reversals[1:], len(coordinate)], strict=True) if b - a > 1]


def _comparable_strokes(found: Sequence[Rows], coordinate: Array, speed: Array) -> Iterator[list[Rows]]:
    """Yield groups of at least `MIN_STROKES` strokes of one direction with similar length and speed."""
    length = max((float(np.ptp(coordinate[s])) for s in found), default=0.0)
    long = [s for s in found if np.ptp(coordinate[s]) >= MIN_SHARE * length > 0]
    for direction in (1.0, -1.0):
        same_direction = [s for s in long if np.sign(coordinate[s[-1]] - coordinate[s[0]]) == direction]
        if not same_direction:
            continue
        typical_speed = float(np.median([np.median(speed[s]) for s in same_direction]))
        similar = [
            s
            for s in same_direction
            if abs(np.median(speed[s]) - typical_speed) <= MAX_SPEED_DIFFERENCE * typical_speed
        ]
        if len(similar) >= MIN_STROKES:
            yield similar


def _unrepeated_residual(group: Sequence[Rows], coordinate: Array, residual: Array) -> Array:
    """A residual minus its mean over all strokes at the same position, without bias, in order of time."""
    low = max(float(coordinate[s].min()) for s in group)
    high = min(float(coordinate[s].max()) for s in group)
    low, high = low + STROKE_END_SHARE * (high - low), high - STROKE_END_SHARE * (high - low)
    at = np.linspace(low, high, STROKE_POINTS)
    each = [_interpolated_residual(coordinate[s], residual[s], at) for s in group]
    mean = np.mean(each, axis=0)
    unbiased = float(np.sqrt(len(group) / (len(group) - 1)))
    inside = [s[(coordinate[s] >= low) & (coordinate[s] <= high)] for s in group]
    return np.concatenate([unbiased * (residual[s] - np.interp(coordinate[s], at, mean)) for s in inside])


def _interpolated_residual(coordinate: Array, residual: Array, at: Array) -> Array:
    """A residual along a nearly monotonic coordinate, at positions (k,)."""
    order = np.argsort(coordinate)
    return np.interp(at, coordinate[order], residual[order])


def _refit_pieces(solution: Solution, pieces: Sequence[Piece], sigma: float, step: int) -> Solution:
    """The same unknowns over other frames of one noise, N. Lines above the new frame rate are excluded."""
    ready = [replace(p, sigma=np.full(len(p.t), sigma)) for p in pieces]
    layout = solution.problem.layout
    spans = tuple(replace(s, fps=s.fps / step) for s in layout.spans)
    problem = solution.problem.rebuild(replace(layout, spans=spans), ready)
    held = np.zeros(len(solution.p), dtype=bool)
    return refine(problem, solution.p, solution.starts, tau=solution.tau, free=held, max_steps=0)


def _every_nth_frame(response: PieceResponse, step: int) -> Piece:
    """Every few of the frames of a piece."""
    piece = _measured(response)
    return piece if step == 1 else piece.at_frames_kept(np.arange(0, len(piece.t), step), step)


def _averaged(response: PieceResponse, step: int) -> Piece:
    """One frame for every block of neighbouring frames of one direction: the middle one, with their mean residual.

    The model is evaluated at the middle frame alone, and differs there from its mean by its curvature. So not the
    friction is averaged but its residual.
    """
    piece = _measured(response)
    n = len(piece.t) // step * step
    frames = piece.frames[:n].reshape(-1, step)
    direction = piece.path.s[piece.at[:n]].reshape(-1, step)
    kept = (np.ptp(frames, axis=1) == step - 1) & (np.ptp(direction, axis=1) == 0)
    middle = (np.arange(len(frames)) * step + step // 2)[kept]
    residual = (piece.y - response.model_y)[:n].reshape(-1, step)[kept].mean(axis=1)
    return replace(piece.at_frames_kept(middle, step), y=response.model_y[middle] + residual)


def _measured(response: PieceResponse) -> MeasuredFrictionPiece:
    assert isinstance(response.piece, MeasuredFrictionPiece)
    return response.piece
