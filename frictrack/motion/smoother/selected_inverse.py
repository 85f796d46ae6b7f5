"""Variances of combinations of neighbouring unknowns: the part of an inverse near its diagonal, exact, in O(n).

Eliminating all unknowns to one side of a block alters only the corner of its equations that they couple to (Takahashi,
Fagan & Chen 1973, PICA 8, find the same elements one by one). With the corners from both sides, the inverse of two
neighbouring blocks is that part of the whole inverse. Several sets of equations of one size are treated at once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgbsv

from frictrack.records import Array

Index = NDArray[np.int64]
PAIRS_AT_ONCE = 256  # pairs of blocks that are solved at once


class BlockEquations:
    """Symmetric banded equations (F, 2 band + 1, size) in blocks of so many unknowns, the last one padded."""

    def __init__(self, equations: Array, block: int) -> None:
        self.block, self.band = block, equations.shape[1] // 2
        self.many = max(-(-equations.shape[2] // block), 2)
        self.padded = np.zeros((len(equations), equations.shape[1], self.many * block))
        self.padded[:, self.band] = 1.0
        self.padded[:, :, : equations.shape[2]] = equations
        row, column = np.indices((block, block))
        self._places = np.clip(self.band + row - column, 0, 2 * self.band), column, np.abs(row - column) <= self.band
        self.before, self.after = self._corners()

    def _diagonal(self, k: int) -> Array:
        """Equations (F, block, block) within block k."""
        row, column, inside = self._places
        return np.asarray(self.padded[:, :, k * self.block : (k + 1) * self.block][:, row, column] * inside)

    def _link(self, k: int) -> Array:
        """Equations (F, band, band) of the first unknowns of block k + 1 with the last ones of block k."""
        row, column = np.indices((self.band, self.band))
        place = np.minimum(2 * self.band + row - column, 2 * self.band)
        values = self.padded[:, place, (k + 1) * self.block - self.band + column]
        return np.where(row <= column, values, 0.0)

    def _corners(self) -> tuple[Array, Array]:
        """What all before a pair of blocks, and all after it, adds to its corners (F, pairs, band, band)."""
        b, pairs, f = self.band, self.many - 1, len(self.padded)
        before, after = np.zeros((2, f, pairs, b, b))
        known = np.zeros((2 * f, self.block, b))
        for k in range(1, pairs):
            first, last = self._diagonal(k - 1), self._diagonal(self.many - k)
            first[:, :b, :b] += before[:, k - 1]
            last[:, -b:, -b:] += after[:, pairs - k]
            up, down = self._link(k - 1), self._link(pairs - k)
            known[:f, -b:], known[f:, :b] = up.swapaxes(1, 2), down
            found = _solve_symmetric(np.concatenate([first, last]), known)
            before[:, k] = -up @ found[:f, -b:]
            after[:, pairs - k - 1] = -down.swapaxes(1, 2) @ found[f:, :b]
        return before, after

    def solutions(self, first: int, stop: int, right: Array) -> Array:
        """Solutions (F, W, 2 block, columns) of W pairs, first to stop (exclusive), for right sides without the F."""
        b, wide = self.band, 2 * self.block
        column = self.block * np.arange(first, stop)[:, None] + np.arange(wide)
        row = np.arange(wide) + np.arange(-b, b + 1)[:, None]
        bands = np.where(((row >= 0) & (row < wide))[:, None], self.padded[:, :, column], 0.0)
        i, j = np.indices((b, b))
        bands[:, b + i - j, :, j] += np.moveaxis(self.before[:, first:stop], 1, -1).transpose(1, 2, 0, 3)
        bands[:, b + i - j, :, wide - b + j] += np.moveaxis(self.after[:, first:stop], 1, -1).transpose(1, 2, 0, 3)
        flat = bands.reshape(len(bands), 2 * b + 1, -1)
        return np.stack([_solve_banded(b, each, right.reshape(-1, right.shape[-1])) for each in flat]).reshape(
            -1, *right.shape
        )


def selected_variances(equations: Array, block: int, place: Index, weights: Array) -> Array:
    """Variances (F, Q, n) of combinations of unknowns at places (n, p) with weights (Q, n, p), one block apart at most.

    For equations (F, 2 band + 1, size) in bands, and blocks of at least `band` unknowns.
    """
    blocks = BlockEquations(equations, block)
    window = np.minimum(place.min(axis=1) // block, blocks.many - 2)
    slot = np.arange(len(place)) - np.searchsorted(window, window)
    inside = place - window[:, None] * block
    out = np.empty((len(equations), *weights.shape[:2]))
    kinds = np.arange(len(weights))[:, None, None]
    for first in range(0, blocks.many - 1, PAIRS_AT_ONCE):
        stop = min(first + PAIRS_AT_ONCE, blocks.many - 1)
        own = slice(*np.searchsorted(window, [first, stop]))
        at = (window[own, None] - first, inside[own], slot[own, None] * len(weights) + kinds)
        right = np.zeros((stop - first, 2 * block, (int(np.max(slot[own], initial=0)) + 1) * len(weights)))
        right[at] = weights[:, own]
        out[:, :, own] = np.sum(blocks.solutions(first, stop, right)[:, *at] * weights[:, own], axis=-1)
    return out


def _solve_banded(band: int, equations: Array, right: Array) -> Array:
    """Solutions (N, columns) of equations (2 band + 1, N)."""
    room = np.zeros((3 * band + 1, equations.shape[1]))
    room[band:] = equations
    solved = dgbsv(band, band, room, right)
    return np.asarray(solved[2])


def _solve_symmetric(a: Array, right: Array) -> Array:
    """Solutions of symmetric equations (..., n, n), which frames without weight may leave singular."""
    try:
        return np.asarray(np.linalg.solve(a, right))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(a, hermitian=True) @ right)
