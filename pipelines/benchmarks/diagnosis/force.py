"""Detect effects in the force domain: filter and differentiate the displacement twice, then least squares.

The papers' chain: a Butterworth filter of order 4, forward and backward, and central differences; columns of the law
and of the effect go through it too. Least squares takes the force's noise for white, which it is not: how far the
effect's size is off is found by sending noise through the chain. The threshold is the ideal detector's, so that alpha,
search and scatter are the same.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import butter, filtfilt

from frictrack.records import Array
from frictrack.validation.blind.ideal_detector import N_PHASES, IdealDetector, unit_values
from frictrack.validation.blind.truth import effect_named

CUTOFF_HZ = 100.0  # Hz
TRIM_FRAMES = 20  # frames at either end, which the filter smears
N_DRAWS = 300


def chained(x: Array, fps: float, mass: float) -> Array:
    """Force (m, k) of displacements (n, k): filtered, differentiated twice, ends left out."""
    smooth = filtfilt(*butter(4, CUTOFF_HZ, fs=fps), x, axis=0)
    a = np.gradient(np.gradient(smooth, 1 / fps, axis=0), 1 / fps, axis=0)
    return np.asarray(-mass * a[TRIM_FRAMES:-TRIM_FRAMES])


def force_size(detector: IdealDetector, name: str, at: dict[str, float], seed: int = 0) -> float | None:
    """Smallest size seen in 95 of 100 repeats, phases at their worst; None where it never can be."""
    effect = effect_named(name)
    phases = [p.name for p in effect.parameters if p.role == "phase"]
    tried = np.arange(N_PHASES) * np.pi / N_PHASES if phases else [0.0]
    errors = [_error(detector, name, at, dict.fromkeys(phases, float(q)), seed) for q in tried]
    worst = max(errors)
    return float(np.sqrt(detector.limit(effect)) * worst) if np.isfinite(worst) else None


def _error(detector: IdealDetector, name: str, at: dict[str, float], phases: dict[str, float], seed: int) -> float:
    """Standard deviation of the effect's size by least squares in the force domain."""
    rng, bare, effect = np.random.default_rng(seed), detector.base_study, effect_named(name)
    count = len(bare.runs)
    rows, noise = [], []
    sensitivities = detector.sensitivities(effect, unit_values(effect, at, phases, count))
    for i, (run, (_, _, block, answer)) in enumerate(zip(bare.runs, sensitivities, strict=True)):
        mass = bare.mass * run.mass_ratio
        own = np.zeros((len(block), 3 * count))  # two of the start and one of the level
        own[:, 2 * i : 2 * i + 2], own[:, 2 * count + i] = block[:, :2], block[:, -1]
        rows.append(chained(np.column_stack([answer, block[:, 2:-1], own]), bare.fps, mass))
        noise.append(chained(bare.noise * rng.standard_normal((len(block), N_DRAWS)), bare.fps, mass))
    a, e = np.vstack(rows), np.vstack(noise)
    spread = float(np.std(e))
    held = np.zeros((count, a.shape[1]))
    held[:, -count:] = np.eye(count) * spread / bare.scatter
    levels = bare.scatter * rng.standard_normal((count, N_DRAWS))
    e = e + a[:, -count:] @ levels
    a, e = np.vstack([a, held]), np.vstack([e, np.zeros((count, N_DRAWS))])
    norm = np.linalg.norm(a, axis=0)
    kept = norm > 0
    rest = a[:, kept][:, 1:] / norm[kept][1:]
    q = np.linalg.svd(rest, full_matrices=False)
    basis = q[0][:, q[1] > 1e-9 * q[1][0]]
    alone = a[:, 0] - basis @ (basis.T @ a[:, 0])
    if np.linalg.norm(alone) < 1e-6 * norm[0]:
        return np.inf
    return float(np.std(alone @ e / (alone @ alone)))
