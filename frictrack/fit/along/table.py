"""All forms of one effect on the grid of its scan, and what each would gain beside a law: closed form, all at once.

Tables depend on the motion alone, so they serve every data set along it. Instances of one effect share theirs.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.along.columns import Along
from frictrack.fit.along.newton import State
from frictrack.records import Array

ABSORBED = 1e-9  # share of a column's square that must remain beside the law for it to count
APART = 3  # steps of the grid within which a second pick is the same one
CROWD = 64  # forms evaluated at once


@dataclass(frozen=True, eq=False)
class Grid:
    """Points of a scan: `values` (G, d) of the parameters `names`, and where they stand on their axes, (G, d)."""

    names: tuple[str, ...]
    values: Array
    steps: NDArray[np.int_]


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of every form: of block b (G c_b, m_b), its columns being coefficients `at[b]` of the C of a form."""

    grid: Grid
    rows: list[Array]
    at: list[NDArray[np.int_]]
    gram: Array  # (G, C, C)

    def against(self, slices: list[slice], rows: Array) -> Array:
        """Inner products with rows (J, M): (G, C, J)."""
        g, c = self.gram.shape[:2]
        out = np.zeros((g, c, len(rows)))
        for mine, at, cut in zip(self.rows, self.at, slices, strict=True):
            out[:, at] += (mine @ rows[:, cut].T).reshape(g, len(at), -1)
        return out


@dataclass(frozen=True, eq=False)
class Scan:
    """What every form gains beside a law, (G,), and its coefficients (G, C)."""

    grid: Grid
    gains: Array
    coefficients: Array

    def picks(self, most: int) -> list[int]:
        """Forms of the largest gains, none within `APART` steps of a better one."""
        chosen: list[int] = []
        left = self.gains.copy()
        for _ in range(most):
            best = int(np.argmax(left))
            if left[best] <= 0:
                break
            chosen.append(best)
            left[np.all(np.abs(self.grid.steps - self.grid.steps[best]) <= APART, axis=1)] = 0.0
        return chosen


def grid_of(along: Along, effect: str, run: int | None) -> Grid:
    """Every combination of the scanned parameters of an effect, those above what the data show left out."""
    made = next(e for e in along.layout.model.effects if e.name == effect)
    span = along.layout.span if run is None else along.layout.spans[run]
    highest = max(b.highest for b in along.blocks)
    scanned = [p for p in made.nonlinear if p.scan is not None and p.fixed is None]
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
    return Grid(tuple(p.name for p in scanned), values, steps)


@dataclass(frozen=True)
class Item:
    """An effect that is scanned: in group `g`; in one `run` where the scan is the run's own."""

    effect: str
    g: int
    run: int | None = None


def items_of(along: Along) -> list[Item]:
    """What a model has to scan, in its order."""
    out = []
    for effect in along.layout.model.effects:
        g = next(k for k, group in enumerate(along.groups) if effect.name in group.names)
        scanned = [p for p in effect.nonlinear if p.scan is not None and p.fixed is None]
        if any(p.per_run for p in scanned):
            out += [Item(effect.name, g, r) for r in along.runs if (effect.name, r) not in along.layout.absent]
        elif scanned and effect.linear:
            out.append(Item(effect.name, g))
    return out


def coefficients_of(along: Along, item: Item) -> NDArray[np.int_]:
    """Which coefficients of the law belong to an item."""
    return np.array(
        [
            i
            for i, c in enumerate(along.coefficients)
            if c.effect == item.effect and (item.run is None or c.run in (None, item.run))
        ],
        dtype=int,
    )


class Tables:
    """The tables of a layout along its blocks, made when first asked for."""

    def __init__(self, along: Along) -> None:
        self.along = along
        self._grids: dict[tuple[str, int | None], Grid] = {}
        self._made: dict[tuple[object, ...], Table] = {}

    def grid(self, item: Item) -> Grid:
        """The grid of an item."""
        key = item.effect, item.run
        if key not in self._grids:
            self._grids[key] = grid_of(self.along, *key)
        return self._grids[key]

    def table(self, item: Item, state: State) -> Table:
        """The table of an item; kept unless it depends on the law at hand."""
        along = self.along
        group = along.groups[item.g]
        if len(group.model.effects) > 1:
            return self._build(item, state)
        effect = group.model.effects[0]
        grid = self.grid(item)
        rest = [
            float(state.numbers[i])
            for i in group.numbers
            if along.layout.slots[i].parameter not in grid.names and along.layout.slots[i].run in (None, item.run)
        ]
        key = (effect.columns, effect.parameters, item.run, *rest)
        if key not in self._made:
            self._made[key] = self._build(item, state)
        return self._made[key]

    def _build(self, item: Item, state: State) -> Table:
        along, grid = self.along, self.grid(item)
        numbers = np.tile(state.numbers, (len(grid.values), 1))
        for name, values in zip(grid.names, grid.values.T, strict=True):
            for i, s in enumerate(along.layout.slots):
                if (s.effect, s.parameter) == (item.effect, name) and (item.run is None or s.run in (None, item.run)):
                    numbers[:, i] = values
        mine = coefficients_of(along, item)
        rows, at = [], []
        for b, block in enumerate(along.blocks):
            place = along.place[item.g][block.run]
            kept = np.flatnonzero(np.isin(place, mine))
            if item.run is not None and block.run != item.run:
                kept = kept[:0]
            parts = [along.rows(item.g, b, part)[:, kept] for part in _crowds(numbers)] if len(kept) else []
            made = np.concatenate(parts) if parts else np.zeros((len(numbers), 0, len(block.data)))
            rows.append(np.ascontiguousarray(made.reshape(-1, len(block.data))))
            at.append(np.searchsorted(mine, place[kept]))
        gram = np.zeros((len(numbers), len(mine), len(mine)))
        for made, a in zip(rows, at, strict=True):
            cube = made.reshape(len(numbers), len(a), -1)
            gram[np.ix_(np.arange(len(numbers)), a, a)] += cube @ cube.transpose(0, 2, 1)
        return Table(grid, rows, at, gram)


def _crowds(numbers: Array) -> list[Array]:
    return np.array_split(numbers, max(1, -(-len(numbers) // CROWD)))


def scan(table: Table, state: State, slices: list[slice], low: Array, high: Array) -> Scan:
    """Gains of all forms beside a law that has none of them; coefficients out of bounds gain nothing."""
    rows = state.rows[state.moving]
    products = table.against(slices, np.vstack([rows, state.residual]))
    beside, right = products[:, :, :-1], products[:, :, -1]
    schur = table.gram.copy()
    if len(rows):
        size = np.linalg.norm(rows, axis=1)
        unit = (rows @ rows.T) / size / size[:, None]
        unit.flat[:: len(size) + 1] += 1e-12
        beside = beside / size
        schur -= beside @ np.linalg.inv(unit) @ beside.transpose(0, 2, 1)
    c = _solve(schur, right, np.einsum("gcc->gc", table.gram))
    gains = np.einsum("gc,gc->g", c, right)
    gains[np.any((c < low) | (c > high), axis=1)] = 0.0
    return Scan(table.grid, gains, c)


def _solve(schur: Array, right: Array, full: Array) -> Array:
    """Best coefficients (G, C) of forms with what remains of their Gram matrices; absorbed forms get none."""
    count = schur.shape[1]
    floor = ABSORBED * full
    if count == 1:
        own = schur[:, :, 0]
        return np.where(own > floor, right / np.maximum(own, 1e-300), 0.0)
    if count == 2:
        a, b, d = schur[:, 0, 0], schur[:, 0, 1], schur[:, 1, 1]
        det = a * d - b * b
        good = det > ABSORBED * full[:, 0] * full[:, 1]
        det = np.where(good, det, np.inf)
        out = np.stack([(d * right[:, 0] - b * right[:, 1]) / det, (a * right[:, 1] - b * right[:, 0]) / det], axis=1)
        return out
    size = np.sqrt(np.where(full > 0, full, 1.0))
    w, v = np.linalg.eigh(schur / size[:, :, None] / size[:, None, :])
    inverse = np.where(w > ABSORBED, 1 / np.maximum(w, ABSORBED), 0.0)
    rotated = np.einsum("gce,gc->ge", v, right / size) * inverse
    return np.einsum("gce,ge->gc", v, rotated) / size
