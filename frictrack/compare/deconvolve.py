"""The force that a fitted law lacks, frame by frame and with a band, deconvolved from the displacement.

The force is a Gaussian process (Matern 3/2) through knots, its trace in the displacement the same that the law's own
forces leave. Start, law and levels are free beside it. Size and reach of the process are not chosen but averaged over,
weighed by the restricted likelihood of all runs together, so that the band knows how little is known of them
(Rasmussen & Williams 2006, ch. 2 and 5). Local forces and waves that stand out by themselves are taken apart first, or
they would be smeared over the rest. What of a slow force the law could take up itself is neither in the curve nor in
its band: no run tells it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.compare.local_forces import ALPHA, local_forces, uncertain
from frictrack.compare.spectral_lines import Line, line_at, strongest_line, strongest_ripple
from frictrack.fit.least_squares import (
    ModelProjection,
    PieceResponse,
    Solution,
    displacement_response,
    position_and_velocity,
)
from frictrack.fit.measured_friction import MeasuredFrictionPiece
from frictrack.fit.smooth_functions import linear_interpolation_matrix, matern_covariance
from frictrack.records import Array

KNOTS = 100  # of a piece at most
APART = 4.0  # frames between knots at least
REACHES = 5  # of the process, from a few knots to a quarter of the longest piece
SIZES = np.geomspace(0.1, 3e4, 31)  # of the process over what the runs just show
LIGHT = 0.01  # weight, over the largest, below which a size and reach are left out


@dataclass(frozen=True)
class Deconvolved:
    """What one piece says of the missing force: t s since release, x, v, a of the law's own motion; F, sigma_F in N."""

    run: int
    t: Array
    x: Array
    v: Array
    a: Array
    F: Array
    sigma_F: Array


@dataclass(frozen=True)
class _Process:
    """One reach of the process: what each piece sees of its independent parts.

    `shape` (n, K) force at the frames, `seen` (K,) squared traces, `on_law` (K, P'), `data` (K,).
    """

    shape: list[Array]
    seen: list[Array]
    on_law: list[Array]
    data: list[Array]

    def likelihood(self, size: float) -> float:
        """Logarithm of the restricted likelihood of a size."""
        kept, inner, _, pull = self._beside(size)
        told = sum(float(b @ (k * b)) for k, b in zip(kept, self.data, strict=True))
        told += float(pull @ np.linalg.solve(inner, pull))
        spread = sum(float(np.sum(np.log1p(size**2 * s))) for s in self.seen) + float(np.linalg.slogdet(inner)[1])
        return (told - spread) / 2

    def solved(self, size: float) -> tuple[list[Array], list[Array]]:
        """Means and variances (n,) of the force for a size."""
        kept, _, inverse, pull = self._beside(size)
        back = inverse @ pull
        means, variances = [], []
        for shape, k, w, b in zip(self.shape, kept, self.on_law, self.data, strict=True):
            means.append(shape @ (k * (b + w @ back)))
            bent = shape @ (k[:, None] * w)
            variances.append(shape**2 @ k + np.einsum("np,np->n", bent @ inverse, bent))
        return means, variances

    def _beside(self, size: float) -> tuple[list[Array], Array, Array, Array]:
        """What is kept of every part (K,), of the law beside the force (P', P'), its inverse, its pull (P',)."""
        kept = [size**2 / (1 + size**2 * s) for s in self.seen]
        inner = np.eye(self.on_law[0].shape[1])
        pull = np.zeros(len(inner))
        for k, w, b in zip(kept, self.on_law, self.data, strict=True):
            inner -= (w * k[:, None]).T @ w
            pull += w.T @ (k * b)
        return kept, inner, np.asarray(np.linalg.inv(inner), dtype=np.float64), pull


def deconvolved(solution: Solution) -> tuple[list[Deconvolved], Line | None]:
    """The missing force at the frames of every piece, and the line by which its phase is counted.

    That line is the vibration of the law if it has one, else the strongest one of what the law leaves.
    """
    found = local_forces(solution)
    known = _vibration(solution)
    line = strongest_line(found.law) if known is None else line_at(found.law, known)
    explained = float(found.law.r @ found.law.r - found.left.r @ found.left.r)
    ripple = strongest_ripple(found.law)
    if ripple is not None and ripple.p < ALPHA and ripple.gain > max(explained, 0.0 if line is None else line.gain):
        left = found.law.with_columns(ripple.columns)
        means, variances = _averaged(left)
        means = [m + f for m, f in zip(means, ripple.force, strict=True)]
        bands = ripple.variance
    elif line is not None and known is None and line.p < ALPHA and line.gain > explained:
        found = replace(found, bumps=[], left=found.law.with_columns(line.columns))
        means, variances = _averaged(found.left)
        own = [line.force(r.piece.run, r.piece.t) for r in found.left.responses]
        spread = [np.full_like(f, np.mean(f**2) / max(line.gain / (2 * len(own)), 1.0)) for f in own]
        means = [m + f for m, f in zip(means, own, strict=True)]
        variances = [v + s for v, s in zip(variances, spread, strict=True)]
        bands = [np.zeros_like(f) for f in own]
    else:
        means, variances = _averaged(found.left)
        own, bands = uncertain(found)
        means = [m + f for m, f in zip(means, own, strict=True)]
    pieces = zip(found.left.responses, means, variances, bands, strict=True)
    return [_piece(response, mean, variance + band) for response, mean, variance, band in pieces], line


def _vibration(solution: Solution) -> float | None:
    """Frequency of the first vibration that the law has, Hz; None where it has none."""
    values, _ = solution.problem.layout.values(solution.p, solution.problem.pieces[0].run)
    return next((q["frequency"] for name, q in values.items() if name.startswith("vibration")), None)


def _averaged(law: ModelProjection) -> tuple[list[Array], list[Array]]:
    """Means and variances of the force, averaged over sizes and reaches as likely as they are."""
    knots = [_knots(r) for r in law.responses]
    made = [_seen(law, i, k) for i, k in enumerate(knots)]
    step = max(float(k[1] - k[0]) for k in knots)
    longest = max(float(k[-1] - k[0]) for k in knots)
    tried = []
    for reach in np.geomspace(2 * step, max(longest / 4, 3 * step), REACHES):
        process = _process(law, knots, made, float(reach))
        top = max(float(s.max()) for s in process.seen)
        sizes = (SIZES / np.sqrt(max(top, 1e-300))).tolist()
        tried += [(process.likelihood(size), process, size) for size in sizes]
    weight = np.exp(np.array([t[0] for t in tried]) - max(t[0] for t in tried))
    weight[weight < LIGHT] = 0.0
    weight /= weight.sum()
    kept = [(w, process.solved(size)) for w, (_, process, size) in zip(weight, tried, strict=True) if w > 0]
    means = [np.sum([w * m[i] for w, (m, _) in kept], axis=0) for i in range(len(knots))]
    squares = [np.sum([w * (v[i] + m[i] ** 2) for w, (m, v) in kept], axis=0) for i in range(len(knots))]
    return means, [np.maximum(q - m**2, 0.0) for q, m in zip(squares, means, strict=True)]


def _knots(response: PieceResponse) -> Array:
    t = response.piece.t
    step = float(np.median(np.diff(t)))
    count = int(np.clip((t[-1] - t[0]) / (APART * step), 3, KNOTS))
    return np.linspace(t[0], t[-1], count)


def _seen(law: ModelProjection, i: int, knots: Array) -> tuple[Array, Array, Array]:
    """Gram matrix (K, K), inner products with the law (K, P') and with the data (K,) of a force through the knots."""
    response, rows = law.responses[i], law.rows[i]
    columns = displacement_response(response, linear_interpolation_matrix(response.piece.panels.t, knots))
    return columns.T @ columns, columns.T @ law.u[rows], columns.T @ law.r[rows]


def _process(law: ModelProjection, knots: Sequence[Array], made: Sequence[tuple[Array, ...]], reach: float) -> _Process:
    shape, seen, on_law, data = [], [], [], []
    for response, at, (gram, w, b) in zip(law.responses, knots, made, strict=True):
        root = np.linalg.cholesky(matern_covariance(at, reach) + 1e-10 * np.eye(len(at)))
        value, vector = np.linalg.eigh(root.T @ gram @ root)
        part = root @ vector
        shape.append(linear_interpolation_matrix(response.piece.t, at) @ part)
        seen.append(np.maximum(value, 0.0))
        on_law.append(part.T @ w)
        data.append(part.T @ b)
    return _Process(shape, seen, on_law, data)


def _piece(response: PieceResponse, mean: Array, variance: Array) -> Deconvolved:
    x, v = position_and_velocity(response)
    a = _acceleration(response, v)
    return Deconvolved(response.piece.run, response.piece.t, x, v, a, mean, np.sqrt(variance))


def _acceleration(response: PieceResponse, v: Array) -> Array:
    """Acceleration of the law's own motion at the frames, m/s^2."""
    piece = response.piece
    if isinstance(piece, MeasuredFrictionPiece):
        return np.gradient(v, piece.t)
    return np.interp(piece.t, piece.panels.t, response.motion.a)
