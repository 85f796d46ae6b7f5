"""The noise of a measured friction, estimated from itself: how large it is, and over how long it is alike.

What a law leaves of such a series is mostly far above the cell's white noise and alike from frame to frame: the cell
drifts, the surface changes, or the law lacks something. Frames that are alike say the same thing, so every frame counts
as one over the integrated correlation time (Sokal 1997), and only what explains much of the residual stands out of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictrack.fit.series.law import likeness
from frictrack.fit.simulated.pieces import Piece
from frictrack.fit.simulated.solve import Solution, refine
from frictrack.records import Array

KEPT = 4  # frames kept of those that are alike
WINDOW = 5.0  # correlation times over which the correlation is summed


@dataclass(frozen=True)
class Noise:
    """Of a measured friction: rms (N), and how many frames say the same thing."""

    rms: float
    alike: float


def weighed(solution: Solution) -> tuple[Solution, Noise]:
    """The same law with every frame counted by the noise that its residual shows, and that noise.

    Of frames that are alike only some are kept: the others say nothing that these do not.
    """
    noise = _noise(solution)
    every = max(int(noise.alike / KEPT), 1)
    pieces = [_thinned(p, every) for p in solution.problem.pieces]
    return _over(solution, pieces, noise.rms * float(np.sqrt(max(noise.alike / every, 1.0)))), noise


def counted(solution: Solution, noise: Noise) -> Solution:
    """A law over the frames that it has, counted by a noise that is known."""
    whole = sum(int(p.frames[-1] - p.frames[0]) + 1 for p in solution.problem.pieces)
    every = max(round(whole / sum(len(p.t) for p in solution.problem.pieces)), 1)
    return _over(solution, solution.problem.pieces, noise.rms * float(np.sqrt(max(noise.alike / every, 1.0))))


def _over(solution: Solution, pieces: Sequence[Piece], sigma: float) -> Solution:
    """The same law over other frames, all of one noise, N."""
    told = [replace(p, sigma=np.full(len(p.t), sigma)) for p in pieces]
    problem = solution.problem.over(solution.problem.layout, told)
    held = np.zeros(len(solution.p), dtype=bool)
    return refine(problem, solution.p, solution.starts, tau=solution.tau, free=held, max_steps=0)


def _thinned(piece: Piece, every: int) -> Piece:
    rows = slice(None, None, every)
    return replace(
        piece, frames=piece.frames[rows], t=piece.t[rows], y=piece.y[rows], sigma=piece.sigma[rows], at=piece.at[rows]
    )


def _noise(solution: Solution) -> Noise:
    """Noise of all runs together."""
    left = [r.r * r.piece.sigma for r in solution.responses]
    if all(likeness(e) == 0 for e in left):
        white = np.concatenate([r.piece.sigma for r in solution.responses])
        return Noise(float(np.sqrt(np.mean(white**2))), 1.0)
    freedom = sum(map(len, left)) / max(sum(map(len, left)) - len(solution.p), 1)
    rms = float(np.sqrt(freedom * np.mean(np.concatenate(left) ** 2)))
    return Noise(rms, max(1.0, *(_correlation_time(e) for e in left)))


def _correlation_time(e: Array) -> float:
    """Integrated correlation time in frames, summed over a window that grows with it."""
    n = len(e)
    spectrum = np.abs(np.fft.rfft(e - e.mean(), 2 * n)) ** 2
    rho = np.fft.irfft(spectrum)[: n // 2]
    total = 1 + 2 * np.cumsum(rho[1:] / max(float(rho[0]), 1e-300))
    far = np.flatnonzero(np.arange(1, len(total) + 1) >= WINDOW * total)
    return float(total[far[0]] if len(far) else total[-1])
