"""Deconvolve the missing force of a fitted model, with its standard deviation, from the residual displacement.

The force is a Gaussian process (Matern 3/2) through knots. Its trace in the displacement is computed like that of the
model's own forces; initial conditions, model parameters and friction levels are free beside it. Amplitude and
correlation length are averaged over with the restricted likelihood of all runs as weight, so that the band includes
their uncertainty. Significant local forces and waves are subtracted first, because the process would smear them. The
part of a slow force that the model can absorb is not determined by any run, and not in the band. Where neither a wave
nor a sinusoid describes the force, the curve is the one of least absolute value among those that differ by what the
model can absorb: a local force stays local, and a smooth one is centred.

References
----------
Bloomfield & Steiger (1983), Least Absolute Deviations.
Rasmussen & Williams (2006), Gaussian Processes for Machine Learning, ch. 2 and 5.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.compare.force_traces import ForceTraces, WaveScan
from frictrack.compare.local_forces import ALPHA, LocalForces, bump_forces
from frictrack.compare.spectral_lines import SpectralLine, line_at, strongest_line, strongest_spatial_wave
from frictrack.fit.least_squares import (
    ModelProjection,
    PieceResponse,
    Solution,
    position_and_velocity,
)
from frictrack.fit.observations import MeasuredFrictionPiece
from frictrack.fit.smooth_functions import linear_interpolation_matrix, matern_covariance
from frictrack.records import Array

MAX_KNOTS = 100  # per piece
MIN_KNOT_SPACING_FRAMES = 4.0  # frames between knots
N_CORRELATION_LENGTHS = 5  # from a few knots to a quarter of the longest piece
SIZE_RATIOS = np.geomspace(0.1, 3e4, 31)  # amplitudes over the smallest that the runs show
N_REWEIGHTED = 40  # steps of iteratively reweighted least squares
MIN_RELATIVE_FORCE = 1e-5  # of the largest force, below which all count alike
MIN_FREE_SCATTER = 2e-3  # relative scatter of the friction levels, above which the model may shift them
MIN_RELATIVE_WEIGHT = 0.01  # relative weight below which an amplitude and length are left out


@dataclass(frozen=True)
class DeconvolvedForce:
    """The missing force along one piece, all (n,).

    Parameters
    ----------
    run
        Index of the run among the fitted ones.
    t, x, v, a
        Time since release s, and the model's motion in m, m/s, m/s^2.
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


@dataclass(frozen=True)
class _Process:
    """A Gaussian process of one correlation length, in independent components per piece.

    `shape` (n, K) is their force at the frames, `squares` (K,) their squared traces, `law_components` (K, P') the inner
    products of their traces with the model's directions, `projections` (K,) those with the residual.
    """

    shape: list[Array]
    squares: list[Array]
    law_components: list[Array]
    projections: list[Array]

    def log_likelihood(self, size: float) -> float:
        """Log restricted likelihood of an amplitude, up to a constant."""
        variances_of_parts, normal_matrix, _, right_side = self._reduced_system(size)
        exponent = sum(float(b @ (k * b)) for k, b in zip(variances_of_parts, self.projections, strict=True))
        exponent += float(right_side @ np.linalg.solve(normal_matrix, right_side))
        spread = sum(float(np.sum(np.log1p(size**2 * s))) for s in self.squares) + float(
            np.linalg.slogdet(normal_matrix)[1]
        )
        return (exponent - spread) / 2

    def posterior_moments(self, sizes: Array, weights: Array) -> tuple[list[Array], list[Array]]:
        """First and second moments (n,) of the force, summed over amplitudes (S,) with their weights."""
        systems = [self._reduced_system(size) for size in sizes.tolist()]
        roots = [np.linalg.cholesky(inverse) for _, _, inverse, _ in systems]
        firsts, seconds = [], []
        for i, (shape, w, b) in enumerate(zip(self.shape, self.law_components, self.projections, strict=True)):
            means, spread, variances = [], [], np.zeros(len(b))
            for weight, (k, _, inverse, right_side), root in zip(weights, systems, roots, strict=True):
                means.append(k[i] * (b + w @ (inverse @ right_side)))
                spread.append(np.sqrt(weight) * k[i][:, None] * (w @ root))  # by the uncertainty of the model
                variances += weight * k[i]
            forces = shape @ np.column_stack([*means, *spread])
            mean, of_model = forces[:, : len(means)], forces[:, len(means) :]
            firsts.append(mean @ weights)
            seconds.append(shape**2 @ variances + mean**2 @ weights + np.einsum("nk,nk->n", of_model, of_model))
        return firsts, seconds

    def _reduced_system(self, size: float) -> tuple[list[Array], Array, Array, Array]:
        """Posterior variances (K,), reduced normal matrix of the model (P', P'), its inverse and right side (P',)."""
        variances_of_parts = [size**2 / (1 + size**2 * s) for s in self.squares]
        normal_matrix = np.eye(self.law_components[0].shape[1])
        right_side = np.zeros(len(normal_matrix))
        for k, w, b in zip(variances_of_parts, self.law_components, self.projections, strict=True):
            normal_matrix -= (w * k[:, None]).T @ w
            right_side += w.T @ (k * b)
        return variances_of_parts, normal_matrix, np.asarray(np.linalg.inv(normal_matrix), dtype=np.float64), right_side


def deconvolve_force(found: LocalForces, waves: WaveScan) -> tuple[list[DeconvolvedForce], SpectralLine | None]:
    """Deconvolve the force that a fitted model lacks.

    Parameters
    ----------
    found
        The local forces in the residual of the fit.
    waves
        Traces of the waves that are scanned for, along the motion of `found`.

    Returns
    -------
    pieces : list of DeconvolvedForce
        The missing force of every piece.
    line : SpectralLine or None
        The sinusoid that defines the phase: the model's own vibration, else the strongest in the residual.

    """
    known_frequency = _vibration(found.law.solution)
    line = strongest_line(found.law, waves.in_time) if known_frequency is None else line_at(found.law, known_frequency)
    explained = float(found.law.r @ found.law.r - found.residual.r @ found.residual.r)
    wave = strongest_spatial_wave(found.law, waves.in_place)
    if wave is not None and wave.p < ALPHA and wave.gain > max(explained, 0.0 if line is None else line.gain):
        residual = found.law.with_columns(wave.columns)
        means, variances = _model_averaged_force(residual, found.dictionary.maps)
        means = [m + f for m, f in zip(means, wave.force, strict=True)]
        extra_variances = wave.variance
    elif line is not None and known_frequency is None and line.p < ALPHA and line.gain > explained:
        found = replace(found, bumps=[], residual=found.law.with_columns(line.columns))
        means, variances = _model_averaged_force(found.residual, found.dictionary.maps)
        forces = [line.force(r.piece.run, r.piece.t) for r in found.residual.responses]
        spread = [np.full_like(f, np.mean(f**2) / max(line.gain / (2 * len(forces)), 1.0)) for f in forces]
        means = [m + f for m, f in zip(means, forces, strict=True)]
        variances = [v + s for v, s in zip(variances, spread, strict=True)]
        extra_variances = [np.zeros_like(f) for f in forces]
    else:
        means, variances = _model_averaged_force(found.residual, found.dictionary.maps)
        forces, extra_variances = bump_forces(found)
        means = _least_absolute([m + f for m, f in zip(means, forces, strict=True)], found.law.solution)
    pieces = zip(found.residual.responses, means, variances, extra_variances, strict=True)
    return [_deconvolved_piece(response, mean, variance + band) for response, mean, variance, band in pieces], line


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
        gram = weighted.T @ weighted
        right = weighted.T @ (force / np.sqrt(np.abs(left) + floor))
        left = force - columns @ np.linalg.lstsq(gram, right, rcond=1e-8)[0]
    return np.split(left, np.cumsum([len(f) for f in forces])[:-1])


def _force_sensitivities(solution: Solution, response: PieceResponse) -> Array:
    """Friction force at the frames of a piece per unit of every unknown, N, (n, P)."""
    piece, problem = response.piece, solution.problem
    at_nodes = -piece.mass * problem.acceleration_sensitivities(piece, solution.p, response.motion)
    out = np.zeros((len(piece.t), len(solution.p)))
    for k, column in zip(response.active, at_nodes.T, strict=True):
        out[:, k] = np.interp(piece.t, piece.panels.t, column)
    return out


def _vibration(solution: Solution) -> float | None:
    """Frequency of the model's first vibration, Hz; None if it has none."""
    values, _ = solution.problem.layout.values(solution.p, solution.problem.pieces[0].run)
    return next((q["frequency"] for name, q in values.items() if name.startswith("vibration")), None)


def _model_averaged_force(law: ModelProjection, maps: Sequence[ForceTraces]) -> tuple[list[Array], list[Array]]:
    """Means and variances of the force, averaged over amplitudes and correlation lengths by their likelihood."""
    knots = [_knots(r) for r in law.responses]
    products = [_normal_products(law, rows, m, k) for rows, m, k in zip(law.rows, maps, knots, strict=True)]
    step = max(float(k[1] - k[0]) for k in knots)
    longest = max(float(k[-1] - k[0]) for k in knots)
    lengths = np.geomspace(2 * step, max(longest / 4, 3 * step), N_CORRELATION_LENGTHS)
    processes = [_make_process(law, knots, products, float(length)) for length in lengths]
    tops = np.array([max(float(s.max()) for s in process.squares) for process in processes])
    sizes = SIZE_RATIOS / np.sqrt(np.maximum(tops, 1e-300))[:, None]
    likelihood = np.array([[p.log_likelihood(size) for size in own] for p, own in zip(processes, sizes, strict=True)])
    weight = np.exp(likelihood - likelihood.max())
    weight[weight < MIN_RELATIVE_WEIGHT] = 0.0
    weight /= weight.sum()
    kept = [(p, s[w > 0], w[w > 0]) for p, s, w in zip(processes, sizes, weight, strict=True) if w.any()]
    moments = [process.posterior_moments(*of) for process, *of in kept]
    means, squares = (
        [np.asarray(np.sum(of_piece, axis=0)) for of_piece in zip(*of_lengths, strict=True)]
        for of_lengths in zip(*moments, strict=True)
    )
    return means, [np.maximum(q - m**2, 0.0) for q, m in zip(squares, means, strict=True)]


def _knots(response: PieceResponse) -> Array:
    t = response.piece.t
    step = float(np.median(np.diff(t)))
    count = int(np.clip((t[-1] - t[0]) / (MIN_KNOT_SPACING_FRAMES * step), 3, MAX_KNOTS))
    return np.linspace(t[0], t[-1], count)


def _normal_products(law: ModelProjection, rows: slice, traces: ForceTraces, knots: Array) -> tuple[Array, ...]:
    """Gram matrix (K, K) of a force through knots, and its products with model (K, P') and residual (K,)."""
    own = traces(linear_interpolation_matrix(traces.t, knots).T)
    return own @ own.T, own @ law.u[rows], own @ law.r[rows]


def _make_process(
    law: ModelProjection, knots: Sequence[Array], products: Sequence[tuple[Array, ...]], length: float
) -> _Process:
    shape, squares, law_components, projections = [], [], [], []
    for response, at, (gram, w, b) in zip(law.responses, knots, products, strict=True):
        root = np.linalg.cholesky(matern_covariance(at, length) + 1e-10 * np.eye(len(at)))
        value, vector = np.linalg.eigh(root.T @ gram @ root)
        part = root @ vector
        shape.append(linear_interpolation_matrix(response.piece.t, at) @ part)
        squares.append(np.maximum(value, 0.0))
        law_components.append(part.T @ w)
        projections.append(part.T @ b)
    return _Process(shape, squares, law_components, projections)


def _deconvolved_piece(response: PieceResponse, mean: Array, variance: Array) -> DeconvolvedForce:
    x, v = position_and_velocity(response)
    a = _acceleration(response, v)
    load = float(np.mean(response.piece.path.load))
    return DeconvolvedForce(response.piece.run, response.piece.t, x, v, a, mean, np.sqrt(variance), load)


def _acceleration(response: PieceResponse, v: Array) -> Array:
    """Acceleration of the model's motion at the frames, m/s^2."""
    piece = response.piece
    if isinstance(piece, MeasuredFrictionPiece):
        return np.gradient(v, piece.t)
    return np.interp(piece.t, piece.panels.t, response.motion.a)
