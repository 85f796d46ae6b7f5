"""The fitted model linearised along the measured motion, ready for the forces of candidate effects."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.least_squares import Solution
from frictrack.fit.linearised.measured_motion import linearise_about_measurement
from frictrack.fit.linearised.pieces import LinearisedPiece, linearised_piece
from frictrack.fit.parameters import JacobianBasis
from frictrack.fit.pieces import consecutive_slices
from frictrack.fit.separable import DataBlock
from frictrack.records import Array, Mask

Float32Array = NDArray[np.float32]


@dataclass(eq=False)
class LinearisedModel:
    """A fitted model ready for candidates: its pieces, and its orthonormal basis in the coordinates of theirs.

    Attributes
    ----------
    solution : Solution
        The fit, linearised about the measured motion.
    pieces : list of LinearisedPiece
        The pieces.
    rows : list of slice
        Rows of every piece among all N frames.
    coordinate_slices : list of slice
        Coordinates of every piece among all L.
    basis : JacobianBasis
        Orthonormal basis (N, P') of the model.
    basis_coordinates : array of shape (L, P')
        Coordinates of `basis` in the bases of the pieces.
    unbounded : tuple of JacobianBasis and array
        Basis and its coordinates with the sensitivities to the unknowns that a bound holds.

    """

    solution: Solution
    pieces: list[LinearisedPiece]
    rows: list[slice]
    coordinate_slices: list[slice]
    basis: JacobianBasis
    basis_coordinates: Array
    unbounded: tuple[JacobianBasis, Array]

    @property
    def runs(self) -> list[int]:
        """Indices of the runs, in order."""
        return sorted({s.run for s in self.pieces})

    @cached_property
    def blocks(self) -> list[DataBlock]:
        """The pieces as data that forces along the measured motion explain."""
        return [s.block() for s in self.pieces]

    @cached_property
    def level_coordinates(self) -> Array:
        """Coordinates (L, R) of the sensitivities to the friction levels in the bases of the pieces."""
        return self.coordinates(self.solution.jac[:, self.solution.problem.layout.levels])

    def coordinates(self, series: Array | Float32Array) -> Array:
        """Compute the coordinates (L, D) of whitened data (N, D) in the bases of the pieces."""
        return _coordinates(self.pieces, self.rows, series)

    def residual_projector(self, tau: float) -> Array:
        """Compute the projector (L, L) on what the refitted model leaves of coordinates.

        `tau` is the scatter of the friction levels.
        """
        return _projector(self.basis, self.basis_coordinates, tau)

    def unbounded_projector(self, tau: float) -> Array:
        """Compute the same projector (L, L) as if no bound held an unknown.

        A missing effect moves such an unknown away from its bound before it leaves any misfit.
        """
        return _projector(*self.unbounded, tau)

    def fitted_coordinates(self, coordinates: Array, tau: float) -> Array:
        """Compute the coordinates (P', D) in `basis` of the fits to data with coordinates (L, D), at one scatter."""
        return np.asarray(self.basis.shrink(tau) @ (self.basis_coordinates.T @ coordinates))


def linearise(solution: Solution) -> LinearisedModel:
    """Prepare a fitted model for the scan of candidate effects.

    Parameters
    ----------
    solution : Solution
        The fit.

    Returns
    -------
    LinearisedModel
        Its linearisation about the measured motion. Unknowns that a bound holds are not free: the misfit that they
        would take up beyond it is left for candidates.

    """
    free = linearise_about_measurement(solution)
    pieces = [linearised_piece(free, r) for r in free.responses]
    rows = consecutive_slices(len(r.r) for r in free.responses)
    coordinate_slices = consecutive_slices(s.basis.shape[1] - s.starts for s in pieces)
    unbounded = free.basis, _coordinates(pieces, rows, free.basis.u)
    if not np.any(solution.held):
        return LinearisedModel(free, pieces, rows, coordinate_slices, *unbounded, unbounded)
    bounded = _without_held(free, solution.held)
    own = bounded.basis, _coordinates(pieces, rows, bounded.basis.u)
    return LinearisedModel(bounded, pieces, rows, coordinate_slices, *own, unbounded)


def _coordinates(pieces: list[LinearisedPiece], rows: list[slice], series: Array | Float32Array) -> Array:
    parts = [s.basis[:, s.starts :].T @ series[own] for s, own in zip(pieces, rows, strict=True)]
    return np.asarray(np.concatenate(parts), dtype=np.float64)


def _projector(basis: JacobianBasis, coordinates: Array, tau: float) -> Array:
    """Projector (L, L) on what a basis of given coordinates leaves at one scatter of the levels."""
    return np.asarray(np.eye(len(coordinates)) - coordinates @ basis.shrink(tau) @ coordinates.T)


def _without_held(solution: Solution, held: Mask) -> Solution:
    """The solution without sensitivities to some unknowns (P,)."""
    responses = [replace(r, jac=np.where(held[r.active], 0.0, r.jac)) for r in solution.responses]
    fewer = replace(solution, responses=responses)
    vars(fewer)["held"] = held  # without their sensitivities it does not show
    return fewer


@dataclass(eq=False)
class ScannedSeries:
    """Whitened data series to scan; the first one is measured.

    Attributes
    ----------
    measured : array of shape (N,)
        The measured series.
    residuals : array of shape (N, D), float32
        What the refitted model leaves of every series, at its own scatter of the levels.
    coordinates : array of shape (L, D)
        Coordinates of the series in the pieces' bases.
    taus : array of shape (T,)
        The considered scatters of the levels.
    residual_projectors : list of array of shape (L, L)
        For every scatter, the projector on what the model leaves.
    groups : list of slice
        The series whose own estimate each scatter is.
    profile : array of shape (T, D)
        Restricted likelihood of the model alone at the T scatters.
    kept : dict
        What scans of several grids share: products of plain waves in time, and what couples the runs.

    """

    measured: Array
    residuals: Float32Array
    coordinates: Array
    taus: Array
    residual_projectors: list[Array]
    groups: list[slice]
    profile: Array
    kept: dict[Any, Any] = field(default_factory=dict, repr=False)

    def projected(self, t: int) -> Array:
        """Return what the model leaves of the coordinates of all series at one scatter of the levels, (L, D)."""
        if ("projected", t) not in self.kept:
            self.kept["projected", t] = self.residual_projectors[t] @ self.coordinates
        return np.asarray(self.kept["projected", t])

    def divided(self, count: int) -> Iterator[ScannedSeries]:
        """Divide the draws into `count` of them, evenly from all groups, and the others; each with the measured one."""
        draws = self.residuals.shape[1] - 1
        is_first = np.zeros(draws, dtype=bool)
        is_first[np.linspace(0, draws - 1, min(count, draws)).round().astype(int)] = True
        for part in (is_first, ~is_first):
            if part.any():
                yield self._of(np.append(0, 1 + np.flatnonzero(part)))

    def _of(self, kept: NDArray[np.int_]) -> ScannedSeries:
        ends = [np.searchsorted(kept, (own.start, own.stop)).tolist() for own in self.groups]
        return replace(
            self,
            residuals=self.residuals[:, kept],
            coordinates=self.coordinates[:, kept],
            groups=[slice(*own) for own in ends],
            profile=self.profile[:, kept],
            kept={},
        )


def measured_series(law: LinearisedModel) -> ScannedSeries:
    """Return the measured data alone, at the fitted scatter of the levels."""
    data = law.solution.random_effect_data()
    tau, coordinates = law.solution.tau, law.coordinates(data[:, None])
    left = data[:, None] - law.basis.u @ law.fitted_coordinates(coordinates, tau)
    projectors = [law.residual_projector(tau)]
    return ScannedSeries(
        data, left.astype(np.float32), coordinates, np.array([tau]), projectors, [slice(0, 1)], np.zeros((1, 1))
    )
