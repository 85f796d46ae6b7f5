"""Compute the gains of all grid points of a scan beside a solution, in closed form.

The free rows of the solution are projected out of the table. Where an effect of the solution moves to another grid
point, its own rows come back by a low-rank update, so that one projection serves every move.

References
----------
Golub, G. H. & Van Loan, C. F. (2013). Matrix Computations, sec. 2.1.4. Johns Hopkins University Press.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.separable.model import Indices
from frictrack.fit.separable.newton import SeparableSolution
from frictrack.records import Array, Mask

MIN_UNEXPLAINED_SHARE = 1e-6  # smallest share of a column outside the model
MIN_GRID_STEPS_APART = 3  # grid steps; closer points count as the same
Box = tuple[Array | float, Array | float]


@dataclass(frozen=True, eq=False)
class ScanGrid:
    """Points of a scan: `values` (G, d) of the parameters `names`, and their grid indices `steps` (G, d)."""

    names: tuple[str, ...]
    values: Array
    steps: NDArray[np.int_]

    def shortened(self) -> ScanGrid:
        """Return the grid without its last point."""
        return ScanGrid(self.names, self.values[:-1], self.steps[:-1])


@dataclass(frozen=True, eq=False)
class TableScan:
    """Gain of every grid point, (G,), and its coefficients (G, C).

    `loss` is the rise of the misfit where an effect leaves its position before the gain.
    """

    grid: ScanGrid
    gains: Array
    coefficients: Array
    loss: float = 0.0

    def best_distinct(self, most: int) -> list[int]:
        """Return the points of the largest gains, none within `MIN_GRID_STEPS_APART` steps of a better one."""
        chosen: list[int] = []
        left = self.gains.copy()
        for _ in range(most):
            best = int(np.argmax(left))
            if left[best] <= 0:
                break
            chosen.append(best)
            left[np.all(np.abs(self.grid.steps - self.grid.steps[best]) <= MIN_GRID_STEPS_APART, axis=1)] = 0.0
        return chosen


class ProjectedTable:
    """A table beside a solution, whose free rows and friction levels are projected out.

    Parameters
    ----------
    grid : ScanGrid
        The G points.
    gram : array of shape (G, C, C)
        Gram matrices of the table.
    state : SeparableSolution
        The solution, with K coefficients and R friction levels.
    products : tuple of (array of shape (K + R, G, C), array of shape (G, C))
        Inner products of the table with the rows of the solution and of its levels, and with its residual.

    """

    def __init__(self, grid: ScanGrid, gram: Array, state: SeparableSolution, products: tuple[Array, Array]) -> None:
        self.grid, self.full = grid, np.einsum("gcc->gc", gram)
        cross, self.right = products
        free = np.concatenate([state.unconstrained, state.levels.rows.any(axis=1)])
        self.inverse, size, gradient = _free_rows(state, free)
        self.place = np.where(free, np.cumsum(free) - 1, -1)[: len(state.coefficients)]
        rows = (cross if free.all() else cross[free]) / size[:, None, None]
        self.dual = (self.inverse @ rows.reshape(len(size), gram.shape[0] * gram.shape[1])).reshape(rows.shape)
        self.schur = gram - _outer_sum(self.dual, rows)
        step = self.inverse @ gradient
        self.gain_of_free_rows = float(gradient @ step)
        self.coefficients = state.coefficients[free[: len(state.coefficients)]] * size[: free[: len(self.place)].sum()]
        self.coefficients = self.coefficients + step[: len(self.coefficients)]
        if len(state.levels.rows):
            self.right = self.right - (gradient @ self.dual.reshape(len(size), self.right.size)).reshape(
                self.right.shape
            )

    def one_more(self, box: Box) -> TableScan:
        """Return the gains of one more effect at every grid point."""
        c, gains = _best_coefficients(self.schur, self.right, self.full, box)
        return TableScan(self.grid, gains + self.gain_of_free_rows, c)

    def moved(self, mine: Indices, box: Box) -> TableScan:
        """Return the gains of every grid point where the coefficients `mine` of the solution leave it."""
        own = self.place[mine]
        own = own[own >= 0]
        if not len(own):
            return self.one_more(box)
        dual, coefficients = self.dual[own], self.coefficients[own]
        precision = np.linalg.inv(self.inverse[own[:, None], own])
        lift: Array = np.asarray(precision @ dual.reshape(len(own), -1)).reshape(dual.shape)
        right = self.right + (coefficients @ lift.reshape(len(own), -1)).reshape(self.right.shape)
        schur: Array = self.schur + _outer_sum(dual, lift)
        c, gains = _best_coefficients(schur, right, self.full, box)
        return TableScan(self.grid, gains, c, float(coefficients @ precision @ coefficients) - self.gain_of_free_rows)


def _outer_sum(left: Array, right: Array) -> Array:
    """Sums over k of the products (G, C, C) of rows (k, G, C)."""
    if left.shape[2] == 1:
        return np.asarray((left * right).sum(axis=0)[:, :, None])
    return np.asarray(np.matmul(left.transpose(1, 2, 0), right.transpose(1, 0, 2)))


def _best_coefficients(schur: Array, right: Array, full: Array, box: Box) -> tuple[Array, Array]:
    """Coefficients (G, C) within a box, and the gains (G,) with them."""
    c = _solve(schur, right, full)
    if np.any((c < box[0]) | (c > box[1])):
        c = np.clip(c, *box)
        return c, np.einsum("gc,gc->g", c, 2 * right - np.einsum("gij,gj->gi", schur, c))
    return c, np.einsum("gc,gc->g", c, right)


def _free_rows(state: SeparableSolution, free: Mask) -> tuple[Array, Array, Array]:
    """Inverse Gram matrix of the free rows and levels (k,), in units of their sizes (k,), and gradients (k,)."""
    rows = np.concatenate([state.rows, state.levels.rows])[free]
    k, own = len(state.coefficients), state.levels
    precision, gradient = np.zeros((len(free), len(free))), np.zeros(len(free))
    precision[k:, k:], gradient[k:] = own.precision, own.gradient
    gram = rows @ rows.T + precision[np.ix_(free, free)]
    size = np.sqrt(gram.diagonal())
    unit = gram / size / size[:, None]
    unit.flat[:: len(size) + 1] += 1e-12
    return np.linalg.inv(unit), size, gradient[free] / size


def _solve(schur: Array, residual_products: Array, full: Array) -> Array:
    """Best coefficients (G, C) for projected Gram matrices; points that the model absorbs get zero."""
    count = schur.shape[1]
    floor = MIN_UNEXPLAINED_SHARE * full
    if count == 1:
        own = schur[:, :, 0]
        return residual_products / np.where(own > floor, own, np.inf)
    if count == 2:
        a, b, d = schur[:, 0, 0], schur[:, 0, 1], schur[:, 1, 1]
        det = a * d - b * b
        good = det > MIN_UNEXPLAINED_SHARE * full[:, 0] * full[:, 1]
        det = np.where(good, det, np.inf)
        out = np.stack(
            [
                (d * residual_products[:, 0] - b * residual_products[:, 1]) / det,
                (a * residual_products[:, 1] - b * residual_products[:, 0]) / det,
            ],
            axis=1,
        )
        return out
    size = np.sqrt(np.where(full > 0, full, 1.0))
    unit = schur / size[:, :, None] / size[:, None, :] + MIN_UNEXPLAINED_SHARE * np.eye(count)
    return np.linalg.solve(unit, (residual_products / size)[:, :, None])[:, :, 0] / size
