"""Scan effects over grids of their non-linear parameters: the gain of every grid point in closed form, all at once.

Tables depend only on the motion, so they serve every data set along it. Instances of one effect share them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.effects import Effect, Parameter
from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.newton import SeparableSolution
from frictrack.fit.separable.table_scan import Box, FreeRows, ProjectedTable, ScanGrid, TableScan
from frictrack.records import Array

MAX_SCAN_AXES = 3  # parameters of one effect that are scanned together
MAX_SINGLE_PRECISION = 1e15  # sums of products of larger rows could leave the range of single precision, 3e38
MIN_NEXT_GAIN_SHARE = (
    0.02  # of the largest gain; a position between grid points is known to about a fiftieth of its gain
)
MAX_AT_ONCE = 64  # grid points evaluated at once


@dataclass(frozen=True)
class ScanItem:
    """An effect to scan, in group `g`; in one `run` if its scan belongs to single runs."""

    effect: str
    g: int
    run: int | None = None


def _scanned_parameters(effect: Effect) -> list[Parameter]:
    return [p for p in effect.nonlinear if p.scan is not None and p.free]


def is_scannable(effect: Effect) -> bool:
    """Return whether an effect can be scanned on a grid: it modifies no other and has few scanned parameters.

    An effect with relaxed parts is scanned part by part.
    """
    return bool(effect.relaxed) or (not effect.modifies and len(_scanned_parameters(effect)) <= MAX_SCAN_AXES)


def scanned_effects(separable: SeparableModel) -> list[ScanItem]:
    """Return the effects of a model that are scanned, in its order."""
    out, layout = [], separable.layout
    for effect in layout.model.effects:
        if not is_scannable(effect) or effect.relaxed:
            continue
        g = next(k for k, group in enumerate(separable.groups) if effect.name in group.names)
        if effect.single:
            out += [ScanItem(effect.name, g, r) for r in separable.runs if (effect.name, r) not in layout.absent]
        elif _scanned_parameters(effect) and effect.linear:
            out.append(ScanItem(effect.name, g))
    return out


def coefficients_of(separable: SeparableModel, item: ScanItem) -> NDArray[np.int_]:
    """Return the coefficients of the model that belong to an item."""
    own = [i for i, c in enumerate(separable.coefficients) if c.effect == item.effect and _in_run(c.run, item.run)]
    return np.array(own, dtype=int)


def _in_run(run: int | None, wanted: int | None) -> bool:
    """Whether a parameter of one run (None: of all) belongs to a wanted run (None: any)."""
    return wanted is None or run in (None, wanted)


def _scan_grid(separable: SeparableModel, item: ScanItem) -> ScanGrid:
    """Create the grid of an item's scanned parameters, without frequencies above the band of the data."""
    effect = next(e for e in separable.layout.model.effects if e.name == item.effect)
    span = separable.layout.span if item.run is None else separable.layout.spans[item.run]
    highest = max(b.highest for b in separable.blocks)
    axes = []
    for p in _scanned_parameters(effect):
        assert p.scan is not None
        axis = np.asarray(p.scan(span), dtype=float)
        axis = axis[(axis >= p.bounds[0]) & (axis <= p.bounds[1])]
        if p.unit == "Hz" and np.any(axis < highest):
            axis = axis[axis < highest]
        axes.append(axis)
    return ScanGrid(tuple(p.name for p in _scanned_parameters(effect)), tuple(axes))


@dataclass(frozen=True, eq=False)
class ScanTable:
    """Rows of every grid point, in single precision: they only show where to refine.

    Attributes
    ----------
    grid : ScanGrid
        The G points.
    rows : list of array of shape (G c_b, m_b)
        Rows in every block b, over the block's scale.
    at : list of array of int
        Which of the C coefficients of a point the rows of a block belong to.
    gram : array of shape (G, C, C)
        Gram matrices.
    scales : list of float
        Scale of the rows in every block b.
    law_products, data_products, neighbour_gram
        Caches of inner products.

    """

    grid: ScanGrid
    rows: list[NDArray[np.float32]]
    at: list[NDArray[np.int_]]
    gram: Array  # (G, C, C)
    scales: list[float]

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
            The solution, with K coefficients and a tangent of R parameters.
        data : array of shape (M,)
            The data.

        Returns
        -------
        products : array of shape (K + R, G, C)
            With the rows of the solution and of its tangent.
        residual_products : array of shape (G, C)
            With its residual.

        """
        k = len(state.coefficients)
        out = np.zeros((k + len(state.tangent.rows), *self.gram.shape[:2]))
        self._renew_products(separable, state)
        for g, (_, products) in self.law_products.items():
            out[separable.coefficients_of(g)] = products
        if not self.data_products or self.data_products[0] is not data:
            self.data_products[:] = [data, self.products(separable.slices, data[None])[0]]
        if len(state.tangent.rows):
            out[k:] = self.products(separable.slices, state.tangent.rows)
        explained = state.coefficients @ out[:k].reshape(k, -1)
        return out, self.data_products[1] - explained.reshape(self.gram.shape[:2])

    def _renew_products(self, separable: SeparableModel, state: SeparableSolution) -> None:
        """Renew the products with the rows of all groups that have changed, all at once."""
        kept = self.law_products
        changed = [g for g, version in enumerate(state.versions) if kept.get(g, (None,))[0] != version]
        if not changed:
            return
        mine = [separable.coefficients_of(g) for g in changed]
        products = self.products(separable.slices, state.rows[np.concatenate(mine)])
        for g, part in zip(changed, np.split(products, np.cumsum([len(own) for own in mine])[:-1]), strict=True):
            kept[g] = state.versions[g], part

    def neighbours(self) -> Array:
        """Return the Gram matrices (G - 1, 2 C, 2 C) of every point and the next one on the grid."""
        if not self.neighbour_gram:
            g, c = self.gram.shape[:2]
            across = np.zeros((g - 1, c, c))
            for mine, at, scale in zip(self.rows, self.at, self.scales, strict=True):
                cube = mine.reshape(g, len(at), mine.shape[-1])  # empty for blocks of other runs
                across[np.ix_(np.arange(g - 1), at, at)] += scale**2 * (cube[:-1] @ cube[1:].transpose(0, 2, 1))
            upper = np.concatenate([self.gram[:-1], across], axis=2)
            lower = np.concatenate([across.transpose(0, 2, 1), self.gram[1:]], axis=2)
            self.neighbour_gram.append(np.concatenate([upper, lower], axis=1))
        return self.neighbour_gram[0]

    def rows_at(self, slices: list[slice], points: NDArray[np.int_], weights: Array) -> Array:
        """Compute the weighted sum (C, M) of the rows of some points."""
        g, c = self.gram.shape[:2]
        out = np.zeros((c, slices[-1].stop))
        for mine, at, cut, scale in zip(self.rows, self.at, slices, self.scales, strict=True):
            cube = mine.reshape(g, len(at), mine.shape[-1])
            out[at, cut] = scale * np.tensordot(weights, cube[points], 1)
        return out

    def products(self, slices: list[slice], rows: Array) -> Array:
        """Compute inner products (k, G, C) of the table with rows (k, M)."""
        g, c = self.gram.shape[:2]
        out = np.zeros((len(rows), g, c))
        single_rows, size = _single_precision(rows)
        for mine, at, cut, scale in zip(self.rows, self.at, slices, self.scales, strict=True):
            if not len(at):
                continue
            own = single_rows if len(slices) == 1 else single_rows[:, cut]
            shown = np.flatnonzero(own.any(axis=1))  # most rows belong to one run
            products: NDArray[Any] = (own[shown] @ mine.T).reshape(len(shown), g, len(at))
            if size * scale > 1:
                products = size * scale * products.astype(float)
            if len(shown) == len(rows) and len(at) == c:
                out += products
            else:
                out[shown[:, None, None], np.arange(g)[:, None], at] += products
        return out


def _single_precision(rows: Array) -> tuple[NDArray[np.float32], float]:
    """Rows over a scale, and that scale: 1 unless products of the rows could leave the range of single precision."""
    scale = max(float(np.abs(rows).max(initial=0.0)) / MAX_SINGLE_PRECISION, 1.0)
    return (rows / scale if scale > 1 else rows).astype(np.float32), scale


@dataclass(frozen=True, eq=False)
class _Scanned:
    """What is fixed of an item.

    Attributes
    ----------
    grid : ScanGrid
        Its grid.
    coefficients : array of int
        Its coefficients among those of the model.
    slots : list of list of int
        Positions in the layout that each scanned parameter sets.
    others : list of int
        Positions of the parameters of its group that are not scanned.
    box : tuple of array, optional
        Bounds of the coefficients.

    """

    grid: ScanGrid
    coefficients: NDArray[np.int_]
    slots: list[list[int]]
    others: list[int]
    box: Box

    @classmethod
    def of(cls, separable: SeparableModel, item: ScanItem) -> _Scanned:
        """Collect what is fixed of an item."""
        grid, own, places = _scan_grid(separable, item), coefficients_of(separable, item), separable.layout.slots
        in_run = [(i, s) for i, s in enumerate(places) if _in_run(s.run, item.run)]
        slots = [[i for i, s in in_run if (s.effect, s.parameter) == (item.effect, name)] for name in grid.names]
        in_group = separable.groups[item.g].nonlinear_slots
        others = [i for i in in_group if places[i].parameter not in grid.names and places[i].run in (None, item.run)]
        low, high = separable.low[own], separable.high[own]
        return cls(grid, own, slots, others, (low, high) if np.isfinite([low, high]).any() else None)


@dataclass(frozen=True, eq=False)
class _CurrentSolution:
    """The last solution and data, and the projected tables by table and whether its points are paired."""

    state: SeparableSolution
    data: Array
    free_rows: FreeRows
    projected: dict[tuple[int, bool], tuple[ScanTable, ProjectedTable]] = field(default_factory=dict)


class ScanTables:
    """The tables of a layout along its blocks, created on first use."""

    def __init__(self, separable: SeparableModel) -> None:
        self.separable = separable
        self._scanned: dict[ScanItem, _Scanned] = {}
        self._made: dict[tuple[object, ...], ScanTable] = {}
        self._last: _CurrentSolution | None = None

    def _of(self, item: ScanItem) -> _Scanned:
        if item not in self._scanned:
            self._scanned[item] = _Scanned.of(self.separable, item)
        return self._scanned[item]

    def grid(self, item: ScanItem) -> ScanGrid:
        """Return the grid of an item."""
        return self._of(item).grid

    def slots(self, item: ScanItem) -> list[list[int]]:
        """Return the positions in the layout that each scanned parameter of an item sets."""
        return self._of(item).slots

    def table(self, item: ScanItem, state: SeparableSolution) -> ScanTable:
        """Return the table of an item. It is kept, unless it depends on the current solution."""
        effects = self.separable.groups[item.g].model.effects
        if len(effects) > 1:
            return self._build(item, state)
        others = tuple(float(state.nonlinear_values[i]) for i in self._of(item).others)
        key = effects[0].columns, effects[0].parameters, item.run, others
        if key not in self._made:
            self._made[key] = self._build(item, state)
        return self._made[key]

    def scan(self, item: ScanItem, state: SeparableSolution, data: Array) -> TableScan:
        """Compute the gain of every grid point of one more effect like an item added to a solution."""
        return self._projected_table(item, state, data).one_more(self._of(item).box)

    def best_positions(self, items: Sequence[ScanItem], state: SeparableSolution, data: Array) -> dict[ScanItem, Array]:
        """Find missing effects added to a solution, one after the other, without any refinement.

        Parameters
        ----------
        items : sequence of ScanItem
            The effects that are missing, at least one.
        state : SeparableSolution
            The solution.
        data : array of shape (M,)
            The data.

        Returns
        -------
        dict of ScanItem to array of shape (d,)
            Scanned parameters of the effects found, the first one gains most. It ends before an effect that what is
            left of a larger one could hide or imitate.

        """
        tables = {id(table): table for table in (self.table(i, state) for i in items)}
        waiting: dict[int, list[ScanItem]] = {key: [] for key in tables}
        for item in items:
            waiting[id(self.table(item, state))].append(item)
        projected = {key: self._projected_table(own[0], state, data) for key, own in waiting.items()}
        found: dict[ScanItem, Array] = {}
        largest = 0.0
        while projected:
            scans = {key: table.one_more(self._of(waiting[key][0]).box) for key, table in projected.items()}
            key, scan = max(scans.items(), key=lambda one: one[1].largest)
            if found and scan.largest < MIN_NEXT_GAIN_SHARE * largest:
                return found
            largest = max(largest, scan.largest)
            found[waiting[key].pop(0)] = values = scan.summit(scan.best)
            points, weights = scan.grid.weights(scan.best, values)
            if not len(points) or len(found) == len(items):
                return found
            rows = tables[key].rows_at(self.separable.slices, points, weights)
            placed = projected[key].placed(points, weights, rows @ rows.T)
            projected = {
                k: table.reduced(placed, tables[k].products(self.separable.slices, rows))
                for k, table in projected.items()
                if waiting[k]
            }
        return found

    def moves(self, item: ScanItem, state: SeparableSolution, data: Array) -> TableScan:
        """Compute the gain of every grid point of an item of a solution, which leaves its own position."""
        return self._projected_table(item, state, data).moved(self._leaving(item, state), self._of(item).box)

    def pair_moves(self, pair: tuple[ScanItem, ScanItem], state: SeparableSolution, data: Array) -> TableScan:
        """Compute the gain of two neighbouring grid points together: two lines too close to be resolved."""
        own = [i for item in pair for i in self._leaving(item, state)]
        return self._projected_table(pair[0], state, data, in_pairs=True).moved(own, None)

    def _leaving(self, item: ScanItem, state: SeparableSolution) -> list[int]:
        """Which of the coefficients, and after them of the parameters of the tangent, belong to an item alone."""
        first, slots = len(state.coefficients), self.separable.layout.slots
        places = enumerate(slots[i] for i in state.tangent.positions)
        own = [first + k for k, s in places if s.effect == item.effect and item.run in (None, s.run)]
        return [*self._of(item).coefficients.tolist(), *own]

    def _projected_table(
        self, item: ScanItem, state: SeparableSolution, data: Array, in_pairs: bool = False
    ) -> ProjectedTable:
        """The table of an item added to a solution, or of its neighbouring grid points; items share it."""
        table = self.table(item, state)
        last = self._last
        if last is None or last.state is not state or last.data is not data:
            last = self._last = _CurrentSolution(state, data, FreeRows.of(state))
        key = id(table), in_pairs
        if key not in last.projected:
            last.projected[key] = table, self._project(table, last, in_pairs)
        return last.projected[key][1]

    def _project(self, table: ScanTable, current: _CurrentSolution, in_pairs: bool) -> ProjectedTable:
        cross, right = table.inner_products(self.separable, current.state, current.data)
        if not in_pairs:
            return ProjectedTable(table.grid, table.gram, current.free_rows, (cross, right))
        both = np.concatenate([cross[:, :-1], cross[:, 1:]], axis=2), np.concatenate([right[:-1], right[1:]], axis=1)
        grid = ScanGrid(table.grid.names, (table.grid.axes[0][:-1],))
        return ProjectedTable(grid, table.neighbours(), current.free_rows, both)

    def _build(self, item: ScanItem, state: SeparableSolution) -> ScanTable:
        """Evaluate the rows of an item at all grid points."""
        separable, scanned = self.separable, self._of(item)
        mine, grid, count = scanned.coefficients, scanned.grid, len(scanned.grid.values)
        nonlinear_values = np.tile(state.nonlinear_values, (count, 1))
        for slots, values in zip(scanned.slots, grid.values.T, strict=True):
            nonlinear_values[:, slots] = values[:, None]
        chunks = np.array_split(nonlinear_values, -(-count // MAX_AT_ONCE))
        rows, at, scales, gram = [], [], [], np.zeros((count, len(mine), len(mine)))
        for b, block in enumerate(separable.blocks):
            place = separable.column_positions[item.g][block.run]
            kept = np.flatnonzero(np.isin(place, mine) & (item.run in (None, block.run)))
            effect_rows = np.zeros((count, 0, len(block.data)))
            if len(kept):
                effect_rows = np.concatenate([separable.rows(item.g, b, part)[:, kept] for part in chunks])
            a = np.searchsorted(mine, place[kept])
            gram[np.ix_(np.arange(count), a, a)] += effect_rows @ effect_rows.transpose(0, 2, 1)
            single_rows, scale = _single_precision(effect_rows.reshape(-1, len(block.data)))
            rows.append(single_rows)
            scales.append(scale)
            at.append(a)
        return ScanTable(grid, rows, at, gram, scales)
