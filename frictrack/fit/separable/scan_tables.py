"""All forms of one effect on the grid of its scan, and what each would gain beside a law: closed form, all at once.

Tables depend on the motion alone, so they serve every data set along it. Instances of one effect share theirs.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from frictrack.effects import Effect
from frictrack.fit.separable.model import Along
from frictrack.fit.separable.newton import State
from frictrack.records import Array, Mask

ABSORBED = 1e-6  # share of a column's square that must remain beside the law for it to count
APART = 3  # steps of the grid within which a second pick is the same one
CROWD = 64  # forms evaluated at once


@dataclass(frozen=True, eq=False)
class Grid:
    """Points of a scan: `values` (G, d) of the parameters `names`, and where they stand on their axes, (G, d)."""

    names: tuple[str, ...]
    values: Array
    steps: NDArray[np.int_]

    def shortened(self) -> Grid:
        """The grid without its last point."""
        return Grid(self.names, self.values[:-1], self.steps[:-1])


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of every form: of block b (G c_b, m_b), its columns being coefficients `at[b]` of the C of a form.

    In single precision: they only say where to look.
    """

    grid: Grid
    rows: list[NDArray[np.float32]]
    at: list[NDArray[np.int_]]
    gram: Array  # (G, C, C)

    crosses: dict[int, tuple[int, Array]] = field(default_factory=dict)  # by group: stamp, products with its rows
    measured: list[Array] = field(default_factory=list)  # the last data and the products with them
    joint: list[Array] = field(default_factory=list)  # Gram matrices of neighbours, once asked for

    def against(self, along: Along, state: State, data: Array) -> tuple[Array, Array]:
        """Inner products with the rows of a law and of its R levels (G, C, K + R), and with its residual (G, C)."""
        k = len(state.coefficients)
        out = np.zeros((*self.gram.shape[:2], k + len(state.levels.rows)))
        for g, stamp in enumerate(state.stamps):
            mine = along.coefficients_of(g)
            if self.crosses.get(g, (None,))[0] != stamp:
                self.crosses[g] = stamp, self._products(along.slices, state.rows[mine])
            out[:, :, mine] = self.crosses[g][1]
        if not self.measured or self.measured[0] is not data:
            self.measured[:] = [data, self._products(along.slices, data[None])[:, :, 0]]
        out[:, :, k:] = self._products(along.slices, state.levels.rows)
        return out, self.measured[1] - out[:, :, :k] @ state.coefficients

    def neighbours(self) -> Array:
        """Gram matrices (G - 1, 2 C, 2 C) of every form and the next one on the grid."""
        if not self.joint:
            g, c = self.gram.shape[:2]
            across = np.zeros((g - 1, c, c))
            for mine, at in zip(self.rows, self.at, strict=True):
                cube = mine.reshape(g, len(at), mine.shape[-1])  # of another run there is none
                across[np.ix_(np.arange(g - 1), at, at)] += cube[:-1] @ cube[1:].transpose(0, 2, 1)
            upper = np.concatenate([self.gram[:-1], across], axis=2)
            lower = np.concatenate([across.transpose(0, 2, 1), self.gram[1:]], axis=2)
            self.joint.append(np.concatenate([upper, lower], axis=1))
        return self.joint[0]

    def _products(self, slices: list[slice], rows: Array) -> Array:
        g, c = self.gram.shape[:2]
        out = np.zeros((g, c, len(rows)))
        short = rows.astype(np.float32)
        for mine, at, cut in zip(self.rows, self.at, slices, strict=True):
            shown = np.flatnonzero(short[:, cut].any(axis=1))  # most rows belong to one run
            out[np.ix_(np.arange(g), at, shown)] += (mine @ short[shown, cut].T).reshape(g, len(at), len(shown))
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
    scanned = [p for p in made.nonlinear if p.scan is not None and p.free]
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


MOST_AXES = 3  # numbers of one effect that are scanned together


def is_scannable(effect: Effect) -> bool:
    """Whether the forms of an effect are few columns on a grid: no modifier, not too many numbers at once.

    One that is relaxed is scanned part by part.
    """
    scanned = [p for p in effect.nonlinear if p.scan is not None and p.free]
    return bool(effect.relaxed) or (not effect.modifies and len(scanned) <= MOST_AXES)


def items_of(along: Along) -> list[Item]:
    """What a model has to scan, in its order."""
    out = []
    for effect in along.layout.model.effects:
        g = next(k for k, group in enumerate(along.groups) if effect.name in group.names)
        scanned = [p for p in effect.nonlinear if p.scan is not None and p.free]
        if not is_scannable(effect) or effect.relaxed:
            continue
        if effect.single:
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

    def scan(self, item: Item, state: State, data: Array) -> Scan:
        """What every form of an item gains beside a law without it."""
        table = self.table(item, state)
        mine = coefficients_of(self.along, item)
        cross, right = table.against(self.along, state, data)
        return _scanned(table, state, (cross, right), (self.along.low[mine], self.along.high[mine]))

    def pairs(self, item: Item, state: State, data: Array) -> Scan:
        """What two neighbouring points of one scan would gain together: two lines closer than they can be parted."""
        table = self.table(item, state)
        cross, right = table.against(self.along, state, data)
        two = replace(table, gram=table.neighbours(), grid=table.grid.shortened())
        both = np.concatenate([cross[:-1], cross[1:]], axis=1), np.concatenate([right[:-1], right[1:]], axis=1)
        return _scanned(two, state, both, (-np.inf, np.inf))

    def _build(self, item: Item, state: State) -> Table:
        along, grid = self.along, self.grid(item)
        numbers = np.tile(state.numbers, (len(grid.values), 1))
        for name, values in zip(grid.names, grid.values.T, strict=True):
            for i, s in enumerate(along.layout.slots):
                if (s.effect, s.parameter) == (item.effect, name) and (item.run is None or s.run in (None, item.run)):
                    numbers[:, i] = values
        mine = coefficients_of(along, item)
        rows, at = [], []
        gram = np.zeros((len(numbers), len(mine), len(mine)))
        for b, block in enumerate(along.blocks):
            place = along.place[item.g][block.run]
            kept = np.flatnonzero(np.isin(place, mine))
            if item.run is not None and block.run != item.run:
                kept = kept[:0]
            parts = [along.rows(item.g, b, part)[:, kept] for part in _crowds(numbers)] if len(kept) else []
            made = np.concatenate(parts) if parts else np.zeros((len(numbers), 0, len(block.data)))
            a = np.searchsorted(mine, place[kept])
            gram[np.ix_(np.arange(len(numbers)), a, a)] += made @ made.transpose(0, 2, 1)
            rows.append(made.reshape(-1, len(block.data)).astype(np.float32))
            at.append(a)
        return Table(grid, rows, at, gram)


def _crowds(numbers: Array) -> list[Array]:
    return np.array_split(numbers, max(1, -(-len(numbers) // CROWD)))


def _scanned(
    table: Table, state: State, products: tuple[Array, Array], box: tuple[Array | float, Array | float]
) -> Scan:
    """Gains of all forms beside a law that has none of them, its levels free as far as they are held.

    `products` are those with its rows and levels (G, C, K + R) and with its residual (G, C).
    """
    cross, right = products
    schur, already = table.gram.copy(), 0.0
    free = np.concatenate([state.moving, state.levels.rows.any(axis=1)])
    if free.any():
        inverse, size, pull = _beside(state, free)
        beside = cross[:, :, free] / size
        flat = (beside.reshape(-1, len(size)) @ inverse).reshape(beside.shape)
        schur -= flat @ beside.transpose(0, 2, 1)
        right, already = right - flat @ pull, float(pull @ inverse @ pull)
    c = np.clip(_solve(schur, right, np.einsum("gcc->gc", table.gram)), *box)
    bent = (schur @ c[:, :, None])[:, :, 0]
    return Scan(table.grid, np.einsum("gc,gc->g", c, 2 * right - bent) + already, c)


def _beside(state: State, free: Mask) -> tuple[Array, Array, Array]:
    """Of the free rows and levels of a law (k,): their inverse Gram matrix, in units of their sizes (k,), and pulls."""
    rows = np.concatenate([state.rows, state.levels.rows])[free]
    k, own = len(state.coefficients), state.levels
    held, pull = np.zeros((len(free), len(free))), np.zeros(len(free))
    held[k:, k:], pull[k:] = own.held, own.pull
    gram = rows @ rows.T + held[np.ix_(free, free)]
    size = np.sqrt(gram.diagonal())
    unit = gram / size / size[:, None]
    unit.flat[:: len(size) + 1] += 1e-12
    return np.linalg.inv(unit), size, pull[free] / size


def _solve(schur: Array, right: Array, full: Array) -> Array:
    """Best coefficients (G, C) of forms with what remains of their Gram matrices; absorbed forms get none."""
    count = schur.shape[1]
    floor = ABSORBED * full
    if count == 1:
        own = schur[:, :, 0]
        return right / np.where(own > floor, own, np.inf)
    if count == 2:
        a, b, d = schur[:, 0, 0], schur[:, 0, 1], schur[:, 1, 1]
        det = a * d - b * b
        good = det > ABSORBED * full[:, 0] * full[:, 1]
        det = np.where(good, det, np.inf)
        out = np.stack([(d * right[:, 0] - b * right[:, 1]) / det, (a * right[:, 1] - b * right[:, 0]) / det], axis=1)
        return out
    size = np.sqrt(np.where(full > 0, full, 1.0))
    unit = schur / size[:, :, None] / size[:, None, :] + ABSORBED * np.eye(count)
    return np.linalg.solve(unit, (right / size)[:, :, None])[:, :, 0] / size
