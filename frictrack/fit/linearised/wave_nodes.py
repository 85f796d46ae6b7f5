"""Compute the columns of waves from those of few plain waves, by the sampling theorem.

Along a run of length U, a slowly varying envelope times exp(2 pi i q u) is a sum of few plain waves whose frequencies
are `OVERSAMPLING` times closer than 1/U (a Fourier frame; the sum need not be periodic in U). The map from columns to
data is linear, so all products of the columns are the same sums. Vibrations, modulated loads and decaying vibrations
share the plain waves of time, and only these are compared with the data series.

References
----------
Adcock, B. & Huybrechs, D. (2019). Frames and numerical approximation. SIAM Review 61, 443-473.

"""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.linearised.grid import CandidateGrid
from frictrack.fit.linearised.model import LinearisedModel, LinearisedPiece
from frictrack.fit.linearised.series import Float32Array
from frictrack.records import Array

OVERSAMPLING = 1.5  # plain waves per cell 1/U
N_NEIGHBOURS = 12  # plain waves on either side that make up a wave
N_SAMPLES = 90  # along a run, at which the sums are fitted
N_POWERS = 12  # of a Taylor series: phases up to pi/3, so that the rest is below 1e-8
MIN_SINGULAR_VALUE = 1e-7  # relative; the plain waves nearly depend on one another
MAX_WAVE_ERROR = 5e-5  # of the largest value of a wave
MAX_ENVELOPE_CHANGE = 1e-9  # of waves of one size
MIN_WAVES = 101  # frequencies of a grid from which sums are worth their cost
MAX_NODE_RATIO = 1.2  # plain waves per frequency of the grid
MAX_NODES = 400  # whose Gram matrix is held
MAX_NODE_SAMPLES = 6_000_000  # of columns at the nodes, held at once
WAVES_AT_ONCE = 48

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class WaveNodes:
    """Frequencies of plain waves along one piece, and sums of them.

    Attributes
    ----------
    u : array of shape (m,)
        Coordinate along the piece.
    q : array of shape (M,)
        Frequencies, evenly spaced.

    """

    u: Array
    q: Array

    @property
    def spacing(self) -> float:
        """Distance of neighbouring frequencies."""
        return float(self.q[1] - self.q[0])

    @property
    def middle(self) -> float:
        """Middle of the coordinate."""
        return float(self.u.min() + self.u.max()) / 2

    def reaches(self, u: Array, q: Array) -> bool:
        """Return whether waves along `u` at frequencies q are sums of these."""
        room = N_NEIGHBOURS * self.spacing
        inside = self.q[0] + room <= q.min() and q.max() <= self.q[-1] - room
        return bool(inside) and np.array_equal(u, self.u)

    def columns(self, base: Array | float) -> Array:
        """Sine and cosine (2 M, m) of the plain waves times `base` (m,)."""
        out = np.empty((len(self.q), 2, len(self.u)))
        wave: ComplexArray = base * np.exp(2j * np.pi * self.q[0] * self.u)
        step = np.exp(2j * np.pi * self.spacing * self.u)
        for row in out:
            row[0], row[1] = wave.imag, wave.real
            wave = wave * step
        return out.reshape(-1, len(self.u))

    def sums(self, envelope: Array, q: Array) -> _WaveSums | None:
        """Fit waves of some envelope (m,) by sums of the plain ones; None if it varies too fast."""
        at, s, plain, inverse = self._samples
        own, power = envelope[at], np.arange(N_POWERS)
        turned = own[:, None] * (2j * np.pi * s[:, None]) ** power / [factorial(p) for p in power]
        series = inverse @ turned  # (2 N + 1, N_POWERS)
        farthest = (np.array([[-0.5], [0.0], [0.5]]) * self.spacing) ** power
        exact = own * np.exp(2j * np.pi * np.array([[-0.5], [0.0], [0.5]]) * self.spacing * s)
        error = np.abs(farthest @ series.T @ plain.T - exact).max()
        return _WaveSums(self, series, q) if error <= MAX_WAVE_ERROR * np.abs(envelope).max() else None

    @cached_property
    def _samples(self) -> tuple[NDArray[np.int_], Array, ComplexArray, ComplexArray]:
        """Samples at which sums are fitted: their places, distances to the middle, plain waves, and their inverse."""
        order = np.argsort(self.u, kind="stable")
        at = order[np.unique(np.linspace(0, len(order) - 1, N_SAMPLES).round().astype(int))]
        s = self.u[at] - self.middle
        plain = np.exp(2j * np.pi * self.spacing * np.outer(s, np.arange(-N_NEIGHBOURS, N_NEIGHBOURS + 1)))
        inverse: ComplexArray = np.asarray(np.linalg.pinv(plain, rcond=MIN_SINGULAR_VALUE), dtype=np.complex128)
        return at, s, plain, inverse


@dataclass(frozen=True, eq=False)
class _WaveSums:
    """Waves as sums of plain ones: coefficients (2 N + 1, N_POWERS) of powers of the distance to the nearest."""

    nodes: WaveNodes
    series: ComplexArray
    q: Array

    def chunks(self) -> Iterator[tuple[slice, slice, Array]]:
        """Yield some waves, the plain waves that they need, and weights (2 G, 2 M) of sine and cosine."""
        nodes, k = self.nodes, np.arange(-N_NEIGHBOURS, N_NEIGHBOURS + 1)
        nearest = np.rint((self.q - nodes.q[0]) / nodes.spacing).astype(int)
        away = self.q - nodes.q[nearest]
        weights = (away[:, None] ** np.arange(N_POWERS)) @ self.series.T  # (G, 2 N + 1)
        weights = weights * np.exp(2j * np.pi * nodes.middle * (away[:, None] - nodes.spacing * k))
        for first in range(0, len(self.q), WAVES_AT_ONCE):
            part = slice(first, min(first + WAVES_AT_ONCE, len(self.q)))
            low, high = nearest[part].min() - N_NEIGHBOURS, nearest[part].max() + N_NEIGHBOURS + 1
            yield part, slice(int(low), int(high)), _real(weights[part], nearest[part] - N_NEIGHBOURS - low, high - low)


def _real(weights: ComplexArray, first: NDArray[np.int_], count: int) -> Array:
    """Weights (2 G, 2 count) of sine and cosine from complex ones (G, K), which begin at `first` (G,)."""
    out = np.zeros((len(weights), 2, count, 2))
    rows, columns = np.arange(len(weights))[:, None], first[:, None] + np.arange(weights.shape[1])
    out[rows, 0, columns, 0] = out[rows, 1, columns, 1] = weights.real
    out[rows, 0, columns, 1] = weights.imag
    out[rows, 1, columns, 0] = -weights.imag
    return out.reshape(2 * len(weights), -1)


@dataclass(frozen=True, eq=False)
class NodeProducts:
    """Plain waves along one piece and their products, as in `ColumnSums`; with the series over `size` (2 M,)."""

    nodes: WaveNodes
    gram: Array
    coordinates: Array
    data: Array
    products: Float32Array
    size: Array


@dataclass(frozen=True, eq=False)
class WaveStretch:
    """Some grid points that differ in frequency only: their envelope (m,) along a piece, and their frequencies."""

    points: slice
    u: Array
    envelope: Array
    q: Array
    is_time: bool

    def nodes(self) -> WaveNodes:
        """Plain waves whose sums reach all frequencies."""
        spacing = 1 / (OVERSAMPLING * float(np.ptp(self.u)))
        first = self.q.min() - (N_NEIGHBOURS + 1) * spacing
        count = int(np.ceil((self.q.max() - first) / spacing)) + N_NEIGHBOURS + 2
        return WaveNodes(self.u, first + spacing * np.arange(count))


def wave_stretches(grid: CandidateGrid, piece: LinearisedPiece) -> list[WaveStretch]:
    """Divide a grid along one piece into stretches of waves; empty if every grid point is to be computed itself."""
    wave = grid.effect.scan_wave
    if wave is None or grid.k != len(grid.phases) != 1 or grid.names[-1:] != (wave.parameter,):
        return []
    q, path = wave.frequency(grid.values[: grid.shape[-1], -1]), piece.path_for(grid.effect)
    out: list[WaveStretch] = []
    for first in range(0, len(grid.values), len(q)):
        u = wave.coordinate(path, grid.point(first))
        per_node = 1 / (OVERSAMPLING * float(np.ptp(u))) if np.ptp(u) else np.inf
        if len(q) < MIN_WAVES or np.ptp(q) / per_node + 2 * N_NEIGHBOURS > MAX_NODE_RATIO * len(q):
            return []
        sine, cosine = grid.raw_columns(piece, grid.values[first : first + 1])[0]
        envelope = ((cosine + 1j * sine) * np.exp(-2j * np.pi * q[0] * u)).real
        room = min(MAX_NODES, MAX_NODE_SAMPLES // (2 * len(u))) - 2 * N_NEIGHBOURS
        size = int(np.clip(room * len(q) * per_node / np.ptp(q), 1, len(q)))
        for at in range(0, len(q), size):
            points = slice(first + at, first + min(at + size, len(q)))
            out.append(WaveStretch(points, u, envelope, q[at : at + size], np.array_equal(u, path.t)))
    return out


def constant_waves(law: LinearisedModel, grid: CandidateGrid) -> tuple[Hashable, list[float]] | None:
    """Return what the waves of a grid are but for their size, and that size in every block of runs.

    None if the grid is computed point by point, or if waves of one block vary in size.
    """
    every = [wave_stretches(grid, law.pieces[i]) for i in grid.members]
    sizes = [[float(s.envelope[0]) for s in stretches] for stretches in every]
    of_blocks = [np.array([size for m in block for size in sizes[m]]) for block in grid.blocks]
    flat = all(np.ptp(s.envelope) <= MAX_ENVELOPE_CHANGE * abs(s.envelope[0]) for own in every for s in own)
    if not all(every) or not flat or any(np.ptp(own) > MAX_ENVELOPE_CHANGE * abs(own[0]) for own in of_blocks):
        return None
    waves = tuple((s.points.start, s.points.stop, s.q.tobytes(), s.u.tobytes()) for own in every for s in own)
    return (grid.effect.acts_on, grid.members, grid.block, waves), [float(own[0]) for own in of_blocks]
