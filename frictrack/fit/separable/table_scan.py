"""Compute the gains of all grid points of a scan beside a solution, in closed form.

The free rows of the solution are projected out of the table. Where an effect of the solution moves to another grid
point, its own rows come back by a low-rank update, so that one projection serves every move.

References
----------
Golub, G. H. & Van Loan, C. F. (2013). Matrix Computations, sec. 2.1.4. Johns Hopkins University Press.

"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.separable.newton import SeparableSolution
from frictrack.records import Array, Mask

RIDGE = 1e-12  # relative; keeps nearly equal rows solvable
MIN_UNEXPLAINED_SHARE = 1e-6  # smallest share of a column outside the model
Box = tuple[Array, Array] | None  # None without bounds


@dataclass(frozen=True, eq=False)
class ScanGrid:
    """Points of a scan: `values` (G, d) of the parameters `names`, and their grid indices `steps` (G, d)."""

    names: tuple[str, ...]
    values: Array
    steps: NDArray[np.int_]

    def shortened(self) -> ScanGrid:
        """Return the grid without its last point."""
        return ScanGrid(self.names, self.values[:-1], self.steps[:-1])

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Number of grid points along every axis; the points are in row-major order."""
        return tuple(map(int, self.steps.max(axis=0) + 1))

    @cached_property
    def _axes(self) -> list[Array]:
        """Values along every axis."""
        return [self._axis_values(axis, 0) for axis in range(len(self.names))]

    def _axis_values(self, axis: int, g: int) -> Array:
        """Values of one parameter along the axis through a grid point."""
        return self.values[self._line(axis, g), axis]

    def _line(self, axis: int, g: int) -> slice:
        """Indices of the grid points along the axis through a grid point."""
        stride = int(np.prod(self.shape[axis + 1 :]))
        first = g - int(self.steps[g, axis]) * stride
        return slice(first, first + self.shape[axis] * stride, stride)

    def nearest(self, values: Array) -> int:
        """Return the grid point nearest to values (d,)."""
        at = [int(np.argmin(np.abs(axis - v))) for axis, v in zip(self._axes, values, strict=True)]
        return int(np.ravel_multi_index(at, self.shape))

    def peaks(self, heights: Array, least: float) -> NDArray[np.int_]:
        """Return the points not below their neighbours on any axis, with at least some height (G,), highest first."""
        high = np.flatnonzero(heights >= least)
        own, is_peak = heights[high], np.ones(len(high), dtype=bool)
        for axis, count in enumerate(self.shape):
            stride, step = int(np.prod(self.shape[axis + 1 :])), self.steps[high, axis]
            is_peak &= own >= heights[high - stride * (step > 0)]
            is_peak &= own >= heights[high + stride * (step < count - 1)]
        found = high[is_peak]
        return found[np.argsort(-heights[found], kind="stable")]

    def summit(self, heights: Array, g: int) -> Array:
        """Return the values (d,) of the vertex of parabolas through a peak (G,) at a point and its neighbours."""
        out = self.values[g].copy()
        for axis, step in enumerate(self.steps[g]):
            if 0 < step < self.shape[axis] - 1:
                line, k = self._line(axis, g), int(step)
                around = slice(k - 1, k + 2)
                out[axis] = _vertex(self.values[line, axis][around], heights[line][around])
        return out

    def weights(self, g: int, values: Array) -> tuple[NDArray[np.int_], Array]:
        """Return points, and weights that interpolate between them at values near a point, on one axis by parabolas.

        There are none on a grid of several axes, which are too coarse for that.
        """
        if len(self.names) > 1:
            return np.zeros(0, dtype=int), np.zeros(0)
        if not 0 < g < len(self.values) - 1:
            return np.array([g]), np.ones(1)
        a, b, c = self.values[g - 1 : g + 2, 0]
        x = float(values[0])
        parts = [(x - b) * (x - c) / ((a - b) * (a - c)), (x - a) * (x - c) / ((b - a) * (b - c))]
        return np.arange(g - 1, g + 2), np.array([*parts, 1.0 - sum(parts)])


@dataclass(frozen=True, eq=False)
class TableScan:
    """Gain of every grid point, (G,), and its coefficients (G, C).

    `loss` is the rise of the misfit where an effect leaves its position before the gain.
    """

    grid: ScanGrid
    gains: Array
    coefficients: Array
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
    place : array of int, shape (K + R,)
        Position of every coefficient and parameter among the free ones; -1 for none.
    coefficients : array of shape (k,)
        Coefficients of the rows over their lengths, at their minimum; of the tangent the steps to it.
    gain : float
        Fall of the misfit to this minimum.

    """

    free: Mask
    size: Array
    inverse: Array
    gradient: Array
    place: NDArray[np.int_]
    coefficients: Array
    gain: float

    @classmethod
    def of(cls, state: SeparableSolution) -> FreeRows:
        """Collect the free rows of a solution."""
        own, c = state.tangent, state.coefficients
        gram, gradient, free = state.gram, np.zeros(len(c)), state.unconstrained
        if len(own.positions):
            across = own.products(state.rows)
            gram = np.block([[gram, across], [across.T, own.normal]])
            gradient, c = np.concatenate([gradient, own.gradient]), np.concatenate([c, np.zeros(len(own.positions))])
            free = np.concatenate([free, own.is_inside & (own.normal.diagonal() > 0)])
        if not free.all():
            gram, gradient, c = gram[np.ix_(free, free)], gradient[free], c[free]
        size = np.sqrt(gram.diagonal())
        unit = gram / (size * size[:, None])
        unit.flat[:: len(size) + 1] += RIDGE
        inverse, gradient = np.linalg.inv(unit), gradient / size
        step = inverse @ gradient
        place = np.where(free, np.cumsum(free) - 1, -1)
        return cls(free, size, inverse, gradient, place, c * size + step, float(gradient @ step))


@dataclass(frozen=True, eq=False)
class PlacedEffect:
    """An effect of C rows that is placed beside k rows.

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
    """A table beside a solution, whose free rows and friction levels are projected out.

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
        cross, self.right = products
        free, size = free_rows.free, free_rows.size
        self.rows = rows = (cross if free.all() else cross[free]) / size[:, None, None]
        # the size is stated: a solution may have no free row
        flat = (len(size), math.prod(rows.shape[1:]))
        self.dual = (free_rows.inverse @ rows.reshape(flat)).reshape(rows.shape)
        self.schur = gram - _outer_sum(self.dual, rows)
        if free_rows.gradient.any():
            self.right = self.right - (free_rows.gradient @ self.dual.reshape(flat)).reshape(self.right.shape)

    def one_more(self, box: Box) -> TableScan:
        """Return the gains of one more effect at every grid point."""
        c, gains = _best_coefficients(self.schur, self.right, self.full, box)
        return TableScan(self.grid, gains + self.free_rows.gain, c)

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
        out, (k, c) = copy(self), effect.overlap.shape
        # the size is stated: a solution may have no free row
        flat: Array = products.reshape(c, -1) - effect.overlap.T @ self.dual.reshape(k, math.prod(products.shape[1:]))
        lift = (effect.inverse @ flat).reshape(products.shape)
        across = flat.reshape(products.shape)
        out.right = self.right - (effect.right @ lift.reshape(c, -1)).reshape(self.right.shape)
        out.schur = self.schur - _outer_sum(lift, across)
        out.rows, out.dual = np.concatenate([self.rows, across]), np.concatenate([self.dual, lift])
        return out

    def moved(self, mine: Sequence[int], box: Box) -> TableScan:
        """Return the gains of every grid point where the rows `mine` of the solution and its tangent leave it."""
        current = self.free_rows
        own = current.place[list(mine)]
        own = own[own >= 0]
        if not len(own):
            return self.one_more(box)
        dual, coefficients = self.dual[own], current.coefficients[own]
        precision = np.linalg.inv(current.inverse[own[:, None], own])
        lift: Array = (precision @ dual.reshape(len(own), -1)).reshape(dual.shape)
        right = self.right + (coefficients @ lift.reshape(len(own), -1)).reshape(self.right.shape)
        schur: Array = self.schur + _outer_sum(dual, lift)
        c, gains = _best_coefficients(schur, right, self.full, box)
        return TableScan(self.grid, gains, c, float(coefficients @ precision @ coefficients) - current.gain)


def _vertex(x: Array, y: Array) -> float:
    """Place of the vertex of the parabola through three points of which the middle one is the highest."""
    left, right = (y[1] - y[0]) / (x[1] - x[0]), (y[1] - y[2]) / (x[2] - x[1])
    if not left + right > 0:
        return float(x[1])
    return float(x[1] + 0.5 * (left * (x[2] - x[1]) - right * (x[1] - x[0])) / (left + right))


def _outer_sum(left: Array, right: Array) -> Array:
    """Sums over k of the products (G, C, C) of rows (k, G, C)."""
    if left.shape[2] == 1:
        return np.asarray((left * right).sum(axis=0)[:, :, None])
    return np.asarray(np.matmul(left.transpose(1, 2, 0), right.transpose(1, 0, 2)))


def _best_coefficients(schur: Array, right: Array, full: Array, box: Box) -> tuple[Array, Array]:
    """Coefficients (G, C) within a box, and the gains (G,) with them."""
    c = _solve(schur, right, full)
    if box is not None and np.any((c < box[0]) | (c > box[1])):
        c = np.clip(c, *box)
        return c, np.einsum("gc,gc->g", c, 2 * right - np.einsum("gij,gj->gi", schur, c))
    return c, np.einsum("gc,gc->g", c, right)


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
