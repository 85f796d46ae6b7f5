"""Products of waves from those of few plain waves, by the sampling theorem.

Along a run of length U, a slowly varying envelope times exp(2 pi i q u) is a sum of few plain waves whose frequencies
are `OVERSAMPLING` times closer than 1/U (a Fourier frame; the sum need not be periodic in U). The map from columns to
data is linear, so all products of the columns are the same sums. Effects share the plain waves of time.

References
----------
Adcock, B. & Huybrechs, D. (2019). Frames and numerical approximation. SIAM Review 61, 443-473.

"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import factorial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.base.workers import rows_at_once
from frictrack.fit.linearised.columns import CandidateGrid, ColumnProducts, SeriesOfPiece, column_products
from frictrack.fit.linearised.model import LinearisedModel, LinearisedPiece
from frictrack.records import Array

OVERSAMPLING = 1.5  # plain waves per cell 1/U
N_NEIGHBOURS = 12  # plain waves on either side that make up a wave
N_SAMPLES = 90  # along a run, at which the sums are fitted
N_POWERS = 12  # of a Taylor series: phases up to pi/3, so that the rest is below 1e-8
MIN_SINGULAR_VALUE = 1e-7  # relative; the plain waves nearly depend on one another
MAX_WAVE_ERROR = 5e-5  # of the largest value of a wave
MIN_FRAMES_OF_SUMS = 200  # of a piece: along fewer, waves themselves cost less than sums of plain ones
MIN_WAVES = 101  # frequencies of a grid from which sums are worth their cost
MAX_PLAIN_RATIO = 1.2  # plain waves per frequency of the grid
MAX_PLAIN = 400  # whose Gram matrix is held
MAX_PLAIN_SAMPLES = 1_500_000  # of plain waves held at once
MAX_PRODUCTS_KEPT = 10_000_000  # of plain waves with the draws, over all pieces
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class WaveFrame:
    """Evenly spaced frequencies, and how waves along a coordinate u (m,) are sums of plain ones of these."""

    u: Array

    @cached_property
    def spacing(self) -> float:
        """Distance of neighbouring frequencies."""
        return float(1 / (OVERSAMPLING * np.ptp(self.u)))

    @cached_property
    def middle(self) -> float:
        """Middle of the coordinate."""
        return float(self.u.min() + self.u.max()) / 2

    @cached_property
    def _samples(self) -> tuple[NDArray[np.int_], Array, ComplexArray, ComplexArray]:
        """Samples at which sums are fitted: their places, distances to the middle, plain waves, and their inverse."""
        order = np.argsort(self.u, kind="stable")
        at = order[np.unique(np.linspace(0, len(order) - 1, N_SAMPLES).round().astype(int))]
        s = self.u[at] - self.middle
        plain = np.exp(2j * np.pi * self.spacing * np.outer(s, np.arange(-N_NEIGHBOURS, N_NEIGHBOURS + 1)))
        return at, s, plain, np.asarray(np.linalg.pinv(plain, rcond=MIN_SINGULAR_VALUE), dtype=np.complex128)

    def sums(self, envelope: Array) -> ComplexArray | None:
        """Fit waves of an envelope (m,) by sums of plain ones: coefficients (2 N + 1, N_POWERS).

        They are those of powers of the distance from the nearest frequency. None if the envelope varies too fast.
        """
        at, s, plain, inverse = self._samples
        own, power = envelope[at], np.arange(N_POWERS)
        series = inverse @ (own[:, None] * (2j * np.pi * s[:, None]) ** power / [factorial(p) for p in power])
        farthest = np.array([[-0.5], [0.0], [0.5]]) * self.spacing
        exact = own * np.exp(2j * np.pi * farthest * s)
        error = np.abs(farthest**power @ series.T @ plain.T - exact).max()
        return series if error <= MAX_WAVE_ERROR * np.abs(envelope).max() else None

    def nearest(self, q: Array) -> NDArray[np.int_]:
        """Numbers of the frequencies nearest to some others (Q,)."""
        return np.rint(q / self.spacing).astype(int)

    def weights(self, series: ComplexArray, q: Array) -> tuple[slice, Array]:
        """Numbers of M frequencies, and the weights (Q, 2, 2 M) of their sine and cosine in those at q (Q,)."""
        near, k = self.nearest(q), np.arange(-N_NEIGHBOURS, N_NEIGHBOURS + 1)
        away = q - near * self.spacing
        turns = self.middle * (away[:, None] - self.spacing * k)
        own = ((away[:, None] ** np.arange(N_POWERS)) @ series.T) * np.exp(2j * np.pi * turns)
        used = slice(int(near.min()) - N_NEIGHBOURS, int(near.max()) + N_NEIGHBOURS + 1)
        out = np.zeros((len(q), 2, used.stop - used.start, 2))
        rows, columns = np.arange(len(q))[:, None], near[:, None] + k - used.start
        out[rows, 0, columns, 0] = out[rows, 1, columns, 1] = own.real
        out[rows, 0, columns, 1], out[rows, 1, columns, 0] = own.imag, -own.imag
        return used, out.reshape(len(q), 2, -1)


@dataclass(frozen=True, eq=False)
class PlainWaves:
    """The products of plain waves times an envelope: those of consecutive frequencies of a frame."""

    frame: WaveFrame
    numbers: slice
    products: ColumnProducts  # of one point with a sine and a cosine for every frequency

    def reach(self, u: Array, q: Array) -> bool:
        """Return whether waves along u at frequencies q are sums of these."""
        near = self.frame.nearest(q)
        inside = self.numbers.start <= near.min() - N_NEIGHBOURS and near.max() + N_NEIGHBOURS < self.numbers.stop
        return bool(inside) and np.array_equal(u, self.frame.u)

    def sums(self, series: ComplexArray, q: Array) -> ColumnProducts:
        """Compute the products of waves at frequencies q (Q,) from the coefficients of their sums."""
        used, weights = self.frame.weights(series, q)
        at = slice(2 * (used.start - self.numbers.start), 2 * (used.stop - self.numbers.start))
        flat, own = weights.reshape(2 * len(q), -1), self.products
        scale = own.size[0, at].max()
        draws = (flat * (own.size[0, at] / scale)).astype(np.float32) @ own.draws[0, at]
        return ColumnProducts(
            (flat @ own.gram[0, at, at]).reshape(weights.shape) @ weights.transpose(0, 2, 1),
            weights @ own.data[0, at], weights @ own.coordinates[0, at], np.full((len(q), 2), scale),
            draws.reshape(len(q), 2, -1),
        )  # fmt: skip


class WaveProducts:
    """Products of the waves of a grid along one piece."""

    def __init__(
        self, law: LinearisedModel, grid: CandidateGrid, i: int, series: SeriesOfPiece, kept: dict[Any, Any]
    ) -> None:
        assert grid.effect.scan_wave is not None
        self._wave, self._law, self._grid, self._series, self._kept = grid.effect.scan_wave, law, grid, series, kept
        self._i, self._piece = i, law.pieces[i]
        self._q = self._wave.frequency(grid.values[: grid.shape[-1], -1])
        self._line, self._frame, self._envelope = -1, WaveFrame(np.zeros(0)), np.zeros(0)
        self._plain: PlainWaves | None = None

    def __call__(self, points: slice) -> ColumnProducts:
        """Compute the products at some grid points that differ in frequency only."""
        line, first = divmod(points.start, len(self._q))
        if line != self._line:
            self._begin(line)
        q = self._q[first : first + points.stop - points.start]
        if self._plain is None or not self._plain.reach(self._frame.u, q):
            self._plain = self._plain_waves(q, self._q[first:])
        return self._plain.sums(self._sums, q)

    def _begin(self, line: int) -> None:
        """Find the envelope of the waves of one line of the grid, and what sums of plain waves they are."""
        first = self._grid.values[line * len(self._q)]
        self._line, self._plain = line, None
        self._frame = WaveFrame(_coordinate(self._grid, self._piece, line * len(self._q)))
        sine, cosine = self._grid.raw_columns(self._piece, first[None])[0]
        envelope = ((cosine + 1j * sine) * np.exp(-2j * np.pi * self._q[0] * self._frame.u)).real
        sums, self._envelope = self._frame.sums(envelope), np.ones_like(envelope)
        if sums is None:  # it is left to the plain waves
            sums, self._envelope = self._frame.sums(self._envelope), envelope
        assert sums is not None
        self._sums = sums

    def _plain_waves(self, q: Array, following: Array) -> PlainWaves:
        """Plain waves that reach frequencies q and as many of the following ones as there is room for."""
        u, spacing = self._frame.u, self._frame.spacing
        is_shared = bool(np.all(self._envelope == 1.0)) and u is self._piece.path_for(self._grid.effect).t
        kept, key = self._kept, (self._i, self._grid.effect.acts_on)
        if is_shared and key in kept and kept[key].reach(u, q):
            return kept[key]
        room = min(MAX_PLAIN, MAX_PLAIN_SAMPLES // (2 * len(u))) - 2 * N_NEIGHBOURS
        near = self._frame.nearest(np.concatenate([q, following[np.abs(following - q[0]) < room * spacing]]))
        numbers = slice(int(near.min()) - N_NEIGHBOURS, int(near.max()) + N_NEIGHBOURS + 1)
        made = PlainWaves(self._frame, numbers, self._products(numbers))
        if is_shared and made.products.draws.size * len(self._law.pieces) <= MAX_PRODUCTS_KEPT:
            kept[key] = made
        return made

    def _products(self, numbers: slice) -> ColumnProducts:
        """Products of all sines and cosines, one after the other, with the envelope."""
        u, spacing, frames = self._frame.u, self._frame.spacing, self._law.rows[self._i]
        whitened = np.empty((2 * (numbers.stop - numbers.start), frames.stop - frames.start))
        step, at_once = np.exp(2j * np.pi * spacing * u), rows_at_once(2 * len(u))
        for first in range(numbers.start, numbers.stop, at_once):
            columns = np.empty((min(at_once, numbers.stop - first), 2, len(u)))
            wave = self._envelope * np.exp(2j * np.pi * spacing * first * u)
            for column in columns:
                column[0], column[1] = wave.imag, wave.real
                wave = wave * step
            rows = self._piece.whitened_rows(columns.reshape(-1, len(u)), self._grid.effect.acts_on == "measurement")
            at = 2 * (first - numbers.start)
            whitened[at : at + len(rows)] = rows
        return column_products(self._piece, whitened, len(whitened), self._series)


def _coordinate(grid: CandidateGrid, piece: LinearisedPiece, g: int) -> Array:
    """The coordinate u (m,) of the waves at a grid point."""
    assert grid.effect.scan_wave is not None
    return grid.effect.scan_wave.coordinate(piece.path_for(grid.effect), grid.point(g))


def are_sums_of_waves(grid: CandidateGrid, piece: LinearisedPiece) -> bool:
    """Return whether the columns of a grid along one piece are waves of fewer plain ones than it has frequencies."""
    wave = grid.effect.scan_wave
    if wave is None or grid.names[-1:] != (wave.parameter,) or grid.shape[-1] < MIN_WAVES:
        return False
    if not grid.k == len(grid.phases) == 2 or len(piece.path_for(grid.effect).t) < MIN_FRAMES_OF_SUMS:
        return False
    q = wave.frequency(grid.values[: grid.shape[-1], -1])
    lengths = [float(np.ptp(_coordinate(grid, piece, g))) for g in range(0, len(grid.values), len(q))]
    plain = np.ptp(q) * OVERSAMPLING * max(lengths) + 2 * N_NEIGHBOURS
    return min(lengths) > 0 and bool(plain <= MAX_PLAIN_RATIO * len(q))
