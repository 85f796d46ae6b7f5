"""Scan effects over grids of their non-linear parameters: the gain of every grid point in closed form, all at once.

Tables depend only on the motion, so they serve every data set along it. Instances of one effect share them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from frictrack.effects import Effect
from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.newton import SeparableSolution
from frictrack.records import Array, Mask

MIN_UNEXPLAINED_SHARE = 1e-6  # smallest share of a column outside the model
MIN_GRID_STEPS_APART = 3  # grid steps; closer points count as the same
MAX_AT_ONCE = 64  # grid points evaluated at once


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
class ScanTable:
    """Rows of every grid point, in single precision: they only show where to refine.

    Attributes
    ----------
    grid : ScanGrid
        The G points.
    rows : list of array of shape (G c_b, m_b)
        Rows in every block b.
    at : list of array of int
        Which of the C coefficients of a point the rows of a block belong to.
    gram : array of shape (G, C, C)
        Gram matrices.
    law_products, data_products, neighbour_gram
        Caches of inner products.

    """

    grid: ScanGrid
    rows: list[NDArray[np.float32]]
    at: list[NDArray[np.int_]]
    gram: Array  # (G, C, C)

    # by group: version, products with its rows
    law_products: dict[int, tuple[int, Array]] = field(default_factory=dict)
    data_products: list[Array] = field(default_factory=list)  # the previous data and the products with them
    # Gram matrices of neighbouring points, computed on first use
    neighbour_gram: list[Array] = field(default_factory=list)

    def inner_products(self, separable: SeparableModel, state: SeparableSolution, data: Array) -> tuple[Array, Array]:
        """Compute the inner products of the table with a solution.

        Parameters
        ----------
        separable : SeparableModel
            The model.
        state : SeparableSolution
            The solution, with K coefficients and R friction levels.
        data : array of shape (M,)
            The data.

        Returns
        -------
        products : array of shape (G, C, K + R)
            With the rows of the solution and of its levels.
        residual_products : array of shape (G, C)
            With its residual.

        """
        k = len(state.coefficients)
        out = np.zeros((*self.gram.shape[:2], k + len(state.levels.rows)))
        for g, stamp in enumerate(state.versions):
            mine = separable.coefficients_of(g)
            if self.law_products.get(g, (None,))[0] != stamp:
                self.law_products[g] = stamp, self._products(separable.slices, state.rows[mine])
            out[:, :, mine] = self.law_products[g][1]
        if not self.data_products or self.data_products[0] is not data:
            self.data_products[:] = [data, self._products(separable.slices, data[None])[:, :, 0]]
        out[:, :, k:] = self._products(separable.slices, state.levels.rows)
        return out, self.data_products[1] - out[:, :, :k] @ state.coefficients

    def neighbours(self) -> Array:
        """Return the Gram matrices (G - 1, 2 C, 2 C) of every point and the next one on the grid."""
        if not self.neighbour_gram:
            g, c = self.gram.shape[:2]
            across = np.zeros((g - 1, c, c))
            for mine, at in zip(self.rows, self.at, strict=True):
                cube = mine.reshape(g, len(at), mine.shape[-1])  # empty for blocks of other runs
                across[np.ix_(np.arange(g - 1), at, at)] += cube[:-1] @ cube[1:].transpose(0, 2, 1)
            upper = np.concatenate([self.gram[:-1], across], axis=2)
            lower = np.concatenate([across.transpose(0, 2, 1), self.gram[1:]], axis=2)
            self.neighbour_gram.append(np.concatenate([upper, lower], axis=1))
        return self.neighbour_gram[0]

    def _products(self, slices: list[slice], rows: Array) -> Array:
        """Inner products (G, C, k) of the table with rows (k, M)."""
        g, c = self.gram.shape[:2]
        out = np.zeros((g, c, len(rows)))
        single_rows = rows.astype(np.float32)
        for mine, at, cut in zip(self.rows, self.at, slices, strict=True):
            shown = np.flatnonzero(single_rows[:, cut].any(axis=1))  # most rows belong to one run
            out[np.ix_(np.arange(g), at, shown)] += (mine @ single_rows[shown, cut].T).reshape(g, len(at), len(shown))
        return out


@dataclass(frozen=True, eq=False)
class TableScan:
    """Gain of every grid point beside a solution, (G,), and its coefficients (G, C)."""

    grid: ScanGrid
    gains: Array
    coefficients: Array

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


def scan_grid(separable: SeparableModel, effect: str, run: int | None) -> ScanGrid:
    """Create the grid of an effect's scanned parameters, without frequencies above the band of the data."""
    effect_rows = next(e for e in separable.layout.model.effects if e.name == effect)
    span = separable.layout.span if run is None else separable.layout.spans[run]
    highest = max(b.highest for b in separable.blocks)
    scanned = [p for p in effect_rows.nonlinear if p.scan is not None and p.free]
    axes = []
    for p in scanned:
        assert p.scan is not None
        axis = np.asarray(p.scan(span), dtype=float)
        axis = axis[(axis >= p.bounds[0]) & (axis <= p.bounds[1])]
        if p.unit == "Hz" and np.any(axis < highest):
            axis = axis[axis < highest]
        axes.append(axis)
    values = np.array(list(product(*axes)))
    steps = np.array(list(product(*[range(len(a)) for a in axes])))
    return ScanGrid(tuple(p.name for p in scanned), values, steps)


@dataclass(frozen=True)
class ScanItem:
    """An effect to scan, in group `g`; in one `run` if its scan belongs to single runs."""

    effect: str
    g: int
    run: int | None = None


MAX_SCAN_AXES = 3  # parameters of one effect that are scanned together


def is_scannable(effect: Effect) -> bool:
    """Return whether an effect can be scanned on a grid: it modifies no other and has few scanned parameters.

    An effect with relaxed parts is scanned part by part.
    """
    scanned = [p for p in effect.nonlinear if p.scan is not None and p.free]
    return bool(effect.relaxed) or (not effect.modifies and len(scanned) <= MAX_SCAN_AXES)


def scanned_effects(separable: SeparableModel) -> list[ScanItem]:
    """Return the effects of a model that are scanned, in its order."""
    out = []
    for effect in separable.layout.model.effects:
        g = next(k for k, group in enumerate(separable.groups) if effect.name in group.names)
        scanned = [p for p in effect.nonlinear if p.scan is not None and p.free]
        if not is_scannable(effect) or effect.relaxed:
            continue
        if effect.single:
            out += [
                ScanItem(effect.name, g, r) for r in separable.runs if (effect.name, r) not in separable.layout.absent
            ]
        elif scanned and effect.linear:
            out.append(ScanItem(effect.name, g))
    return out


def coefficients_of(separable: SeparableModel, item: ScanItem) -> NDArray[np.int_]:
    """Return the coefficients of the model that belong to an item."""
    return np.array(
        [
            i
            for i, c in enumerate(separable.coefficients)
            if c.effect == item.effect and (item.run is None or c.run in (None, item.run))
        ],
        dtype=int,
    )


class ScanTables:
    """The tables of a layout along its blocks, created on first use."""

    def __init__(self, separable: SeparableModel) -> None:
        self.separable = separable
        self._grids: dict[tuple[str, int | None], ScanGrid] = {}
        self._made: dict[tuple[object, ...], ScanTable] = {}

    def grid(self, item: ScanItem) -> ScanGrid:
        """Return the grid of an item."""
        key = item.effect, item.run
        if key not in self._grids:
            self._grids[key] = scan_grid(self.separable, *key)
        return self._grids[key]

    def table(self, item: ScanItem, state: SeparableSolution) -> ScanTable:
        """Return the table of an item. It is kept, unless it depends on the current solution."""
        separable = self.separable
        group = separable.groups[item.g]
        if len(group.model.effects) > 1:
            return self._build(item, state)
        effect = group.model.effects[0]
        grid = self.grid(item)
        rest = [
            float(state.nonlinear_values[i])
            for i in group.nonlinear_slots
            if separable.layout.slots[i].parameter not in grid.names
            and separable.layout.slots[i].run in (None, item.run)
        ]
        key = (effect.columns, effect.parameters, item.run, *rest)
        if key not in self._made:
            self._made[key] = self._build(item, state)
        return self._made[key]

    def scan(self, item: ScanItem, state: SeparableSolution, data: Array) -> TableScan:
        """Compute the gain of every grid point of an item beside a solution without it."""
        table = self.table(item, state)
        mine = coefficients_of(self.separable, item)
        cross, residual_products = table.inner_products(self.separable, state, data)
        return _table_scan(
            table, state, (cross, residual_products), (self.separable.low[mine], self.separable.high[mine])
        )

    def pairs(self, item: ScanItem, state: SeparableSolution, data: Array) -> TableScan:
        """Compute the gain of two neighbouring grid points together: two lines too close to be resolved."""
        table = self.table(item, state)
        cross, residual_products = table.inner_products(self.separable, state, data)
        two = replace(table, gram=table.neighbours(), grid=table.grid.shortened())
        both = (
            np.concatenate([cross[:-1], cross[1:]], axis=1),
            np.concatenate([residual_products[:-1], residual_products[1:]], axis=1),
        )
        return _table_scan(two, state, both, (-np.inf, np.inf))

    def _build(self, item: ScanItem, state: SeparableSolution) -> ScanTable:
        """Evaluate the rows of an item at all grid points."""
        separable, grid = self.separable, self.grid(item)
        nonlinear_values = np.tile(state.nonlinear_values, (len(grid.values), 1))
        for name, values in zip(grid.names, grid.values.T, strict=True):
            for i, s in enumerate(separable.layout.slots):
                if (s.effect, s.parameter) == (item.effect, name) and (item.run is None or s.run in (None, item.run)):
                    nonlinear_values[:, i] = values
        mine = coefficients_of(separable, item)
        rows, at = [], []
        gram = np.zeros((len(nonlinear_values), len(mine), len(mine)))
        for b, block in enumerate(separable.blocks):
            place = separable.column_positions[item.g][block.run]
            kept = np.flatnonzero(np.isin(place, mine))
            if item.run is not None and block.run != item.run:
                kept = kept[:0]
            parts = (
                [separable.rows(item.g, b, part)[:, kept] for part in _chunks(nonlinear_values)] if len(kept) else []
            )
            effect_rows = np.concatenate(parts) if parts else np.zeros((len(nonlinear_values), 0, len(block.data)))
            a = np.searchsorted(mine, place[kept])
            gram[np.ix_(np.arange(len(nonlinear_values)), a, a)] += effect_rows @ effect_rows.transpose(0, 2, 1)
            rows.append(effect_rows.reshape(-1, len(block.data)).astype(np.float32))
            at.append(a)
        return ScanTable(grid, rows, at, gram)


def _chunks(nonlinear_values: Array) -> list[Array]:
    return np.array_split(nonlinear_values, max(1, -(-len(nonlinear_values) // MAX_AT_ONCE)))


def _table_scan(
    table: ScanTable, state: SeparableSolution, products: tuple[Array, Array], box: tuple[Array | float, Array | float]
) -> TableScan:
    """Gains of all grid points beside a solution without them, its levels free within their penalty.

    `products` are the inner products from `ScanTable.inner_products`, `box` the bounds of the coefficients.
    """
    cross, residual_products = products
    schur, gain_of_free_rows = table.gram.copy(), 0.0
    free = np.concatenate([state.unconstrained, state.levels.rows.any(axis=1)])
    if free.any():
        inverse, size, gradient = _free_rows(state, free)
        with_free_rows = cross[:, :, free] / size
        flat = (with_free_rows.reshape(-1, len(size)) @ inverse).reshape(with_free_rows.shape)
        schur -= flat @ with_free_rows.transpose(0, 2, 1)
        residual_products, gain_of_free_rows = residual_products - flat @ gradient, float(gradient @ inverse @ gradient)
    c = np.clip(_solve(schur, residual_products, np.einsum("gcc->gc", table.gram)), *box)
    curved = (schur @ c[:, :, None])[:, :, 0]
    return TableScan(table.grid, np.einsum("gc,gc->g", c, 2 * residual_products - curved) + gain_of_free_rows, c)


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
