"""The observation of a measured friction force, and its noise, estimated independently of the model that is tested.

The white part comes from the series itself (fifth differences). A slow part counts as noise only where it is known
not to be friction: from the differences between repeated strokes over the same positions, from the specification of
the instrument, or where its correlation between neighbouring samples is seen at frequencies above those of any
friction, as behind the filter of an amplifier. Else, with one record and no repeat, slow misfit counts as misfit.

Correlated frames repeat the same information, so every frame has the weight of one over the integrated correlation
time. Of long series every short block is one frame.

The misfit of a model is mostly far above the white noise and correlated between frames. So the covariance of a fit
comes from the scatter of blocks of frames that are longer than this correlation.

References
----------
Sokal, A. (1997). Monte Carlo methods in statistical mechanics. Functional Integration, NATO ASI 361, 131-192.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictrack.fit.least_squares import PieceResponse, Solution, hold, refine
from frictrack.fit.least_squares.solution import clustered_covariance, covariance_of
from frictrack.fit.observations.displacement import Observation
from frictrack.fit.observations.load_cell import MeasuredFrictionPiece, block_starts
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.pieces import Rows
from frictrack.fit.routes import FittedRuns
from frictrack.fit.smooth_functions import correlated_frames, correlation_time_frames, rms
from frictrack.fit.uncertainty import linear_estimates
from frictrack.fit.uncertainty.estimates import Estimates, Misfit, misfit_of
from frictrack.records import Array, Curve, Run

FRAMES_PER_CORRELATION = 4  # frames kept per correlation time
MAX_FRAMES = 3000  # of longer series every block is one frame
MIN_STROKES = 3  # strokes over the same positions
MIN_SHARE = 0.5  # shortest comparable stroke over the longest one
MIN_REVERSAL_SHARE = 0.25  # smallest reversal over the range of the coordinate
MAX_SPEED_DIFFERENCE = 0.1  # relative difference of the median speeds of strokes that are compared
STROKE_END_SHARE = 0.005  # share left out at either end, next to the reversals
STROKE_POINTS = 128  # positions at which strokes are compared
MIN_DRIFT_SHARE = 0.8  # of what strokes do not repeat, that changes steadily with time: nearly all
MIN_RANK_CORRELATION = 0.99  # rank correlation with time from which a series counts as monotonic
MIN_DRIFT_RATIO = 1.5  # ratio to the white noise from which slow misfit is reported
# not defined without mass and film
DISPLACEMENT_ERRORS = ("rms_displacement_um", "rms_acceleration", "sse_acceleration")
MIN_SLOW_NOISE_RATIO = 1.3  # ratio to the white noise; means of few strokes scatter as well


@dataclass(frozen=True)
class FrictionNoise:
    """The noise of a measured friction force."""

    rms: float  # all noise, N
    correlation_frames: float  # integrated correlation time
    white: float  # part that is independent from frame to frame, N
    stroke_count: int = 0  # repeated strokes from which the slow part is known; 0 if it is not


def weight_by_noise(solution: Solution) -> tuple[Solution, FrictionNoise]:
    """Return the same unknowns over frames weighted by the noise of the measurement, and that noise.

    Of correlated frames only some are kept; of a long series every block is one frame. The noise is always that of all
    frames: a model that was refined on few of them is first refined on all.
    """
    if solution.problem.is_of_points:
        return solution, friction_noise(solution)
    solution = _over_all_frames(solution)
    noise = friction_noise(solution)
    stride = max(int(noise.correlation_frames / FRAMES_PER_CORRELATION), 1)
    block = -(-solution.problem.n_frames // MAX_FRAMES)
    step = max(stride, block)
    sigma = noise.rms * float(np.sqrt(max(noise.correlation_frames, 1.0) / step))
    pieces = [_fewer_frames(r, stride, block) for r in solution.responses]
    ready = [replace(p, sigma=np.full(len(p.t), sigma)) for p in pieces]
    problem = solution.problem.rebuild(_at_rate(solution.problem.layout, 1 / step), ready)
    return hold(problem, solution.p, solution.starts, solution.tau), noise


def _at_rate(layout: ParameterLayout, factor: float) -> ParameterLayout:
    """The same layout at another frame rate: lines above it are excluded."""
    return replace(layout, spans=tuple(replace(s, fps=s.fps * factor) for s in layout.spans))


def _over_all_frames(solution: Solution) -> Solution:
    """The same model refined on all frames, where only some of them were kept."""
    kept = [p for p in solution.problem.pieces if isinstance(p, MeasuredFrictionPiece) and p.whole is not None]
    if not kept:
        return solution
    layout = _at_rate(solution.problem.layout, kept[0].every)
    problem = solution.problem.rebuild(layout, [p.whole for p in kept if p.whole is not None])
    return refine(problem, solution.p, solution.starts, tau=solution.tau)


def friction_noise(solution: Solution) -> FrictionNoise:
    """Estimate the noise of all runs: the white part, or the part that does not repeat between strokes if larger."""
    white = rms(np.concatenate([r.piece.sigma for r in solution.responses]))
    if solution.problem.is_of_points:
        return FrictionNoise(white, 1.0, white)
    found = [d for r in solution.responses for d in _stroke_differences(r)]
    differences, count = [d for d, _ in found], sum(n for _, n in found)
    if not found or (slow := rms(np.concatenate(differences))) < MIN_SLOW_NOISE_RATIO * white:
        return FrictionNoise(white, _cell_correlation(solution), white, count)
    return FrictionNoise(slow, max(correlation_time_frames(d) for d in differences), white, count)


def _cell_correlation(solution: Solution) -> float:
    """Integrated correlation time of the noise of the load cell, in frames; 1 where it is white."""
    return max(p.correlation for p in solution.problem.pieces if isinstance(p, MeasuredFrictionPiece))


def _stroke_differences(response: PieceResponse) -> Iterator[tuple[Array, int]]:
    """Yield, for every group of comparable strokes, the residual that does not repeat, and the number of strokes."""
    piece, residual = response.piece, response.r * response.piece.sigma
    x, v = piece.path.x[piece.at], np.abs(piece.path.v[piece.at])
    coordinate = x if len(strokes(x)) > 1 else v  # where the motion reverses, strokes of speed differ in place
    for group in _comparable_strokes(strokes(coordinate), coordinate, v):
        left, later = (_unrepeated(group, coordinate, series) for series in (residual, piece.t))
        drift = later * (left @ later) / (later @ later)
        # a drift of the cell, or of friction, is no noise
        yield left - drift if drift @ drift > MIN_DRIFT_SHARE * (left @ left) else left, len(group)


def strokes(coordinate: Array) -> list[Rows]:
    """Return the rows of every stroke of one direction of a coordinate (n,).

    Reversals below a quarter of its range are ignored.

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
        same = [s for s in long if np.sign(coordinate[s[-1]] - coordinate[s[0]]) == direction]
        speeds = np.array([np.median(speed[s]) for s in same])
        usual = np.median(speeds) if same else 0.0
        similar = [same[k] for k in np.flatnonzero(np.abs(speeds - usual) <= MAX_SPEED_DIFFERENCE * usual)]
        if len(similar) >= MIN_STROKES:
            yield similar


def _unrepeated(group: Sequence[Rows], coordinate: Array, series: Array) -> Array:
    """A series minus its mean over all strokes at the same position, without bias, in order of time."""
    low = max(float(coordinate[s].min()) for s in group)
    high = min(float(coordinate[s].max()) for s in group)
    low, high = low + STROKE_END_SHARE * (high - low), high - STROKE_END_SHARE * (high - low)
    at = np.linspace(low, high, STROKE_POINTS)
    rising = [s[np.argsort(coordinate[s])] for s in group]
    mean = np.mean([np.interp(at, coordinate[s], series[s]) for s in rising], axis=0)
    unbiased = float(np.sqrt(len(group) / (len(group) - 1)))
    inside = [s[(coordinate[s] >= low) & (coordinate[s] <= high)] for s in group]
    return np.concatenate([unbiased * (series[s] - np.interp(coordinate[s], at, mean)) for s in inside])


def _fewer_frames(response: PieceResponse, stride: int, block: int) -> MeasuredFrictionPiece:
    """Every few of the frames of a piece; of a long series one for every block of neighbours of one direction."""
    piece = response.piece
    assert isinstance(piece, MeasuredFrictionPiece)
    if stride >= block:  # frames between repeat them, and those at a reversal must stay
        return piece if stride == 1 else piece.at_frames_kept(np.arange(0, len(piece.t), stride), stride)
    # The model is evaluated at the middle frame alone, and differs there from its mean by its curvature. So not the
    # friction is averaged but its residual.
    n = len(piece.t) // block * block
    gaps = np.diff(piece.frames[:n].reshape(-1, block), axis=1)
    direction = piece.path.s[piece.at[:n]].reshape(-1, block)
    kept = np.all(gaps < 2 * np.median(gaps), axis=1) & (np.ptp(direction, axis=1) == 0)
    middle = (np.arange(len(gaps)) * block + block // 2)[kept]
    residual = (piece.y - response.model_y)[:n].reshape(-1, block)[kept].mean(axis=1)
    return replace(piece.at_frames_kept(middle, block), y=response.model_y[middle] + residual)


def friction_remarks(solution: Solution, runs: Sequence[Run]) -> list[str]:
    """State what a diagnosis of measured friction is based on: its noise, and what a drifting sensor would explain."""
    noise = weight_by_noise(solution)[1]
    if solution.problem.is_of_points:
        return _remarks_on_points(solution, noise.rms)
    out = ["friction itself was measured: all tests work on that series, and no fault of a picture is a candidate"]
    if all(_goes_one_way(r) for r in solution.responses):
        out.append(
            "place, time and speed rise together in these records: what goes with one of them may go with another; a "
            "record at another speed, or one that slows down again, tells them apart"
        )
    left = rms(np.concatenate([r.r * r.piece.sigma for r in solution.responses]))
    if noise.stroke_count and noise.correlation_frames > 1:
        interval = max(float(np.median(np.diff(run.motion.t))) for run in runs)
        out.append(
            f"noise {noise.rms:.2g} N rms, correlated over {noise.correlation_frames * interval:.2g} s: the part that "
            f"does not repeat between {noise.stroke_count} strokes over the same positions "
            f"(white noise {noise.white:.2g} N)"
        )
    elif noise.correlation_frames > 1:
        interval = max(float(np.median(np.diff(run.motion.t))) for run in runs)
        out.append(
            f"noise {noise.rms:.2g} N rms, correlated over {noise.correlation_frames * interval:.2g} s as behind the "
            "filter of an amplifier"
        )
    elif not noise.stroke_count and left > MIN_DRIFT_RATIO * noise.white:
        slow = float(np.sqrt(left**2 - noise.white**2))
        out.append(
            f"noise {noise.white:.2g} N rms from frame to frame; no stroke is repeated, so slow misfit counts as "
            f"misfit: a drifting sensor would have to explain {slow:.2g} N rms, {100 * (slow / left) ** 2:.1f} % of "
            'it; repeat the run, or state the instrument: noise = "0.004 N", drift = "0.01 N"'
        )
    return out


def _remarks_on_points(solution: Solution, noise: float) -> list[str]:
    """State what a diagnosis of points (v, F) can find, and from what their noise is known."""
    pieces = [p for p in solution.problem.pieces if isinstance(p, MeasuredFrictionPiece)]
    known = [p.points for p in pieces if p.points is not None]
    sources = " and ".join(dict.fromkeys(one.source for one in known))
    remedy = "; repeated speeds, or stated deviations, would tell a failing law from noise with certainty"
    return [
        "points (v, F) at constant speeds: only the law over the speed is tested, nothing that needs time, place or "
        "the motion before",
        f"noise {noise:.2g} N rms: {sources}{'' if all(one.stated or one.repeats for one in known) else remedy}",
    ]


def _goes_one_way(response: PieceResponse) -> bool:
    """Whether position and speed of a record rise or fall with time throughout, apart from noise."""
    piece = response.piece
    series = piece.path.x[piece.at], np.abs(piece.path.v[piece.at])
    return all(abs(_rank_correlation(piece.t, q)) > MIN_RANK_CORRELATION for q in series if np.ptp(q) > 0)


def _rank_correlation(a: Array, b: Array) -> float:
    """Spearman's rank correlation of two series (n,)."""
    return float(np.corrcoef(_ranks(a), _ranks(b))[0, 1])


def _ranks(values: Array) -> Array:
    """Ranks (n,) of values; equal values share their mean rank."""
    _, position, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - (counts - 1) / 2)[position])


def block_covariance(solution: Solution) -> Array:
    """Compute the covariance (P, P) of the unknowns from the scatter of blocks; that of white noise if it is white."""
    white_noise, _ = covariance_of(solution)
    if solution.problem.is_of_points:
        degrees = max(solution.problem.n_frames - len(solution.p), 1)
        return white_noise * max(solution.chi2 / degrees, 1.0)
    if all(correlated_frames(r.r) == 0 for r in solution.responses):
        return white_noise
    blocks = block_starts(solution.responses, len(solution.p))
    gradients = [np.add.reduceat(r.jac * r.r[:, None], at) for r, at in zip(solution.responses, blocks, strict=True)]
    found = clustered_covariance(solution, white_noise, solution.stacked(gradients))
    if _cell_correlation(solution) == 1:
        return found
    # few blocks scatter: never less than by the noise that is known
    known, _ = covariance_of(weight_by_noise(solution)[0])
    scale = np.maximum(np.sqrt(np.diag(known) / np.maximum(np.diag(found), 1e-300)), 1.0)
    return found * scale[:, None] * scale


class FrictionObservation(Observation):
    """Residuals of a measured friction force."""

    unit, metres_or_newtons = "N", 1.0

    def estimates(self, fitted: FittedRuns) -> Estimates:
        """Return the parameters; their standard deviations come from blocks of the residual, which is correlated."""
        return self.estimates_of_candidate(fitted.solution)

    def estimates_of_candidate(self, solution: Solution) -> Estimates:
        """Return the parameters of a model on trial in the same way."""
        return linear_estimates(solution, block_covariance(solution))

    def misfit(self, fitted: FittedRuns) -> Misfit | None:
        """Return the force that the model misses; that of points (v, F) is in their scatter about the law."""
        solution = fitted.solution
        if solution.problem.is_of_points:
            return None
        return misfit_of(self.weighted(solution) if _cell_correlation(solution) > 1 else solution)

    def noise(self, solution: Solution, reduced_chi2: float) -> tuple[float, float]:
        """Return the noise of a sample, N, and the reduced chi-squared against it."""
        noise = weight_by_noise(solution)[1].rms
        residual = np.concatenate([r.piece.coloured(r.r) for r in solution.responses])
        return noise, float(np.sum(residual**2) / noise**2 / max(len(residual) - len(solution.p), 1))

    def weighted(self, solution: Solution) -> Solution:
        """Return the solution with its residuals weighted by the noise that differs between strokes."""
        return weight_by_noise(solution)[0]

    def remarks(self, fitted: FittedRuns) -> list[str]:
        """Return what the noise is, and what a drifting sensor would explain."""
        return friction_remarks(fitted.solution, fitted.runs)

    def curve(self, solution: Solution, response: PieceResponse, run: Run, role: str) -> Curve:
        """Return measured and modelled friction at the compared frames of a run; its motion is the measured one."""
        piece, model, rows = response.piece, solution.problem.model, response.piece.frames
        values, level = solution.problem.layout.values(solution.p, piece.run)
        path = piece.path_at_nodes(piece.path.x, piece.path.v, level)
        parts = {
            name: np.asarray(block @ model.coefficients(name, values))[piece.at]
            for name, block in model.force_columns(path, values).items()
        }
        return Curve(
            t=run.motion.t[rows],
            x=run.motion.x[rows],
            sigma_x=run.motion.sigma_x[rows],
            x_model=run.motion.x[rows],
            v_model=run.motion.v[rows],
            a_model=run.motion.a[rows],
            F_model=response.model_y,
            run=run.name,
            role=role,
            parts=parts,
        )

    def errors(self, fits: Sequence[FittedRuns], curves: Sequence[Curve]) -> dict[str, Any]:
        """Return the errors in N; those of a displacement are null."""
        return _errors_of([r for fitted in fits for r in fitted.solution.responses])

    def row(self, solution: Solution, index: int, run: Run, role: str, curves: Sequence[Curve]) -> dict[str, Any]:
        """Return level, noise, correlation time of the residual, and errors of one run."""
        response = next(r for r in solution.responses if r.piece.run == index)
        errors = _errors_of([response])
        return {
            "run": run.name,
            "role": role,
            "level": solution.problem.layout.values(solution.p, index)[1],
            "noise_um": None,
            "noise_N": errors["noise_N"],
            "correlated_s": correlated_frames(response.r) * float(np.median(np.diff(run.motion.t))),
            "segments": 1,
            "segment_s": float(response.piece.t[-1] - response.piece.t[0]),
            "errors": errors,
        }

    def knows_load(self, fitted: FittedRuns) -> bool:
        """Return True: a measured friction force comes with its load."""
        return True


def _errors_of(responses: Sequence[PieceResponse]) -> dict[str, Any]:
    """Errors of a fit over some runs, in N. Errors that need a modelled displacement are None."""
    left = np.concatenate([r.piece.y - r.model_y for r in responses])
    force = np.concatenate([r.piece.y for r in responses])
    return dict.fromkeys(DISPLACEMENT_ERRORS) | {
        "rms_N": rms(left),
        "noise_N": rms(np.concatenate([r.piece.sigma for r in responses])),
        "relative_force_error": float(np.linalg.norm(left) / max(float(np.linalg.norm(force)), 1e-30)),
    }
