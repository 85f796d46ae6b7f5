"""Data series to scan, and what a refitted model absorbs of columns beside them.

The model absorbs W = I - U S U' of a column, U its orthonormal basis and S the shrinkage by the scatter of the friction
levels. The levels belong to single runs, and all other parameters of the model are few: so W is one small matrix per
run less a product of few columns, and the gain of a candidate with coefficients per run costs in proportion to the
number of runs (Woodbury's identity).

References
----------
Golub, G. H. & Van Loan, C. F. (2013). Matrix Computations, section 2.1.4.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.linearised.model import LinearisedModel
from frictrack.records import Array

MIN_SHARED_SHARE = 1e-11  # of a unit column; what several runs share and is smaller is rounding
Float32Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Absorbed:
    """What the model leaves and absorbs of coordinates at one scatter of the levels.

    Attributes
    ----------
    left : list of array of shape (L_b, L_b)
        For every block of runs, what is left of its coordinates by the block itself.
    shared : array of shape (L, p)
        S of the part S S' that couples the blocks.

    """

    left: list[Array]
    shared: Array


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
    waves : dict
        Products of plain waves in time with the series, by piece and by what they act on.

    """

    measured: Array
    residuals: Float32Array
    coordinates: Array
    taus: Array
    residual_projectors: list[Array]
    groups: list[slice]
    profile: Array
    waves: dict[tuple[int, str], Any] = field(default_factory=dict, repr=False)
    _coupled: dict[int, Array] = field(default_factory=dict, repr=False)

    @property
    def used(self) -> list[int]:
        """Scatters that are the own estimate of at least one series."""
        return [t for t, columns in enumerate(self.groups) if columns.stop > columns.start]

    def absorbed(self, law: LinearisedModel, blocks: Sequence[Sequence[int]], t: int) -> Absorbed:
        """Compute what the model absorbs at scatter `t` of columns with coefficients for each block of pieces."""
        if len(blocks) == 1:
            rows = coordinate_rows(law, blocks[0])
            return Absorbed([self.residual_projectors[t][np.ix_(rows, rows)]], np.zeros((len(self.coordinates), 0)))
        levels = _level_part(law, float(self.taus[t]))
        if t not in self._coupled:
            self._coupled[t] = _shared_columns(np.eye(len(levels)) - self.residual_projectors[t] - levels @ levels.T)
        return Absorbed([_left_by(levels[coordinate_rows(law, block)]) for block in blocks], self._coupled[t])

    @cached_property
    def projected(self) -> Float32Array:
        """What the model leaves of the coordinates, for every series at its own scatter, (L, D)."""
        out = np.empty(self.coordinates.shape, dtype=np.float32)
        for t in self.used:
            out[:, self.groups[t]] = self.residual_projectors[t] @ self.coordinates[:, self.groups[t]]
        return out


def coordinate_rows(law: LinearisedModel, pieces: Sequence[int]) -> NDArray[np.int_]:
    """Return the rows of the coordinates of some pieces among all L."""
    return np.concatenate([np.arange(len(law.basis_coordinates))[law.coordinate_slices[i]] for i in pieces])


def _level_part(law: LinearisedModel, tau: float) -> Array:
    """Columns (L, R), one per run, whose squares are what a friction level of scatter `tau` absorbs by itself."""
    levels = law.level_coordinates
    if not law.basis.random:
        return np.zeros_like(levels)
    return np.asarray(levels * (tau / np.sqrt(1 + tau**2 * np.sum(levels**2, axis=0))))


def _left_by(levels: Array) -> Array:
    return np.asarray(np.eye(len(levels)) - levels @ levels.T)


def _shared_columns(matrix: Array) -> Array:
    """Columns S (L, p) with S S' a positive semi-definite matrix of low rank."""
    size, directions = np.linalg.eigh(matrix)
    kept = size > MIN_SHARED_SHARE
    return np.asarray(directions[:, kept] * np.sqrt(size[kept]))


def measured_series(law: LinearisedModel) -> ScannedSeries:
    """Return the measured data alone, at the fitted scatter of the levels."""
    data = law.solution.random_effect_data()
    tau, coordinates = law.solution.tau, law.coordinates(data[:, None])
    left = data[:, None] - law.basis.u @ law.fitted_coordinates(coordinates, tau)
    projectors = [law.residual_projector(tau)]
    return ScannedSeries(
        data, left.astype(np.float32), coordinates, np.array([tau]), projectors, [slice(0, 1)], np.zeros((1, 1))
    )
