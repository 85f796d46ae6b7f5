"""Compute accelerations of one piece as the papers do: low-pass, then double difference, as one linear map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from frictrack.fit.pieces.cutting import MIN_FRAMES
from frictrack.fit.pieces.piece import Piece
from frictrack.motion import STENCIL_FRAMES, frame_grid, frame_weights, stencils
from frictrack.motion.smoother import FactoredSmoother, SmootherData, Structure
from frictrack.records import Array, Mask, Run


@dataclass(frozen=True)
class AccelerationChain:
    """Low-pass and double difference of one piece: a linear map from its n frames to m accelerations, m/s^2.

    The frames within the run's guard of either end are smoothed but not compared.
    """

    rows: NDArray[np.int64]  # place of every frame on the regular grid of N frames
    weight: Array  # of the smoother, (N,), 0 where a frame is missing
    factor: FactoredSmoother  # the smoother
    second: csr_array  # second derivative at the compared frames, (m, N)
    sigma_a: Array  # noise of the accelerations, (m,)
    kept: NDArray[np.int64]  # the compared frames of the piece, (m,)
    cutoff: float  # Hz

    def apply(self, columns: Array) -> Array:
        """Compute accelerations (m, k), m/s^2, of displacements (n, k), m."""
        full = np.zeros((len(self.weight), columns.shape[1]))
        full[self.rows] = columns
        out: Array = self.second @ self.factor.smooth(full)
        return out

    def transposed(self, columns: Array) -> Array:
        """Apply the transposed map to columns (m, k), shape (n, k)."""
        out: Array = (self.weight[:, None] * self.factor.posterior_covariance_times(self.second.T @ columns))[self.rows]
        return out

    def only(self, rows: Mask) -> AccelerationChain:
        """Return the same chain, compared only at the marked frames (n,) of the piece."""
        use = rows[self.kept]
        return replace(self, second=self.second[use], sigma_a=self.sigma_a[use], kept=self.kept[use])


def acceleration_chain(run: Run, piece: Piece) -> AccelerationChain:
    """Create the chain of one piece at the cut-off frequency of its run."""
    grid, n = frame_grid(piece.t), len(piece.t)
    guard = min(run.motion.guard, n // 8, max((n - MIN_FRAMES) // 2, 0))
    inside = np.arange(guard, n - guard)
    kept = grid.frames[inside]
    weight = grid.to_frames(frame_weights(piece.sigma, np.ones(n, dtype=bool)))
    low_pass = Structure.low_pass(run.motion.cutoff, grid.interval)
    smoother = low_pass.factor_smoother(SmootherData(np.zeros(grid.n), weight))
    start, table = stencils(grid.n, grid.interval)
    noise = float(np.mean(piece.sigma**-2.0) ** -0.5)
    sigma_a = noise * np.sqrt(smoother.noise_variances(start, table[2:]))[0]
    rows = np.repeat(np.arange(len(kept)), STENCIL_FRAMES)
    columns = (start[kept, None] + np.arange(STENCIL_FRAMES)).ravel()
    second = csr_array((table[2, kept].ravel(), (rows, columns)), shape=(len(kept), grid.n))
    return AccelerationChain(grid.frames, weight, smoother, second, sigma_a[kept], inside, run.motion.cutoff)


def acceleration_noise(chains: Sequence[AccelerationChain]) -> float:
    """Compute the root mean square noise of all compared accelerations, m/s^2."""
    return float(np.sqrt(np.mean(np.concatenate([c.sigma_a for c in chains]) ** 2)))


def acceleration_chains(runs: Sequence[Run], pieces: Sequence[Piece]) -> list[AccelerationChain]:
    """Create the chains of all pieces."""
    return [acceleration_chain(runs[piece.run], piece) for piece in pieces]
