"""Estimate the force that a fitted model lacks along every run, with its standard deviation.

Local forces (Gaussian bumps), one wave over the place, or one sinusoid in time describe what they can; what they leave
of the residual is a smooth force of its own in every run (see `smooth_forces`). The part of a slow force that the model
can absorb is not determined by any run, and not in the band. Where neither a wave nor a sinusoid describes the force,
the curve is the one of least absolute value among those that differ by what the model can absorb: a local force stays
local, and a smooth one is centred.

References
----------
Bloomfield & Steiger (1983), Least Absolute Deviations.

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from frictrack.compare import LocalForces
from frictrack.diagnose.smooth_forces import ResidualForces, separate_curves
from frictrack.diagnose.waves import SpectralLine, WaveScan
from frictrack.effects import Path
from frictrack.fit.least_squares import PieceResponse, Solution, position_and_velocity
from frictrack.fit.observations import MeasuredFrictionPiece
from frictrack.records import Array

ALPHA = 0.01  # significance level of a wave
N_REWEIGHTED = 40  # steps of iteratively reweighted least squares
MIN_RELATIVE_FORCE = 1e-5  # of the largest force, below which all count alike
MIN_FREE_SCATTER = 2e-3  # relative scatter of the friction levels, above which the model may shift them

_Columns = Callable[[int, Path], Array]  # forces of known form along the path of piece i, N per unit of size, (m, k)


@dataclass(frozen=True)
class DeconvolvedForce:
    """The missing force along one piece, all (n,).

    Parameters
    ----------
    run
        Index of the run among the fitted ones.
    t, x, v, a
        Time since release s, and the motion in m, m/s, m/s^2.
    F, sigma_F
        Force and its standard deviation, N.
    load
        Mean normal load over that of the reference run.

    """

    run: int
    t: Array
    x: Array
    v: Array
    a: Array
    F: Array
    sigma_F: Array
    load: float = 1.0


def deconvolve_force(
    found: LocalForces, waves: WaveScan, forces: ResidualForces | None = None
) -> tuple[list[DeconvolvedForce], SpectralLine | None]:
    """Deconvolve the force that a fitted model lacks.

    Parameters
    ----------
    found
        The local forces in the residual of the fit.
    waves
        The scan for waves in that residual.
    forces
        Smooth forces in that residual, if they were computed before.

    Returns
    -------
    pieces : list of DeconvolvedForce
        The missing force of every piece.
    line : SpectralLine or None
        The sinusoid that defines the phase: the model's own vibration, else the strongest in the residual.

    """
    compressed = (forces or ResidualForces(found.solution, about_measurement=True)).compressed
    known_frequency = _vibration(found.solution)
    line = waves.line(known_frequency)
    wave = _wave_columns(found, waves, line if known_frequency is None else None)
    columns = wave or _bump_columns(found)
    traces = compressed.traces_of([columns(i, path) for i, path in enumerate(compressed.paths)])
    precision = np.zeros(traces.shape[1])
    if wave is None:
        precision[2::3] = 1.0  # a width that the runs do not determine is known within a factor of e
    covariance = np.linalg.pinv(traces.T @ traces + np.diag(precision), hermitian=True)
    sizes, curves = covariance @ (traces.T @ compressed.residual), separate_curves(compressed, traces)
    means, variances = [], []
    for i, (response, along) in enumerate(zip(found.law.responses, found.model.pieces, strict=True)):
        piece = response.piece
        form = columns(i, piece.at_frames(*position_and_velocity(response), along.path_level))
        mean, variance = curves.at(piece.run, piece.t)
        means.append(mean + form @ sizes)
        variances.append(variance + np.einsum("nk,kl,nl->n", form, covariance, form))
    if wave is None:
        means = _least_absolute(means, found.model.solution)
    pieces = zip(found.law.responses, means, variances, strict=True)
    return [_deconvolved_piece(response, mean, variance) for response, mean, variance in pieces], line


def _vibration(solution: Solution) -> float | None:
    """Frequency of the model's first vibration, Hz; None if it has none."""
    values, _ = solution.problem.layout.values(solution.p, solution.problem.pieces[0].run)
    return next((q["frequency"] for name, q in values.items() if name.startswith("vibration")), None)


def _wave_columns(found: LocalForces, waves: WaveScan, line: SpectralLine | None) -> _Columns | None:
    """The significant wave, over the place or in time, that explains more than the bumps do."""
    in_place, in_time = waves.in_place, None if line is None else waves.in_time
    gain_in_time = 0.0 if in_time is None else float(in_time.gains.max())
    if in_place is not None and in_place.p < ALPHA and in_place.gains.max() > max(found.explained, gain_in_time):
        frequency = float(in_place.f[in_place.best])

        def over_place(_: int, path: Path) -> Array:
            wave = _sine_cosine(frequency * path.x) * (path.load * path.s)[:, None]
            return np.hstack([wave, path.x[:, None] * wave])  # times x: a small change of frequency

        return over_place
    if line is not None and in_time is not None and in_time.p < ALPHA and gain_in_time > found.explained:
        runs, of = list(line.amplitudes), [r.piece.run for r in found.law.responses]
        return lambda i, path: np.kron(np.eye(len(runs))[runs.index(of[i])], _sine_cosine(line.frequency * path.t))
    return None


def _sine_cosine(turns: Array) -> Array:
    return np.column_stack([np.sin(2 * np.pi * turns), np.cos(2 * np.pi * turns)])


def _bump_columns(found: LocalForces) -> _Columns:
    """The bumps found: by size, relative to it by centre and by log width."""

    def columns(i: int, path: Path) -> Array:
        out = np.zeros((len(found.bumps), 3, len(path.t)))
        for k, bump in enumerate(found.bumps):
            if bump.acts_in(i):
                out[k] = bump.derivatives(path) * np.array([[1.0], [bump.size], [bump.size]])
        return out.reshape(-1, len(path.t)).T

    return columns


def _least_absolute(forces: list[Array], solution: Solution) -> list[Array]:
    """Subtract from forces (n,) per piece what the model can absorb, so that the sum of absolute values is least."""
    free = [slot.run is None or solution.tau > MIN_FREE_SCATTER for slot in solution.problem.layout.slots]
    columns = np.vstack([_force_sensitivities(solution, response)[:, free] for response in solution.responses])
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 0] / size[size > 0]
    force = np.concatenate(forces)
    left, floor = force, MIN_RELATIVE_FORCE * float(np.max(np.abs(force), initial=1e-12))
    for _ in range(N_REWEIGHTED):
        weighted = columns / np.sqrt(np.abs(left) + floor)[:, None]
        right = weighted.T @ (force / np.sqrt(np.abs(left) + floor))
        left = force - columns @ np.linalg.lstsq(weighted.T @ weighted, right, rcond=1e-8)[0]
    return np.split(left, np.cumsum([len(f) for f in forces])[:-1])


def _force_sensitivities(solution: Solution, response: PieceResponse) -> Array:
    """Friction force at the frames of a piece per unit of every unknown, N, (n, P)."""
    piece = response.piece
    at_nodes = -piece.mass * solution.problem.acceleration_sensitivities(piece, solution.p, response.motion)
    out = np.zeros((len(piece.t), len(solution.p)))
    out[:, response.active] = np.column_stack([np.interp(piece.t, piece.panels.t, column) for column in at_nodes.T])
    return out


def _deconvolved_piece(response: PieceResponse, mean: Array, variance: Array) -> DeconvolvedForce:
    piece = response.piece
    x, v = position_and_velocity(response)
    measured = isinstance(piece, MeasuredFrictionPiece)
    a = np.gradient(v, piece.t) if measured else np.interp(piece.t, piece.panels.t, response.motion.a)
    return DeconvolvedForce(piece.run, piece.t, x, v, a, mean, np.sqrt(variance), float(np.mean(piece.path.load)))
