"""Compute variances of combinations of neighbouring unknowns of banded equations, in O(n).

They need only the inverse near its diagonal.

Eliminating all unknowns on one side of a block changes only the corner of its equations that they couple to (Takahashi,
Fagan & Chen 1973, PICA 8, compute the same elements one by one). With the corners of both sides, the inverse of two
neighbouring blocks equals that part of the full inverse. Several matrices of one size are treated at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from frictrack.motion.smoother.equation_layout import EquationLayout, EquationPart, Index
from frictrack.records import Array

PAIRS_AT_ONCE = 256  # pairs of blocks solved in one call


class BlockEquations:
    """F parts of one size in blocks of unknowns, of which the last one is padded."""

    def __init__(self, parts: Sequence[EquationPart], layout: EquationLayout) -> None:
        size, self.band = parts[0].bands.shape[1], layout.band
        self.block = layout.block(size)
        self.many = max(-(-size // self.block), 2)
        self.padded = np.zeros((len(parts), 2 * self.band + 1, self.many * self.block))
        self.padded[:, self.band] = 1.0
        for own, part in zip(self.padded, parts, strict=True):
            own[:, :size] = part.bands[self.band :]
        self.before, self.after = self._corners()

    def _corners(self) -> tuple[Array, Array]:
        """Contributions of all blocks before and after each pair to its corners, two (F, pairs, band, band)."""
        b, pairs, f = self.band, self.many - 1, len(self.padded)
        before, after = np.zeros((2, f, pairs, b, b))
        known = np.zeros((2 * f, self.block, b))
        # equations within a block, and of the first unknowns of a block with the last ones before it, block by block:
        # those of all blocks would take far more memory
        row, column = np.indices((self.block, self.block))
        inside, place = np.abs(row - column) <= b, np.clip(b + row - column, 0, 2 * b)
        near, far = row[:b, :b] <= column[:b, :b], np.minimum(2 * b + row - column, 2 * b)[:b, :b]
        for k in range(1, pairs):
            blocks = (self.padded[:, place, self.block * i + column] for i in (k - 1, self.many - k))
            both = np.concatenate([np.where(inside, one, 0.0) for one in blocks])
            both[:f, :b, :b] += before[:, k - 1]
            both[f:, -b:, -b:] += after[:, pairs - k]
            ends = (self.block * i - b + column[:b, :b] for i in (k, pairs - k + 1))
            up, down = (np.where(near, self.padded[:, far, end], 0.0) for end in ends)
            known[:f, -b:], known[f:, :b] = up.swapaxes(1, 2), down
            found = _solve_symmetric(both, known)
            before[:, k] = -up @ found[:f, -b:]
            after[:, pairs - k - 1] = -down.swapaxes(1, 2) @ found[f:, :b]
        return before, after

    def variances(self, own: slice, place: Index, weights: Array) -> Array:
        """Compute variances of linear combinations of unknowns that lie at most one block apart.

        Parameters
        ----------
        own
            Those of the matrices that count.
        place
            Unknowns of each combination, (n, p).
        weights
            Q sets of weights, (Q, n, p).

        Returns
        -------
        Array
            Variances, (F, Q, n).

        References
        ----------
        Takahashi, Fagan & Chen 1973, 8th PICA Conference Proc.

        """
        window = np.minimum(place.min(axis=1) // self.block, self.many - 2)
        slot = np.arange(len(place)) - np.searchsorted(window, window)
        inside = place - window[:, None] * self.block
        out = np.empty((len(self.padded[own]), *weights.shape[:2]))
        kinds = np.arange(len(weights))[:, None, None]
        for first in range(0, self.many - 1, PAIRS_AT_ONCE):
            stop = min(first + PAIRS_AT_ONCE, self.many - 1)
            rows = slice(*np.searchsorted(window, [first, stop]))
            at = (window[rows, None] - first, inside[rows], slot[rows, None] * len(weights) + kinds)
            right = np.zeros((stop - first, 2 * self.block, (int(np.max(slot[rows], initial=0)) + 1) * len(weights)))
            right[at] = weights[:, rows]
            found = self._solutions(own, first, stop, right)
            out[:, :, rows] = np.sum(found[:, *at] * weights[:, rows], axis=-1)
        return out

    def _solutions(self, own: slice, first: int, stop: int, right: Array) -> Array:
        """Solutions (F, W, 2 block, columns) of W pairs first to stop (exclusive), for right-hand sides (W, ...)."""
        b, wide = self.band, 2 * self.block
        column = self.block * np.arange(first, stop)[:, None] + np.arange(wide)
        row = np.arange(wide) + np.arange(-b, b + 1)[:, None]
        bands = np.where(((row >= 0) & (row < wide))[:, None], self.padded[own][:, :, column], 0.0)
        i, j = np.indices((b, b))
        bands[:, b + i - j, :, j] += np.moveaxis(self.before[own, first:stop], 1, -1).transpose(1, 2, 0, 3)
        bands[:, b + i - j, :, wide - b + j] += np.moveaxis(self.after[own, first:stop], 1, -1).transpose(1, 2, 0, 3)
        flat = bands.reshape(len(bands), 2 * b + 1, -1)
        return np.stack([_solve_banded(b, each, right.reshape(-1, right.shape[-1])) for each in flat]).reshape(
            -1, *right.shape
        )


def _solve_banded(band: int, equations: Array, right: Array) -> Array:
    """Solutions (N, columns) of equations (2 band + 1, N)."""
    bands = np.zeros((3 * band + 1, equations.shape[1]), order="F")  # as LAPACK takes them, without another copy
    bands[band:] = equations
    solved = scipy.linalg.lapack.dgbsv(band, band, bands, right, overwrite_ab=1)
    return np.asarray(solved[2])


def _solve_symmetric(a: Array, right: Array) -> Array:
    """Solutions of symmetric equations (..., n, n); frames without weight may make them singular."""
    try:
        return np.asarray(np.linalg.solve(a, right))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(a, hermitian=True) @ right)
