"""Find sinusoidal forces in the residual: in time with amplitude and phase per run, or in place, common to all runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from frictrack.compare.bumps import NodeMotion, motion_at_nodes
from frictrack.compare.force_traces import WaveTraces, pair_products, visible_part
from frictrack.distributions import chi2_sf
from frictrack.fit.least_squares import ModelProjection, displacement_response
from frictrack.fit.linearised import Float32Array
from frictrack.records import Array

MAX_REFINEMENT_STEPS = 12  # of a frequency between two scanned ones


@dataclass(frozen=True)
class SpectralLine:
    """A sinusoidal force of one frequency in time.

    Parameters
    ----------
    frequency
        Frequency, Hz.
    waves
        Sine and cosine amplitude per run, N, (2,).
    gain
        Fall of chi-squared.
    p
        p-value, corrected for the number of frequencies scanned.
    columns
        Traces over all frames, (N + m, 2 R).

    """

    frequency: float
    sine_cosine_columns: dict[int, Array]
    gain: float
    p: float
    columns: Array  # its traces over all frames, (N + m, 2 R)

    def force(self, run: int, t: Array) -> Array:
        """Force in one run at times since release (n,), N."""
        return (
            sine_cosine_columns(t, np.array([self.frequency])) @ self.sine_cosine_columns[run]
            if run in self.sine_cosine_columns
            else np.zeros_like(t)
        )

    def phase(self, run: int, t: Array) -> Array:
        """Phase in cycles (n,), folded to 0 ... 1; 0 where the force rises through zero."""
        a, b = self.sine_cosine_columns.get(run, (1.0, 0.0))
        return np.asarray((self.frequency * t + np.arctan2(b, a) / (2 * np.pi)) % 1.0)


def sine_cosine_columns(t: Array, f: Array) -> Array:
    """Sine and cosine of every frequency, interleaved.

    Parameters
    ----------
    t
        Times or positions, (n,).
    f
        Frequencies (G,), in cycles per unit of `t`.

    Returns
    -------
    ndarray, shape (n, 2 G)

    Examples
    --------
    >>> sine_cosine_columns(np.array([0.0, 0.25]), np.array([1.0])).round(3).tolist()
    [[0.0, 1.0], [1.0, 0.0]]

    """
    turns = 2 * np.pi * t[:, None] * f
    return np.stack([np.sin(turns), np.cos(turns)], axis=2).reshape(len(t), -1)


def strongest_line(law: ModelProjection, waves: WaveTraces) -> SpectralLine | None:
    """The frequency that lowers chi-squared of all runs most; None if there is nothing to scan."""
    f, runs = waves.f, sorted({r.piece.run for r in law.responses})
    if not len(f) or not runs:
        return None
    whole, absorbed = np.zeros((len(runs), len(f), 2, 2)), np.zeros((len(runs), len(f), 2, 2))
    data = np.zeros((len(runs), len(f), 2))
    for rows, response, traces in zip(law.rows, law.responses, waves.of_pieces, strict=True):
        run, on_law = runs.index(response.piece.run), _inner_products(traces, law.u[rows])
        whole[run] += pair_products(traces)
        absorbed[run] += pair_products(on_law)
        data[run] += _inner_products(traces, law.r[rows, None])[:, :, 0].T
    gram = visible_part(whole.reshape(-1, 2, 2), absorbed.reshape(-1, 2, 2))
    gain = _gains(gram, data.reshape(-1, 2)).reshape(len(runs), -1).sum(axis=0)
    best, step = float(f[int(np.argmax(gain))]), float(f[1] - f[0]) if len(f) > 1 else 0.0
    around = (max(best - step, 0.5 * best), best + step)
    found = minimize_scalar(
        lambda at: -_at(law, float(at), 1).gain, bounds=around, options={"maxiter": MAX_REFINEMENT_STEPS}
    )
    return _at(law, float(found.x), len(f))


def _inner_products(traces: Float32Array, columns: Array) -> Array:
    """Inner products (2, G, k) of traces (2, G, n) with columns (n, k)."""
    return np.asarray((traces.reshape(-1, traces.shape[2]) @ columns.astype(np.float32)).reshape(*traces.shape[:2], -1))


def _gains(gram: Array, data: Array) -> Array:
    """Fall of chi-squared (G,) with waves of Gram matrices (G, 2, 2) and products (G, 2) with the residual."""
    return np.einsum("ga,gab,gb->g", data, np.linalg.pinv(gram, rcond=1e-6, hermitian=True), data)


def line_at(law: ModelProjection, frequency: float) -> SpectralLine:
    """Fit a sinusoid of a known frequency."""
    return _at(law, frequency, 1)


def _at(law: ModelProjection, frequency: float, tried: int) -> SpectralLine:
    """Fit a sinusoid of one frequency, the best of `tried`."""
    runs = sorted({r.piece.run for r in law.responses})
    columns = np.zeros((len(law.r), 2 * len(runs)))
    for rows, response in zip(law.rows, law.responses, strict=True):
        k = 2 * runs.index(response.piece.run)
        waves = sine_cosine_columns(response.piece.panels.t, np.array([frequency]))
        columns[rows, k : k + 2] = displacement_response(response, waves)
    clean = columns - law.u @ (law.u.T @ columns)
    size: Array = np.asarray(np.linalg.lstsq(clean, law.r, rcond=1e-8)[0], dtype=np.float64)
    gain = float(np.sum((clean @ size) ** 2))
    p = float(min(1.0, tried * chi2_sf(gain, 2 * len(runs))))
    return SpectralLine(frequency, {run: size[2 * k : 2 * k + 2] for k, run in enumerate(runs)}, gain, p, columns)


@dataclass(frozen=True)
class SpatialWave:
    """A dry friction force that is sinusoidal over the place: force N (n,) and variance per piece, gain, p, traces."""

    force: list[Array]
    variance: list[Array]
    gain: float
    p: float
    columns: Array  # (N + m, 2)


def strongest_spatial_wave(law: ModelProjection, waves: WaveTraces) -> SpatialWave | None:
    """The spatial period that lowers chi-squared of all runs most; None if there is nothing to refine."""
    f, at = waves.f, [motion_at_nodes(law.solution, r) for r in law.responses]
    whole, data = np.zeros((len(f), 2, 2)), np.zeros((len(f), 2))
    on_law = np.zeros((2, len(f), law.u.shape[1]))
    for rows, traces in zip(law.rows, waves.of_pieces, strict=True):
        whole += pair_products(traces)
        data += _inner_products(traces, law.r[rows, None])[:, :, 0].T
        on_law += _inner_products(traces, law.u[rows])
    gain = _gains(visible_part(whole, pair_products(on_law)), data)
    best = int(np.argmax(gain))
    around = float(f[max(best - 1, 0)]), float(f[min(best + 1, len(f) - 1)])
    if around[0] == around[1]:
        return None
    found = minimize_scalar(
        lambda q: -_spatial_wave(law, at, float(q), 1).gain, bounds=around, options={"maxiter": MAX_REFINEMENT_STEPS}
    )
    return _spatial_wave(law, at, float(found.x), len(f))


def _spatial_wave(law: ModelProjection, at: Sequence[NodeMotion], f: float, tried: int) -> SpatialWave:
    """Fit one spatial frequency; the variance includes that of the frequency."""
    columns = np.zeros((len(law.r), 2))
    for rows, response, n in zip(law.rows, law.responses, at, strict=True):
        columns[rows] = displacement_response(response, sine_cosine_columns(n.x, np.array([f])) * n.dry_factor[:, None])
    clean = columns - law.u @ (law.u.T @ columns)
    size: Array = np.asarray(np.linalg.lstsq(clean, law.r, rcond=1e-8)[0], dtype=np.float64)
    gain = float(np.sum((clean @ size) ** 2))
    shifted = np.zeros(len(law.r))
    derivatives = [_force_derivatives(n, f, size) for n in at]
    for rows, response, m in zip(law.rows, law.responses, derivatives, strict=True):
        shifted[rows] = displacement_response(response, m[:, 2:])[:, 0]
    columns_and_shift = np.column_stack([clean, shifted - law.u @ (law.u.T @ shifted)])
    covariance = np.linalg.pinv(columns_and_shift.T @ columns_and_shift, hermitian=True)
    frames = [
        np.stack([np.interp(r.piece.t, n.t, q) for q in m.T], axis=1)
        for r, n, m in zip(law.responses, at, derivatives, strict=True)
    ]
    variance = [np.einsum("nj,jk,nk->n", m, covariance, m) for m in frames]
    return SpatialWave(
        [m[:, :2] @ size for m in frames], variance, gain, float(min(1.0, tried * chi2_sf(gain, 2))), columns
    )


def _force_derivatives(n: NodeMotion, f: float, size: Array) -> Array:
    """Force at the nodes of one piece per unit of sine, of cosine and of f, (3 p, 3)."""
    wave = sine_cosine_columns(n.x, np.array([f])) * n.dry_factor[:, None]
    by_frequency = 2 * np.pi * n.x * (wave[:, 1] * size[0] - wave[:, 0] * size[1])
    return np.column_stack([wave, by_frequency])
