"""Positions of the unknowns of a smoother in its banded equations, and the coefficients among them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from frictrack.motion.smoother.smoother_data import TREND_ORDER, LineParameters, SmootherData
from frictrack.records import Array

FOURTH_DIFFERENCE, SECOND_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0]), np.array([1.0, -2.0, 1.0])
BLOCK_FRAMES = 8  # frames per block of the covariance
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class EquationPart:
    """Equations of some frames of a record.

    Attributes
    ----------
    frames
        The frames.
    components
        Positions of their unknowns, by component.
    differences
        Rows of each difference among all of the record, and positions of their unknowns.
    bands
        Coefficients in LAPACK band storage, (3 band + 1, size); the top rows are for fill-in.
    before, after
        Coefficients of the last unknowns before the part with its first ones, and of its last ones with the first ones
        after it, (band, band).

    """

    frames: slice
    components: list[Index]
    differences: list[tuple[slice, Index]]
    bands: Array
    before: Array
    after: Array


class EquationLayout:
    """Positions of all unknowns in the banded equations of n frames and K lines.

    The equations are the augmented ones, [A, P'; P, -1] [u; s] = [W y; p], with the weighted differences P and their
    expected values p. Their condition number is the square root of that of A + P'P, which is large for a low cut-off.
    The unknowns of one frame are adjacent.
    """

    def __init__(self, n: int, lines: int, has_sensor: bool, has_colour: bool) -> None:
        self.n, self.k = n, lines
        # Components and order of each difference.
        self.terms: list[tuple[tuple[int, ...], int]] = [((0,), TREND_ORDER), *[((k,), 2) for k in range(1, lines + 1)]]
        if has_colour:
            self.terms.append(((lines + 1,), 1))
        if has_sensor:
            self.terms.append((tuple(range(lines + 1)), 2))
        n_components = 1 + lines + has_colour  # components of the positions
        keys = [np.arange(n) + 0.01 * k for k in range(n_components)]
        keys += [np.arange(n - d) + d / 2 + 0.3 + 0.01 * k for k, (_, d) in enumerate(self.terms)]
        order = np.argsort(np.concatenate(keys), kind="stable")
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        found = np.split(place, np.cumsum([len(k) for k in keys])[:-1])
        self.components, self.multiplier = found[:n_components], found[n_components:]
        self.size, self.group = len(order), n_components + len(self.terms)
        steps = [
            int(np.abs(m - self.components[k][i : len(m) + i]).max())
            for (components, d), m in zip(self.terms, self.multiplier, strict=True)
            for k in components
            for i in range(d + 1)
        ]
        self.band = max([*steps, n_components - 1])
        rows, columns = np.meshgrid(np.arange(n_components), np.arange(n_components), indexing="ij")
        self._of_weights = self._place(np.array(self.components)[rows], np.array(self.components)[columns])
        self._of_terms = [self._places_of_term(*term) for term in zip(self.terms, self.multiplier, strict=True)]
        self._constant = np.zeros(((3 * self.band + 1) * self.size,))
        self._constant[self._place(m := np.concatenate(self.multiplier), m)] = -1.0

    def _place(self, row: Index, column: Index) -> Index:
        """Positions of matrix elements in band storage, column after column."""
        return (3 * self.band + 1) * column + 2 * self.band + row - column

    def _places_of_term(self, term: tuple[tuple[int, ...], int], m: Index) -> Index:
        """Positions of the coefficients of one difference in rows and in columns, (2, components, order + 1, m)."""
        components, order = term
        x = np.array([[self.components[k][i : len(m) + i] for i in range(order + 1)] for k in components])
        rows = np.broadcast_to(m, x.shape)
        return np.array([self._place(rows, x), self._place(x, rows)])

    def block(self, size: int) -> int:
        """Unknowns per block of `size`; the last block must not be short, or trend and line would be degenerate."""
        sizes = range(BLOCK_FRAMES * self.group, 2 * BLOCK_FRAMES * self.group)
        return next(b for b in sizes if size % b == 0 or size % b >= b // 2)

    def equations(self, data: SmootherData, w: Array, lam: Array, lines: LineParameters) -> Array:
        """Equations in LAPACK band storage (3 band + 1, size) for weights w (n,); the top rows are for fill-in."""
        colour = data.colour
        flat = self._constant.copy()
        flat[self._of_weights] = w
        if colour:
            first = self.components[-1][:1]
            flat[self._place(first, first)] += 1.0 / colour.share
        for places, (strength, difference) in zip(self._of_terms, _differences(data, lam, lines), strict=True):
            flat[places] = difference[:, None] * strength
        return flat.reshape((3 * self.band + 1, self.size), order="F")

    def part(self, bands: Array, first: int, stop: int, begin: int) -> EquationPart:
        """Cut the equations of frames first to stop (exclusive) out of all; frame 0 is frame `begin` of the record."""
        low = int(self.components[0][first]) if first else 0
        high = int(self.components[0][stop]) if stop < self.n else self.size
        rows = [np.searchsorted(m, [low, high]).tolist() for m in self.multiplier]
        return EquationPart(
            slice(begin + first, begin + stop),
            [c[first:stop] - low for c in self.components],
            [(slice(begin + i, begin + j), m[i:j] - low) for (i, j), m in zip(rows, self.multiplier, strict=True)],
            bands[:, low:high],
            self._coupling(bands, low),
            self._coupling(bands, high),
        )

    def _coupling(self, bands: Array, place: int) -> Array:
        """Coefficients of the last unknowns before a place with the first ones from there on, (band, band)."""
        b = self.band
        out = np.zeros((b, b))
        if 0 < place < self.size:
            row, column = np.tril_indices(b)
            out[row, column] = bands[b + row - column, place + column]
        return out


def _differences(data: SmootherData, lam: Array, lines: LineParameters) -> Iterator[tuple[Array | float, Array]]:
    """Yield the strength of each difference and its coefficients."""
    yield np.sqrt(lam), FOURTH_DIFFERENCE
    for omega, mu in zip(lines.omega, lines.mu, strict=True):
        yield np.sqrt(mu), np.array([1.0, -2.0 * np.cos(omega), 1.0])
    if data.colour:
        yield data.colour.shocks**-0.5, np.array([-data.colour.correlation, 1.0])
    if data.second_difference_weights is not None:
        yield np.sqrt(data.second_difference_weights), SECOND_DIFFERENCE


@lru_cache(maxsize=64)
def equation_layout(n: int, lines: int, has_sensor: bool, has_colour: bool) -> EquationLayout:
    """Layout for n frames, cached."""
    return EquationLayout(n, lines, has_sensor, has_colour)
