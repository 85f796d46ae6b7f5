"""Waves that a law leaves: over time, each run with its own amplitude and phase; over the place, one for all runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from frictrack.compare.bump_dictionary import Nodes, nodes
from frictrack.effects.base import frequencies
from frictrack.effects.texture import periods
from frictrack.fit.least_squares import ModelProjection, PieceResponse, displacement_response
from frictrack.records import Array

PERIODS = 3.0
FINER = 12  # looks between two frequencies of the scan
CROWD = 32  # waves whose traces are made at once: what they need stays in the cache
EVERY = 2  # of the library's frequencies, a quarter of a Rayleigh cell apart


@dataclass(frozen=True)
class Line:
    """A frequency in Hz; force a sin + b cos of 2 pi f t in every run, N, (R, 2); what it gains; and its p."""

    frequency: float
    waves: dict[int, Array]
    gain: float
    p: float
    columns: Array  # its traces over all frames, (N + m, 2 R)

    def force(self, run: int, t: Array) -> Array:
        """Its force in one run at times since release (n,), N."""
        return waves(t, np.array([self.frequency])) @ self.waves[run] if run in self.waves else np.zeros_like(t)

    def phase(self, run: int, t: Array) -> Array:
        """Cycles (n,) at times since release, whole numbers where the force rises through zero, folded to 0 ... 1."""
        a, b = self.waves.get(run, (1.0, 0.0))
        return np.asarray((self.frequency * t + np.arctan2(b, a) / (2 * np.pi)) % 1.0)


def waves(t: Array, f: Array) -> Array:
    """Sine and cosine of every frequency (G,) at times (n,), side by side: (n, 2 G)."""
    turns = 2 * np.pi * t[:, None] * f
    return np.stack([np.sin(turns), np.cos(turns)], axis=2).reshape(len(t), -1)


def scanned(law: ModelProjection) -> Array:
    """Frequencies worth a look, Hz: fewer periods than `PERIODS` in the longest run are no line."""
    span = law.solution.problem.layout.span
    f = frequencies(span)[::EVERY]
    return f[f >= PERIODS / span.duration]


def seen(response: PieceResponse, f: Array) -> Array:
    """Traces of sines and cosines in one piece, (n, 2 G)."""
    return wave_traces(response, response.piece.panels.t, f)


def wave_traces(response: PieceResponse, along: Array, f: Array, dry: Array | None = None) -> Array:
    """Traces (n, 2 G) in one piece of forces that wave along its nodes (3 p,) with frequencies (G,), times `dry`."""
    out = np.empty((len(response.r), 2 * len(f)))
    for first in range(0, len(f), CROWD):
        made = waves(along, f[first : first + CROWD])
        out[:, 2 * first : 2 * (first + CROWD)] = displacement_response(
            response, made if dry is None else made * dry[:, None]
        )
    return out


def strongest_line(law: ModelProjection) -> Line | None:
    """The frequency at which all runs together gain most; None where the law has no frame to look at."""
    f = scanned(law)
    runs = sorted({r.piece.run for r in law.responses})
    if not len(f) or not runs:
        return None
    gain = np.zeros(len(f))
    for run in runs:
        gram, data = np.zeros((len(f), 2, 2)), np.zeros((len(f), 2))
        for rows, response in zip(law.rows, law.responses, strict=True):
            if response.piece.run == run:
                made = seen(response, f)
                on = (law.u[rows].T @ made).reshape(-1, len(f), 2)
                cube = made.reshape(len(made), len(f), 2)
                gram += np.einsum("nfi,nfj->fij", cube, cube) - np.einsum("pfi,pfj->fij", on, on)
                data += (law.r[rows] @ made).reshape(len(f), 2)
        gain += np.einsum("fi,fij,fj->f", data, np.linalg.pinv(gram, rcond=1e-6, hermitian=True), data)
    best, step = float(f[int(np.argmax(gain))]), float(f[1] - f[0]) if len(f) > 1 else 0.0
    around = (max(best - step, 0.5 * best), best + step)
    found = minimize_scalar(lambda at: -_at(law, float(at), 1).gain, bounds=around, options={"maxiter": FINER})
    return _at(law, float(found.x), len(f))


def line_at(law: ModelProjection, frequency: float) -> Line:
    """A line of a known frequency."""
    return _at(law, frequency, 1)


def _at(law: ModelProjection, frequency: float, tried: int) -> Line:
    runs = sorted({r.piece.run for r in law.responses})
    columns = np.zeros((len(law.r), 2 * len(runs)))
    for rows, response in zip(law.rows, law.responses, strict=True):
        k = 2 * runs.index(response.piece.run)
        columns[rows, k : k + 2] = seen(response, np.array([frequency]))
    clean = columns - law.u @ (law.u.T @ columns)
    size: Array = np.asarray(np.linalg.lstsq(clean, law.r, rcond=1e-8)[0], dtype=np.float64)
    gain = float(np.sum((clean @ size) ** 2))
    p = float(min(1.0, tried * chi2.sf(gain, 2 * len(runs))))
    return Line(frequency, {run: size[2 * k : 2 * k + 2] for k, run in enumerate(runs)}, gain, p, columns)


@dataclass(frozen=True)
class Ripple:
    """A dry force that waves over the place: at the frames of every piece, N (n,), its variance, gain, p and traces."""

    force: list[Array]
    variance: list[Array]
    gain: float
    p: float
    columns: Array  # (N + m, 2)


def strongest_ripple(law: ModelProjection) -> Ripple | None:
    """The period over the place at which all runs together gain most."""
    f = np.sort(1 / periods(law.solution.problem.layout.span))
    at = [nodes(law.solution, r) for r in law.responses]
    gram, data, on = np.zeros((len(f), 2, 2)), np.zeros((len(f), 2)), np.zeros((law.u.shape[1], len(f), 2))
    for rows, response, n in zip(law.rows, law.responses, at, strict=True):
        made = wave_traces(response, n.x, f, n.dry)
        cube = made.reshape(len(made), len(f), 2)
        gram += np.einsum("nfi,nfj->fij", cube, cube, optimize=True)
        data += (law.r[rows] @ made).reshape(len(f), 2)
        on += (law.u[rows].T @ made).reshape(-1, len(f), 2)
    gram -= np.einsum("pfi,pfj->fij", on, on, optimize=True)
    gain = np.einsum("fi,fij,fj->f", data, np.linalg.pinv(gram, rcond=1e-6, hermitian=True), data)
    best = int(np.argmax(gain))
    around = float(f[max(best - 1, 0)]), float(f[min(best + 1, len(f) - 1)])
    if around[0] == around[1]:
        return None
    found = minimize_scalar(lambda q: -_ripple(law, at, float(q), 1).gain, bounds=around, options={"maxiter": FINER})
    return _ripple(law, at, float(found.x), len(f))


def _ripple(law: ModelProjection, at: Sequence[Nodes], f: float, tried: int) -> Ripple:
    """One period; how well it is known follows from the traces of sine, cosine and their change with the period."""
    columns = np.zeros((len(law.r), 2))
    for rows, response, n in zip(law.rows, law.responses, at, strict=True):
        columns[rows] = displacement_response(response, waves(n.x, np.array([f])) * n.dry[:, None])
    clean = columns - law.u @ (law.u.T @ columns)
    size: Array = np.asarray(np.linalg.lstsq(clean, law.r, rcond=1e-8)[0], dtype=np.float64)
    gain = float(np.sum((clean @ size) ** 2))
    shifted = np.zeros(len(law.r))
    moved = [_moved(n, f, size) for n in at]
    for rows, response, m in zip(law.rows, law.responses, moved, strict=True):
        shifted[rows] = displacement_response(response, m[:, 2:])[:, 0]
    whole = np.column_stack([clean, shifted - law.u @ (law.u.T @ shifted)])
    covariance = np.linalg.pinv(whole.T @ whole, hermitian=True)
    frames = [
        np.stack([np.interp(r.piece.t, n.t, q) for q in m.T], axis=1)
        for r, n, m in zip(law.responses, at, moved, strict=True)
    ]
    variance = [np.einsum("nj,jk,nk->n", m, covariance, m) for m in frames]
    return Ripple([m[:, :2] @ size for m in frames], variance, gain, float(min(1.0, tried * chi2.sf(gain, 2))), columns)


def _moved(n: Nodes, f: float, size: Array) -> Array:
    """Force at the nodes of one piece per unit of sine, of cosine and of f, (3 p, 3)."""
    wave = waves(n.x, np.array([f])) * n.dry[:, None]
    turned = 2 * np.pi * n.x * (wave[:, 1] * size[0] - wave[:, 0] * size[1])
    return np.column_stack([wave, turned])
