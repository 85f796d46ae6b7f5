"""Summarise a model fitted to measured friction: curves, errors in newtons, one row per run, remarks on the noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from frictrack.fit.least_squares import PieceResponse, Solution
from frictrack.fit.measured_friction.noise import FrictionNoise
from frictrack.fit.measured_friction.problem import MeasuredFrictionPiece
from frictrack.fit.measured_friction.solve import correlated_frames
from frictrack.records import Array, Curve, Run

MIN_RANK_CORRELATION = 0.99  # rank correlation with time from which a series counts as monotonic
MIN_DRIFT_RATIO = 1.5  # ratio to the white noise from which slow misfit is reported
# not defined without mass and film
DISPLACEMENT_ERRORS = ("rms_displacement_um", "rms_acceleration", "sse_acceleration")


def curves(solution: Solution, runs: Sequence[Run], role: str) -> tuple[Curve, ...]:
    """Create the curves of model and measurement at the compared frames of every run.

    Their x, v and a are the measured motion.
    """
    return tuple(_curve(solution, r, runs[r.piece.run], role) for r in solution.responses)


def _curve(solution: Solution, response: PieceResponse, run: Run, role: str) -> Curve:
    piece, model = response.piece, solution.problem.model
    values, level = solution.problem.layout.values(solution.p, piece.run)
    path = piece.path_at_nodes(piece.path.x, piece.path.v, level)
    parts = {
        name: np.asarray(block @ model.coefficients(name, values))[piece.at]
        for name, block in model.force_columns(path, values).items()
    }
    rows = piece.frames
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


def errors_of(responses: Sequence[PieceResponse]) -> dict[str, Any]:
    """Compute the errors of a fit over some runs, in N. Errors that need a modelled displacement are None."""
    left = np.concatenate([r.piece.y - r.model_y for r in responses])
    force = np.concatenate([r.piece.y for r in responses])
    return dict.fromkeys(DISPLACEMENT_ERRORS) | {
        "rms_N": _rms(left),
        "noise_N": white_noise(responses),
        "relative_force_error": float(np.linalg.norm(left) / max(float(np.linalg.norm(force)), 1e-30)),
    }


def white_noise(responses: Sequence[PieceResponse]) -> float:
    """Compute the rms white noise of the load cell, N."""
    return _rms(np.concatenate([r.piece.sigma for r in responses]))


def run_summary(solution: Solution, index: int, run: Run, role: str) -> dict[str, Any]:
    """Summarise one run as JSON: level, noise, correlation time of the residual, errors."""
    response = next(r for r in solution.responses if r.piece.run == index)
    _, level = solution.problem.layout.values(solution.p, index)
    interval = float(np.median(np.diff(run.motion.t)))
    return {
        "run": run.name,
        "role": role,
        "level": level,
        "noise_um": None,
        "noise_N": white_noise([response]),
        "correlated_s": correlated_frames(response.r) * interval,
        "segments": 1,
        "segment_s": float(response.piece.t[-1] - response.piece.t[0]),
        "errors": errors_of([response]),
    }


def remarks(solution: Solution, runs: Sequence[Run], noise: FrictionNoise) -> list[str]:
    """State what a diagnosis of measured friction is based on: its noise, and what a drifting sensor would explain.

    Parameters
    ----------
    solution : Solution
        The fit.
    runs : sequence of Run
        The runs.
    noise : FrictionNoise
        The noise.

    Returns
    -------
    list of str
        Sentences for the report.

    """
    out = ["friction itself was measured: all tests work on that series, and no fault of a picture is a candidate"]
    if all(_goes_one_way(r) for r in solution.responses):
        out.append(
            "place, time and speed rise together in these records: what goes with one of them may go with another; a "
            "record at another speed, or one that slows down again, tells them apart"
        )
    left = _rms(np.concatenate([r.r * r.piece.sigma for r in solution.responses]))
    if noise.stroke_count and noise.correlation_frames > 1:
        interval = max(float(np.median(np.diff(run.motion.t))) for run in runs)
        out.append(
            f"noise {noise.rms:.2g} N rms, correlated over {noise.correlation_frames * interval:.2g} s: the part that "
            f"does not repeat between {noise.stroke_count} strokes over the same positions "
            f"(white noise {noise.white:.2g} N)"
        )
    elif not noise.stroke_count and left > MIN_DRIFT_RATIO * noise.white:
        slow = float(np.sqrt(left**2 - noise.white**2))
        out.append(
            f"noise {noise.white:.2g} N rms from frame to frame; no stroke is repeated, so slow misfit counts as "
            f"misfit: a drifting sensor would have to explain {slow:.2g} N rms, {100 * (slow / left) ** 2:.1f} % of "
            'it; repeat the run, or state the instrument: noise = "0.004 N", drift = "0.01 N"'
        )
    return out


def _goes_one_way(response: PieceResponse) -> bool:
    """Whether position and speed of a record rise or fall with time throughout, apart from noise."""
    piece = response.piece
    rows = piece.at if isinstance(piece, MeasuredFrictionPiece) else slice(None)
    series = piece.path.x[rows], np.abs(piece.path.v[rows])
    return all(abs(_rank_correlation(piece.t, q)) > MIN_RANK_CORRELATION for q in series if np.ptp(q) > 0)


def _rank_correlation(a: Array, b: Array) -> float:
    """Spearman's rank correlation of two series (n,)."""
    return float(np.corrcoef(_ranks(a), _ranks(b))[0, 1])


def _ranks(values: Array) -> Array:
    """Ranks (n,) of values; equal values share their mean rank."""
    _, position, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - (counts - 1) / 2)[position])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
