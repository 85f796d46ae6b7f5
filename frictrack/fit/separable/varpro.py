"""Fit by variable projection: scan effects in closed form, refine off the grid, exchange positions until none helps.

Effects without a scan are in the model from the start. Then every grid point of every missing effect is tried at
once, the best one is added, and all parameters are refined together before the next. A weak spectral line is
otherwise hidden in the leakage of a strong line that is still on the grid. At the end each effect in turn is removed
and scanned again with all others. Every promising position is refined, and kept if the misfit falls.

Scan an effect over a grid of its non-linear parameters, added to a solution: every gain in closed form, all at once.

What is free of the solution, its coefficients and to first order its non-linear parameters, is projected out of the
columns at the grid points. Where an effect of the solution moves to another grid point, its own columns come back by a
low-rank update, so that one projection serves every move. A table of columns depends only on the motion: it serves
every data set along it, and all instances of one effect.

References
----------
Golub, G. H. & Pereyra, V. (1973). SIAM J. Numer. Anal. 10, 413-432.
Golub, G. H. & Van Loan, C. F. (2013). Matrix Computations, sec. 2.1.4. Johns Hopkins University Press.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from frictrack.base.workers import rows_at_once
from frictrack.effects import Effect, Parameter
from frictrack.fit.separable.model import Indices, SeparableModel
from frictrack.fit.separable.projected import RIDGE, ProjectedProblem, SeparableSolution
from frictrack.records import Array

MAX_SCAN_AXES = 3  # parameters of one effect that are scanned together
MIN_UNEXPLAINED_SHARE = 1e-6  # smallest share of a column outside the model
MAX_PLACES = 3  # grid points of one scan that are refined
ROUGH_STEPS = 3  # steps while effects are still missing
MAX_LAG_SHARE = 0.1  # share of an effect's gain by which a grid point may be behind and still be refined
MAX_LAG_CHI2 = 12.0  # the same in units of chi-squared per frame
MAX_PAIR_GAIN_RATIO = 3.0  # times the gain of one more line: the most that a line may be worth which leaves for a pair
LARGE_GAIN_CHI2 = 30.0  # units of chi-squared per frame; more than the best of a thousand grid points gains by chance
SHORT_SCAN_POINTS = 64  # grid points of a scan of negligible cost
MIN_GAIN_SHARE = 1e-6  # least gain of a trial, share of the misfit
MIN_GAIN_CHI2 = 0.05  # the same in units of chi-squared per frame; less changes no decision


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

    def place(self, values: Array) -> Indices:
        """Return the index on every axis that is nearest to values (d,)."""
        return np.array([np.argmin(np.abs(axis - v)) for axis, v in zip(self.axes, values, strict=True)])

    def peaks(self, heights: Array, least: float) -> Indices:
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
        out, cube = self.values[g].copy(), heights.reshape(self.shape)
        at: tuple[int | slice, ...] = tuple(map(int, np.unravel_index(g, self.shape)))
        for i, (axis, step) in enumerate(zip(self.axes, np.unravel_index(g, self.shape), strict=True)):
            if 0 < step < len(axis) - 1:
                around = slice(step - 1, step + 2)
                out[i] = _vertex(axis[around], cube[(*at[:i], around, *at[i + 1 :])])
        return out


def _vertex(x: Array, y: Array) -> float:
    """Place of the vertex of the parabola through three points of which the middle one is the highest."""
    left, right = np.diff(y) / np.diff(x) * [1, -1]
    if not left + right > 0:
        return float(x[1])
    return float(x[1] + 0.5 * (left * (x[2] - x[1]) - right * (x[1] - x[0])) / (left + right))


def is_scannable(effect: Effect) -> bool:
    """Return whether an effect can be scanned on a grid: it modifies no other and has few scanned parameters.

    An effect with relaxed parts is scanned part by part.
    """
    return bool(effect.relaxed) or (not effect.modifies and len(_scanned_parameters(effect)) <= MAX_SCAN_AXES)


def _scanned_parameters(effect: Effect) -> list[Parameter]:
    return [p for p in effect.nonlinear if p.scan is not None and p.free]


@dataclass(frozen=True, eq=False)
class ScanItem:
    """An effect to scan, in group `g`; in one `run` if its scan belongs to single runs.

    Attributes
    ----------
    effect : Effect
        The effect.
    g : int
        Its group.
    run : int or None
        Its run.
    kind : int
        The same for instances of one effect, which share a table.
    grid : ScanGrid
        The grid of its scanned parameters, without frequencies above the band of the data.
    coefficients : array of int, shape (C,)
        Its coefficients among those of the model.
    slots : list of list of int
        Positions in the layout that each scanned parameter sets.
    others : list of int
        Positions of the parameters of its group that are not scanned.

    """

    effect: Effect
    g: int
    run: int | None
    kind: int
    grid: ScanGrid
    coefficients: Indices
    slots: list[list[int]]
    others: list[int]

    @classmethod
    def of(cls, separable: SeparableModel, effect: Effect, run: int | None, kind: int) -> ScanItem:
        """Describe the scan of an effect, in one run or in all."""
        layout, scanned, runs = separable.layout, _scanned_parameters(effect), (None, run)
        g = next(k for k, group in enumerate(separable.groups) if effect.name in group.names)
        places = [(i, s) for i, s in enumerate(layout.slots) if run is None or s.run in runs]
        slots = [[i for i, s in places if (s.effect, s.parameter) == (effect.name, p.name)] for p in scanned]
        coefficients = enumerate(separable.coefficients)
        return cls(
            effect=effect,
            g=g,
            run=run,
            kind=kind,
            grid=ScanGrid(tuple(p.name for p in scanned), tuple(_axis(separable, p, run) for p in scanned)),
            coefficients=np.array(
                [i for i, c in coefficients if c.effect == effect.name and (run is None or c.run in runs)]
            ),
            slots=slots,
            others=[i for i in separable.groups[g].nonlinear_slots if layout.slots[i].run in runs and [i] not in slots],
        )

    def is_at(self, values: Array, g: int) -> bool:
        """Return whether a parameter vector (P,) has the effect within one grid step of a point."""
        place = self.grid.place(values[[slots[0] for slots in self.slots]])
        return bool(np.all(np.abs(place - np.unravel_index(g, self.grid.shape)) <= 1))


def _axis(separable: SeparableModel, p: Parameter, run: int | None) -> Array:
    """Scanned values of a parameter."""
    assert p.scan is not None
    axis = np.asarray(p.scan(separable.layout.span if run is None else separable.layout.spans[run]), dtype=float)
    axis = axis[(axis >= p.bounds[0]) & (axis <= p.bounds[1])]
    highest = max(b.highest for b in separable.blocks)
    return axis[axis < highest] if p.unit == "Hz" and np.any(axis < highest) else axis


def scan_items(separable: SeparableModel) -> list[ScanItem]:
    """Return the effects of a model that are scanned, in its order."""
    out, kinds = [], dict[tuple[object, ...], int]()
    for effect in separable.layout.model.effects:
        is_placed = effect.single or (_scanned_parameters(effect) and effect.linear)
        scanned = is_scannable(effect) and not effect.relaxed and is_placed
        present = [r for r in separable.runs if (effect.name, r) not in separable.layout.absent]
        for run in (present if effect.single else [None]) if scanned else ():
            kind = kinds.setdefault((effect.columns, effect.parameters, run), len(kinds))
            out.append(ScanItem.of(separable, effect, run, kind))
    return out


@dataclass(frozen=True, eq=False)
class ScanTable:
    """Columns of an effect at every grid point, in single precision: they only show where to refine.

    Attributes
    ----------
    columns : list of array of shape (G, c_b, m_b)
        Data per unit coefficient in every block b, over their sizes: others could leave the range of single precision.
    sizes : list of array of shape (G, c_b)
        The largest datum of each column.
    at : list of array of int
        Which of the C coefficients the columns of a block belong to.
    gram : array of shape (G, C, C)
        Gram matrices.

    """

    columns: list[NDArray[np.float32]]
    sizes: list[Array]
    at: list[Indices]
    gram: Array

    @classmethod
    def of(cls, separable: SeparableModel, item: ScanItem, nonlinear_values: Array) -> ScanTable:
        """Evaluate the columns of an item at all grid points, its other parameters as in a vector (P,)."""
        grid, mine = item.grid, item.coefficients
        vectors = np.tile(nonlinear_values, (len(grid.values), 1))
        for slots, values in zip(item.slots, grid.values.T, strict=True):
            vectors[:, slots] = values[:, None]
        at_once = rows_at_once(max(len(block.path.t) for block in separable.blocks))
        parts = [slice(first, first + at_once) for first in range(0, len(vectors), at_once)]
        columns, sizes, at, gram = [], [], [], np.zeros((len(vectors), len(mine), len(mine)))
        for b, block in enumerate(separable.blocks):
            place = separable.column_positions[item.g][block.run]
            kept = np.flatnonzero(np.isin(place, mine) & (item.run in (None, block.run)))
            size, squares = np.ones((len(vectors), len(kept))), np.zeros((len(vectors), len(kept), len(kept)))
            single = np.empty((*size.shape, len(block.data)), np.float32)
            for part in parts if len(kept) else ():
                own = separable.rows(item.g, b, vectors[part])[:, kept]
                squares[part] = own @ own.transpose(0, 2, 1)
                size[part] = np.maximum(np.abs(own).max(axis=2), 1e-300)
                single[part] = own / size[part][:, :, None]
            at.append(np.searchsorted(mine, place[kept]))
            gram[np.ix_(np.arange(len(gram)), at[-1], at[-1])] += squares
            columns.append(single)
            sizes.append(size)
        return cls(columns, sizes, at, gram)

    def products(self, slices: Sequence[slice], rows: Array) -> Array:
        """Compute inner products (k, G, C) of the columns with rows (k, M)."""
        out = np.zeros((len(rows), *self.gram.shape[:2]))
        size = np.maximum(np.abs(rows).max(axis=1, initial=0.0), 1e-300)
        single = (rows / size[:, None]).astype(np.float32)
        for columns, sizes, at, cut in zip(self.columns, self.sizes, self.at, slices, strict=True):
            if len(at):
                shown = np.flatnonzero(single[:, cut].any(axis=1))  # most rows belong to one run
                flat = columns.reshape(-1, columns.shape[2])
                own = (single[shown, cut] @ flat.T).reshape(len(shown), *columns.shape[:2])
                out[np.ix_(shown, np.arange(out.shape[1]), at)] += own * sizes
        out *= size[:, None, None]
        return out


@dataclass(frozen=True, eq=False)
class ScanGains:
    """How much every grid point (G,) lowers the misfit of a solution, the parameters that are not scanned following it.

    `loss` is the rise of the misfit where an effect leaves its position, which is included.
    """

    grid: ScanGrid
    gains: Array
    loss: float = 0.0

    @cached_property
    def best(self) -> int:
        """The point of the largest gain."""
        return int(np.argmax(self.gains))

    @property
    def largest(self) -> float:
        """The largest gain."""
        return float(self.gains[self.best])

    def peaks(self, least: float) -> Indices:
        """Return the local maxima of at least some gain that explain anything, best first."""
        return self.grid.peaks(self.gains, max(least, np.finfo(float).tiny - self.loss))

    def summit(self, g: int) -> Array:
        """Return the values (d,) of the parameters at the local maximum next to a grid point."""
        return self.grid.summit(self.gains, g)


class SolutionScan:
    """Scans of effects added to a solution, whose coefficients and non-linear parameters follow to first order.

    Without these parameters a sinusoid of few periods would hide a better exponential, and the other way round.

    Parameters
    ----------
    problem : ProjectedProblem
        The problem.
    state : SeparableSolution
        Its solution.

    """

    def __init__(self, problem: ProjectedProblem, state: SeparableSolution) -> None:
        self.separable, self.state = problem.separable, state
        groups = [self.separable.groups[g] for g in state.columns]
        tangent = problem.tangent(state, sorted({i for group in groups for i in group.nonlinear_slots}))
        across = state.rows @ tangent.rows.T
        normal = np.block([[state.gram, across], [across.T, tangent.normal]])
        free = np.concatenate([state.unconstrained, tangent.is_inside]) & (normal.diagonal() > 0)
        size = np.sqrt(normal.diagonal()[free])
        unit = normal[np.ix_(free, free)] / (size * size[:, None])
        unit.flat[:: len(size) + 1] += RIDGE
        gradient = np.concatenate([np.zeros(len(state.gram)), tangent.gradient])[free] / size
        self._inverse = np.linalg.inv(unit)
        self._gradient, step = gradient, self._inverse @ gradient
        self._gain = float(gradient @ step)  # fall of the misfit to the minimum of the linearised solution
        self._coefficients = np.concatenate([state.coefficients, np.zeros(len(tangent.positions))])[free] * size + step
        self._rows = np.concatenate([state.rows, tangent.rows])[free] / size[:, None]
        owners = [*self.separable.coefficients, *(self.separable.layout.slots[i] for i in tangent.positions)]
        self._owners = [(owner.effect, owner.run) for owner, is_free in zip(owners, free, strict=True) if is_free]
        self._projected: dict[int, tuple[Array, Array, Array]] = {}
        self._one_more: dict[int, ScanGains] = {}

    def one_more(self, item: ScanItem, table: ScanTable) -> ScanGains:
        """Return the gains of one more effect like an item."""
        if item.kind not in self._one_more:
            _, schur, right = self._without_solution(table)
            gains = _gains(schur, right, table, self._box(item)) + self._gain
            self._one_more[item.kind] = ScanGains(item.grid, gains)
        return self._one_more[item.kind]

    def moved(self, item: ScanItem, table: ScanTable) -> ScanGains:
        """Return the gains of an item of the solution at every grid point, where it leaves its own position."""
        dual, schur, right = self._without_solution(table)
        own = [
            i for i, (effect, run) in enumerate(self._owners) if effect == item.effect.name and item.run in (None, run)
        ]
        precision = np.linalg.inv(self._inverse[np.ix_(own, own)])
        lift, coefficients = _times(precision, dual[own]), self._coefficients[own]
        gains = _gains(schur + _outer_sum(dual[own], lift), right + _times(coefficients, lift), table, self._box(item))
        loss = float(coefficients @ precision @ coefficients) - self._gain
        return ScanGains(item.grid, gains - loss, loss)

    def _without_solution(self, table: ScanTable) -> tuple[Array, Array, Array]:
        """Coordinates (k, G, C) of a table in the solution's rows; Gram matrix and products with data without these."""
        if id(table) not in self._projected:
            products = table.products(self.separable.slices, np.vstack([self._rows, self.state.residual]))
            rows, right = products[:-1], products[-1]
            dual = _times(self._inverse, rows)
            self._projected[id(table)] = dual, table.gram - _outer_sum(dual, rows), right - _times(self._gradient, dual)
        return self._projected[id(table)]

    def _box(self, item: ScanItem) -> tuple[Array, Array]:
        """Bounds (C,) of the coefficients of an item."""
        return self.separable.low[item.coefficients], self.separable.high[item.coefficients]


def _times(matrix: Array, rows: Array) -> Array:
    """Product (..., G, C) of a matrix (..., k) with rows (k, G, C)."""
    return np.tensordot(matrix, rows, 1)


def _outer_sum(left: Array, right: Array) -> Array:
    """Sums over k of the products (G, C, C) of rows (k, G, C)."""
    return np.asarray(left.transpose(1, 2, 0) @ right.transpose(1, 0, 2))


def _gains(schur: Array, right: Array, table: ScanTable, box: tuple[Array, Array]) -> Array:
    """Gains (G,) with the best coefficients within a box, clipped there; points that the model absorbs gain nothing."""
    full = np.einsum("gcc->gc", table.gram)
    size = np.sqrt(np.where(full > 0, full, 1.0))
    unit = schur / size[:, :, None] / size[:, None, :] + MIN_UNEXPLAINED_SHARE * np.eye(full.shape[1])
    own, (low, high) = right / size, (bound * size for bound in box)
    c = np.clip(np.linalg.solve(unit, own[:, :, None])[:, :, 0], low, high)
    return np.asarray(np.sum(c * (2 * own - (unit @ c[:, :, None])[:, :, 0]), axis=1))


class VariableProjection:
    """Variable projection along the measured motion. Its tables are reused for further data sets.

    Parameters
    ----------
    separable : SeparableModel
        The model over its data.
    tau : float
        Relative standard deviation of the friction levels.

    """

    def __init__(self, separable: SeparableModel, tau: float = 0.03) -> None:
        self.separable, self.tau = separable, tau
        self.items = scan_items(separable)
        self.unscanned_groups = set(range(len(separable.groups))) - {i.g for i in self.items}
        self._tables: dict[int, tuple[list[float], ScanTable]] = {}
        self._last: SolutionScan | None = None

    def __call__(self, data: Array | None = None) -> SeparableSolution:
        """Return the best solution found for whitened data (M,); default those of the blocks."""
        problem = self.problem(self.separable.data if data is None else data)
        state = problem.solved_again(self._start)
        if problem.levels:
            state = problem.refine(state, self.unscanned_groups, steps=ROUGH_STEPS)
        return self._exchange_until_no_gain(problem, self._add_items(problem, state, self.items), self.items)

    def problem(self, data: Array) -> ProjectedProblem:
        """Return the projected problem of data (M,)."""
        return self._problem.for_data(data)

    @cached_property
    def _problem(self) -> ProjectedProblem:
        """The projected problem of the blocks' own data."""
        return ProjectedProblem(self.separable, self.separable.data, self.tau)

    @cached_property
    def _start(self) -> SeparableSolution:
        """The solution without any scanned effect, for the blocks' own data."""
        return self._problem.at(self.start_values(), groups=self.unscanned_groups)

    def start_values(self) -> Array:
        """Return first values (P,): levels one, the others inside their bounds."""
        low, high = self.separable.layout.bounds
        is_known = np.array([s.linear for s in self.separable.layout.slots]) | (low <= 1.0) & (high >= 1.0)
        with np.errstate(invalid="ignore"):
            middle = 0.5 * (low + high)
        return np.where(is_known | ~np.isfinite(middle), 1.0, middle)

    def unneeded_events(self, state: SeparableSolution, penalty: float) -> frozenset[tuple[str, int]]:
        """Return the events of single runs, (effect, run), that gain less than a penalty.

        The best run of every effect is kept in any case.
        """
        problem, gains = self._problem, dict[tuple[str, int], float]()
        for item in self.items:
            if item.run is None:
                continue
            left = problem.without(state, item.coefficients)
            if problem.levels:  # friction levels may explain part of it
                left = problem.refine(left, (), steps=ROUGH_STEPS)
            gains[item.effect.name, item.run] = left.misfit - state.misfit
        best = {effect: max(g for (e, _), g in gains.items() if e == effect) for effect, _ in gains}
        return frozenset(event for event, g in gains.items() if g < min(penalty, best[event[0]]))

    def exchange_positions(self, problem: ProjectedProblem, state: SeparableSolution, effect: str) -> SeparableSolution:
        """Exchange the positions of one effect, and of all effects with a short scan, until none helps."""
        items = [i for i in self.items if i.effect.name == effect or len(i.grid.values) <= SHORT_SCAN_POINTS]
        return self._exchange_until_no_gain(problem, problem.refine(state), items)

    def restart_effect(self, problem: ProjectedProblem, state: SeparableSolution, effect: str) -> SeparableSolution:
        """Remove one effect, find it again run by run, largest gain first, and exchange positions."""
        items = [i for i in self.items if i.effect.name == effect]
        without_effect = problem.without(state, np.concatenate([i.coefficients for i in items]))
        start = problem.refine(without_effect, self.groups_without(items), steps=ROUGH_STEPS)
        return self.exchange_positions(problem, self._add_items(problem, start, items), effect)

    def misses_effect(self, problem: ProjectedProblem, state: SeparableSolution) -> bool:
        """Whether one more effect of any kind would gain far more than by chance, so that a position must be wrong."""
        gains = (self.one_more(problem, state, i).largest for i in self.items)
        return max(gains, default=0.0) > LARGE_GAIN_CHI2 * state.misfit / self.separable.size

    # --- scans

    def _scan(
        self, problem: ProjectedProblem, state: SeparableSolution, item: ScanItem
    ) -> tuple[SolutionScan, ScanTable]:
        """The scans of a solution, and the table of an item, kept while other parameters of its group are the same."""
        if self._last is None or self._last.state is not state:
            self._last = SolutionScan(problem, state)
        others = state.nonlinear_values[item.others].tolist()
        if item.kind not in self._tables or self._tables[item.kind][0] != others:
            self._tables[item.kind] = others, ScanTable.of(self.separable, item, state.nonlinear_values)
        return self._last, self._tables[item.kind][1]

    def one_more(self, problem: ProjectedProblem, state: SeparableSolution, item: ScanItem) -> ScanGains:
        """The gain of every grid point of one more effect like an item."""
        scans, table = self._scan(problem, state, item)
        return scans.one_more(item, table)

    def moved(self, problem: ProjectedProblem, state: SeparableSolution, item: ScanItem) -> ScanGains:
        """The gain of every grid point of an item that leaves its own position."""
        scans, table = self._scan(problem, state, item)
        return scans.moved(item, table)

    # --- search

    def _add_items(
        self, problem: ProjectedProblem, state: SeparableSolution, items: Sequence[ScanItem]
    ) -> SeparableSolution:
        """Add the effect that gains most, refine, and go on until none is missing; events in all runs at once."""
        remaining = list(items)
        while remaining:
            scans = {i: self.one_more(problem, state, i) for i in {i.kind: i for i in reversed(remaining)}.values()}
            best = max(scans, key=lambda i: scans[i].largest)
            chosen = {i.run: i for i in sorted(scans, key=lambda i: scans[i].largest) if i.effect is best.effect}
            added = {i: scans[i].summit(scans[i].best) for i in chosen.values()}
            remaining = [i for i in remaining if i not in added]
            state = self.with_items_at(problem, state, added)
            if remaining:
                state = problem.refine(state, self.groups_without(remaining), steps=ROUGH_STEPS, enough=1e-3)
        return problem.refine(state)

    def groups_without(self, remaining: Sequence[ScanItem]) -> set[int]:
        """Groups without those of the remaining items."""
        return set(range(len(self.separable.groups))) - {i.g for i in remaining}

    def with_items_at(
        self, problem: ProjectedProblem, state: SeparableSolution, values: Mapping[ScanItem, Array]
    ) -> SeparableSolution:
        """The solution with the scanned parameters of some items at some values (d,)."""
        nonlinear_values = state.nonlinear_values.copy()
        for item, own in values.items():
            for slots, value in zip(item.slots, own, strict=True):
                nonlinear_values[slots] = value
        taking_part = np.concatenate([item.coefficients for item in values])
        return problem.at(nonlinear_values, state, {item.g for item in values}, taking_part)

    def _exchange_until_no_gain(
        self, problem: ProjectedProblem, state: SeparableSolution, items: Sequence[ScanItem]
    ) -> SeparableSolution:
        """Try other positions of every effect, then of pairs of effects, the most promising first, until none helps."""
        needed = 1 - max(MIN_GAIN_SHARE, MIN_GAIN_CHI2 / self.separable.size)
        better: SeparableSolution | None = state
        while better is not None:
            state, better = better, None
            for trials in (self._other_positions, self._other_pairs):
                for trial in trials(problem, state, items):
                    refined = problem.refine(trial, below=needed * state.misfit)
                    if refined.misfit < needed * state.misfit:
                        better = refined
                        break
                if better is not None:
                    break
        return state

    def _other_positions(
        self, problem: ProjectedProblem, state: SeparableSolution, items: Sequence[ScanItem]
    ) -> Iterator[SeparableSolution]:
        """The solution with one effect at another position that is worth a refinement, the most promising first."""
        places = []
        for item in items:
            found = self.moved(problem, state, item)
            for g in found.peaks(-self._max_lag(state, found.loss))[:MAX_PLACES].tolist():
                if not item.is_at(state.nonlinear_values, g):
                    places.append((float(found.gains[g]), item, found.summit(g)))
        for _, item, values in sorted(places, key=lambda place: -place[0]):
            yield self.with_items_at(problem, state, {item: values})

    def _max_lag(self, state: SeparableSolution, loss: float) -> float:
        """By how much a grid point may be behind and still be refined, where an effect of some gain moves there."""
        return MAX_LAG_SHARE * loss + MAX_LAG_CHI2 * state.misfit / self.separable.size

    def _other_pairs(
        self, problem: ProjectedProblem, state: SeparableSolution, items: Sequence[ScanItem]
    ) -> Iterator[SeparableSolution]:
        """The solution with two effects elsewhere: two lines in place of one, or two that exchange places."""
        if len(items) < 2:
            return
        misses_effect = self.misses_effect(problem, state)
        loss = {i: self.moved(problem, state, i).loss for i in items}
        for one, other in permutations(items, 2):
            gain = self.one_more(problem, state, one).largest
            is_pair = one.kind == other.kind and len(one.slots) == 1
            if is_pair and min(loss[one], loss[other]) < MAX_PAIR_GAIN_RATIO * gain:
                yield self._with_line_split(problem, state, one, other)
            if misses_effect and (one.run == other.run or None in (one.run, other.run)):
                yield self._with_both_again(problem, state, one, other)

    def _with_line_split(
        self, problem: ProjectedProblem, state: SeparableSolution, one: ScanItem, other: ScanItem
    ) -> SeparableSolution:
        """Two lines at the grid points on either side of one of them, which a single one hardly differs from."""
        axis, value = one.grid.axes[0], state.nonlinear_values[one.slots[0][0]]
        g = int(np.clip(np.searchsorted(axis, value), 1, len(axis) - 1))
        return self.with_items_at(problem, state, {one: axis[[g - 1]], other: axis[[g]]})

    def _with_both_again(
        self, problem: ProjectedProblem, state: SeparableSolution, one: ScanItem, other: ScanItem
    ) -> SeparableSolution:
        """Both items removed, then `one` and after it `other` at their best positions."""
        state = problem.without(state, np.concatenate([one.coefficients, other.coefficients]))
        for item in (one, other):
            found = self.one_more(problem, state, item)
            state = self.with_items_at(problem, state, {item: found.summit(found.best)})
        return state
