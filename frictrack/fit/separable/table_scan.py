"""Compute the gains of all grid points of a scan added to a solution, in closed form.

The free rows of the solution are projected out of the table. Where an effect of the solution moves to another grid
point, its own rows come back by a low-rank update, so that one projection serves every move.

References
----------
Golub, G. H. & Van Loan, C. F. (2013). Matrix Computations, sec. 2.1.4. Johns Hopkins University Press.

"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.separable.newton import SeparableSolution
from frictrack.records import Array, Mask

RIDGE = 1e-12  # relative; keeps nearly equal rows solvable
MIN_UNEXPLAINED_SHARE = 1e-6  # smallest share of a column outside the model
Box = tuple[Array, Array] | None  # None without bounds


@dataclass(frozen=True, eq=False)
class ScanGrid:
    """All combinations of values along the axes of some parameters, in row-major order."""

    names: tuple[str, ...]
    axes: tuple[Array, ...]

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Number of grid points along every axis."""
        return tuple(len(axis) for axis in self.axes)

    @cached_property
    def values(self) -> Array:
        """Values of the parameters at the G points, (G, d)."""
        return np.array(list(product(*self.axes)))

    @cached_property
    def steps(self) -> NDArray[np.int_]:
        """Grid indices of the points, (G, d)."""
        return np.array(list(product(*map(range, self.shape))))

    def nearest(self, values: Array) -> int:
        """Return the grid point nearest to values (d,)."""
        at = [int(np.argmin(np.abs(axis - v))) for axis, v in zip(self.axes, values, strict=True)]
        return int(np.ravel_multi_index(at, self.shape))

    def peaks(self, heights: Array, least: float) -> NDArray[np.int_]:
        """Return the points not below their neighbours on any axis, with at least some height (G,), highest first."""
        cube = heights.reshape(self.shape)
        is_peak = cube >= least
        for axis in range(cube.ndim):
            peak, rise = np.moveaxis(is_peak, axis, 0), np.diff(np.moveaxis(cube, axis, 0), axis=0)
            peak[1:] &= rise >= 0
            peak[:-1] &= rise <= 0
        found = np.flatnonzero(is_peak)
        return found[np.argsort(-heights[found], kind="stable")]

    def summit(self, heights: Array, g: int) -> Array:
        """Return the values (d,) of the vertex of parabolas through a peak (G,) at a point and its neighbours."""
        out, cube, at = self.values[g].copy(), heights.reshape(self.shape), tuple(self.steps[g].tolist())
        for i, (axis, step) in enumerate(zip(self.axes, at, strict=True)):
            if 0 < step < len(axis) - 1:
                around = slice(step - 1, step + 2)
                out[i] = _vertex(axis[around], cube[(*at[:i], around, *at[i + 1 :])])
        return out

    def weights(self, g: int, values: Array) -> tuple[NDArray[np.int_], Array]:
        """Return points, and weights that interpolate between them at values near a point, on one axis by parabolas.

        There are none on a grid of several axes, which are too coarse for that.
        """
        if len(self.names) > 1:
            return np.zeros(0, dtype=int), np.zeros(0)
        if not 0 < g < len(self.values) - 1:
            return np.array([g]), np.ones(1)
        a, b, c = self.axes[0][g - 1 : g + 2]
        x = float(values[0])
        parts = [(x - b) * (x - c) / ((a - b) * (a - c)), (x - a) * (x - c) / ((b - a) * (b - c))]
        return np.arange(g - 1, g + 2), np.array([*parts, 1.0 - sum(parts)])


def _vertex(x: Array, y: Array) -> float:
    """Place of the vertex of the parabola through three points of which the middle one is the highest."""
    left, right = np.diff(y) / np.diff(x) * [1, -1]
    if not left + right > 0:
        return float(x[1])
    return float(x[1] + 0.5 * (left * (x[2] - x[1]) - right * (x[1] - x[0])) / (left + right))


@dataclass(frozen=True, eq=False)
class TableScan:
    """Gain of every grid point, (G,).

    `loss` is the rise of the misfit where an effect leaves its position before the gain.
    """

    grid: ScanGrid
    gains: Array
    loss: float = 0.0

    @property
    def largest(self) -> float:
        """The largest gain."""
        return float(self.gains[self.best])

    @cached_property
    def best(self) -> int:
        """The point of the largest gain."""
        return int(np.argmax(self.gains))

    def peaks(self, least: float) -> NDArray[np.int_]:
        """Return the points where the gain is positive, at least `least` and a local maximum, best first."""
        return self.grid.peaks(self.gains, max(least, np.finfo(float).tiny))

    def summit(self, g: int) -> Array:
        """Return the values (d,) of the parameters at the local maximum next to a grid point."""
        return self.grid.summit(self.gains, g)


@dataclass(frozen=True, eq=False)
class FreeRows:
    """The free rows of a solution and of its tangent, k in all, which are projected out of every table.

    Beside the tangent a scan shows what a grid point gains after the other parameters have followed it, to first
    order. Without it a sinusoid of few periods hides a better exponential, and the other way round.

    Attributes
    ----------
    free : array of bool, shape (K + R,)
        Which coefficients and parameters are free.
    size : array of shape (k,)
        Lengths of the rows.
    inverse : array of shape (k, k)
        Inverse Gram matrix of the rows over their lengths.
    gradient : array of shape (k,)
        Products of these rows with the residual: zero at a minimum.
    coefficients : array of shape (k,)
        Coefficients of the rows over their lengths, at their minimum; of the tangent the steps to it.
    gain : float
        Fall of the misfit to this minimum.

    """

    free: Mask
    size: Array
    inverse: Array
    gradient: Array
    coefficients: Array
    gain: float

    @classmethod
    def of(cls, state: SeparableSolution) -> FreeRows:
        """Collect the free rows of a solution."""
        own, across = state.tangent, state.tangent.products(state.rows)
        gram = np.block([[state.gram, across], [across.T, own.normal]])
        free = np.concatenate([state.unconstrained, own.is_inside & (own.normal.diagonal() > 0)])
        gradient = np.concatenate([np.zeros(len(state.coefficients)), own.gradient])[free]
        c = np.concatenate([state.coefficients, np.zeros(len(own.positions))])[free]
        size = np.sqrt(gram.diagonal()[free])
        unit = gram[np.ix_(free, free)] / (size * size[:, None])
        unit.flat[:: len(size) + 1] += RIDGE
        inverse, gradient = np.linalg.inv(unit), gradient / size
        step = inverse @ gradient
        return cls(free, size, inverse, gradient, c * size + step, float(gradient @ step))

    def places(self, rows: Sequence[int]) -> NDArray[np.int_]:
        """Positions among the free rows of those of some coefficients and parameters that are free."""
        return np.array([np.sum(self.free[:i]) for i in rows if self.free[i]], dtype=int)


@dataclass(frozen=True, eq=False)
class PlacedEffect:
    """An effect of C rows that is added to k rows.

    Attributes
    ----------
    overlap : array of shape (k, C)
        Inner products of its rows with those k.
    inverse : array of shape (C, C)
        Inverse Gram matrix of what the k rows leave of its own.
    right : array of shape (C,)
        Inner products of its rows with the residual.

    """

    overlap: Array
    inverse: Array
    right: Array


class ProjectedTable:
    """A table added to a solution, whose free rows and friction levels are projected out.

    Parameters
    ----------
    grid : ScanGrid
        The G points.
    gram : array of shape (G, C, C)
        Gram matrices of the table.
    free_rows : FreeRows
        The free rows of the solution and of its tangent.
    products : tuple of (array of shape (K + R, G, C), array of shape (G, C))
        Inner products of the table with the rows of the solution and of its tangent, and with its residual.

    """

    def __init__(self, grid: ScanGrid, gram: Array, free_rows: FreeRows, products: tuple[Array, Array]) -> None:
        self.grid, self.free_rows, self.full = grid, free_rows, np.einsum("gcc->gc", gram)
        self.rows = products[0][free_rows.free] / free_rows.size[:, None, None]
        self.dual = _times(free_rows.inverse, self.rows)
        self.schur = gram - _outer_sum(self.dual, self.rows)
        self.right = products[1] - _times(free_rows.gradient, self.dual)

    def one_more(self, box: Box) -> TableScan:
        """Return the gains of one more effect at every grid point."""
        return TableScan(self.grid, _gains(self.schur, self.right, self.full, box) + self.free_rows.gain)

    def placed(self, points: NDArray[np.int_], weights: Array, gram: Array) -> PlacedEffect:
        """Return the effect whose rows, of Gram matrix (C, C), are the sum of grid points (p,) with weights (p,)."""
        overlap, dual = weights @ self.rows[:, points], weights @ self.dual[:, points]
        inverse = np.asarray(np.linalg.inv(gram - overlap.T @ dual))
        return PlacedEffect(overlap, inverse, weights @ self.right[points])

    def reduced(self, effect: PlacedEffect, products: Array) -> ProjectedTable:
        """Return the table with one more effect projected out, of which only gains of one more may be asked.

        Parameters
        ----------
        effect : PlacedEffect
            The effect.
        products : array of shape (C, G, C')
            Inner products of the table with the rows of the effect.

        """
        out = copy(self)
        across = products - _times(effect.overlap.T, self.dual)
        lift = _times(effect.inverse, across)
        out.right = self.right - _times(effect.right, lift)
        out.schur = self.schur - _outer_sum(lift, across)
        out.rows, out.dual = np.concatenate([self.rows, across]), np.concatenate([self.dual, lift])
        return out

    def moved(self, mine: Sequence[int], box: Box) -> TableScan:
        """Return the gains of every grid point where the rows `mine` of the solution and its tangent leave it."""
        current, own = self.free_rows, self.free_rows.places(mine)
        dual, coefficients = self.dual[own], current.coefficients[own]
        precision = np.asarray(np.linalg.inv(current.inverse[own[:, None], own]))
        lift = _times(precision, dual)
        schur, right = self.schur + _outer_sum(dual, lift), self.right + _times(coefficients, lift)
        loss = float(coefficients @ precision @ coefficients) - current.gain
        return TableScan(self.grid, _gains(schur, right, self.full, box), loss)


def _times(matrix: Array, rows: Array) -> Array:
    """Product (..., G, C) of a matrix (..., k) with rows (k, G, C)."""
    return np.tensordot(matrix, rows, 1)


def _outer_sum(left: Array, right: Array) -> Array:
    """Sums over k of the products (G, C, C) of rows (k, G, C)."""
    if left.shape[2] == 1:
        return np.asarray((left * right).sum(axis=0)[:, :, None])
    return np.asarray(np.matmul(left.transpose(1, 2, 0), right.transpose(1, 0, 2)))


def _gains(schur: Array, right: Array, full: Array, box: Box) -> Array:
    """Gains (G,) with the best coefficients within a box, clipped there; points that the model absorbs gain nothing."""
    size = np.sqrt(np.where(full > 0, full, 1.0))
    unit = schur / size[:, :, None] / size[:, None, :] + MIN_UNEXPLAINED_SHARE * np.eye(full.shape[1])
    own = right / size
    c = own / unit[:, 0] if full.shape[1] == 1 else np.linalg.solve(unit, own[:, :, None])[:, :, 0]
    if box is None or np.all((c >= box[0] * size) & (c <= box[1] * size)):
        return np.asarray(np.sum(c * own, axis=1))
    c = np.clip(c, box[0] * size, box[1] * size)
    return np.asarray(np.sum(c * (2 * own - (unit @ c[:, :, None])[:, :, 0]), axis=1))
