"""Compute accelerations of one piece as the papers do: low-pass, then double difference, as one linear map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import LinearOperator, aslinearoperator

from frictrack.fit.pieces.cutting import MIN_FRAMES
from frictrack.fit.pieces.piece import Piece
from frictrack.measure.motion import (
    STENCIL_FRAMES,
    FactoredSmoother,
    FilterMethod,
    Smoother,
    SmootherData,
    Structure,
    frame_grid,
    frame_weights,
    stencils,
    unit_responses,
)
from frictrack.records import Array, Mask, Run


@dataclass(frozen=True)
class AccelerationChain:
    """Low-pass and double difference of one piece: a linear map from its n frames to m accelerations, m/s^2.

    The frames within the run's guard of either end are smoothed but not compared.
    """

    linear: LinearOperator  # (m, n)
    sigma_a: Array  # noise of the accelerations, (m,)
    kept: NDArray[np.int64]  # the compared frames of the piece, (m,)
    cutoff: float  # Hz

    def apply(self, columns: Array) -> Array:
        """Compute accelerations (m, k), m/s^2, of displacements (n, k), m."""
        return np.asarray(self.linear.matmat(columns))

    def transposed(self, columns: Array) -> Array:
        """Apply the transposed map to columns (m, k), shape (n, k)."""
        return np.asarray(self.linear.rmatmat(columns))

    def only(self, rows: Mask) -> AccelerationChain:
        """Return the same chain, compared only at the marked frames (n,) of the piece."""
        use = rows[self.kept]
        pick = eye_array(len(use), format="csr")[use]
        return replace(
            self, linear=aslinearoperator(pick) @ self.linear, sigma_a=self.sigma_a[use], kept=self.kept[use]
        )


def acceleration_chain(run: Run, piece: Piece) -> AccelerationChain:
    """Create the chain of one piece: the filter that the run's motion was asked for, else a low-pass at its cut-off."""
    n = len(piece.t)
    guard = min(run.motion.guard, n // 8, max((n - MIN_FRAMES) // 2, 0))
    kept = np.arange(guard, n - guard)
    method = Smoother.read(run.motion.filter).method if run.motion.filter else None
    linear, sigma_a = _low_pass(run, piece, kept) if method is None else _filter(method, piece, kept)
    return AccelerationChain(linear, sigma_a, kept, run.motion.cutoff)


class _LowPass(LinearOperator):
    """Low-pass and second derivative: accelerations (m,) of displacements (n,) that stand in `frames` of a grid."""

    def __init__(self, second: csr_array, smoother: FactoredSmoother, frames: NDArray[np.int64], weight: Array) -> None:
        super().__init__(float, (second.shape[0], len(frames)))  # type: ignore[call-arg]
        self._second, self._smoother, self._frames, self._weight = second, smoother, frames, weight

    def _matmat(self, displacements: Array) -> Array:
        full = np.zeros((len(self._weight), displacements.shape[1]))
        full[self._frames] = displacements
        return np.asarray(self._second @ self._smoother.smooth(full))

    def _rmatmat(self, accelerations: Array) -> Array:
        back = self._smoother.posterior_covariance_times(self._second.T @ accelerations)
        return np.asarray(self._weight[:, None] * back)[self._frames]


def _low_pass(run: Run, piece: Piece, kept: NDArray[np.int64]) -> tuple[LinearOperator, Array]:
    """Low-pass at the run's cut-off and second derivative: the map, and the noise at the kept frames."""
    grid = frame_grid(piece.t)
    weight = grid.to_frames(frame_weights(piece.sigma, np.ones(len(piece.t), dtype=bool)))
    low_pass = Structure.low_pass(run.motion.cutoff, grid.interval)
    smoother = low_pass.factor_smoother(SmootherData(np.zeros(grid.n), weight))
    start, table = stencils(grid.n, grid.interval)
    frames = grid.frames[kept]
    noise = float(np.mean(piece.sigma**-2.0) ** -0.5)
    sigma_a = noise * np.sqrt(smoother.noise_variances(start, table[2:]))[0]
    rows = np.repeat(np.arange(len(kept)), STENCIL_FRAMES)
    columns = (start[frames, None] + np.arange(STENCIL_FRAMES)).ravel()
    second = csr_array((table[2, frames].ravel(), (rows, columns)), shape=(len(kept), grid.n))

    return _LowPass(second, smoother, grid.frames, weight), sigma_a[frames]


def _filter(method: FilterMethod, piece: Piece, kept: NDArray[np.int64]) -> tuple[LinearOperator, Array]:
    """Second derivative by another filter, as a matrix of its responses to every frame, and the noise."""
    grid = frame_grid(piece.t)
    known = grid.to_frames(np.ones(len(piece.t))) > 0
    responses = [response[grid.frames[kept]] for _, response in unit_responses(method, known, 2)]
    matrix = np.concatenate(responses, axis=1) / grid.interval**2
    return aslinearoperator(matrix), np.linalg.norm(matrix * piece.sigma, axis=1)


def acceleration_noise(chains: Sequence[AccelerationChain]) -> float:
    """Compute the root mean square noise of all compared accelerations, m/s^2."""
    return float(np.sqrt(np.mean(np.concatenate([c.sigma_a for c in chains]) ** 2)))


def acceleration_chains(runs: Sequence[Run], pieces: Sequence[Piece]) -> list[AccelerationChain]:
    """Create the chains of all pieces."""
    return [acceleration_chain(runs[piece.run], piece) for piece in pieces]
