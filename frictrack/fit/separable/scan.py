"""Scan an effect over a grid of its non-linear parameters, added to a solution: every gain in closed form, all at once.

What is free of the solution, its coefficients and to first order its non-linear parameters, is projected out of the
columns at the grid points. Where an effect of the solution moves to another grid point, its own columns come back by a
low-rank update, so that one projection serves every move. A table of columns depends only on the motion: it serves
every data set along it, and all instances of one effect.

References
----------
Golub, G. H. & Van Loan, C. F. (2013). Matrix Computations, sec. 2.1.4. Johns Hopkins University Press.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from frictrack.effects import Effect, Parameter
from frictrack.fit.separable.bounded import RIDGE
from frictrack.fit.separable.model import Indices, SeparableModel
from frictrack.fit.separable.projected import ProjectedProblem, SeparableSolution
from frictrack.records import Array

MAX_SCAN_AXES = 3  # parameters of one effect that are scanned together
MAX_AT_ONCE = 64  # grid points evaluated at once
MIN_UNEXPLAINED_SHARE = 1e-6  # smallest share of a column outside the model


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
        Data per unit coefficient in every block b, over `scale`.
    at : list of array of int
        Which of the C coefficients the columns of a block belong to.
    gram : array of shape (G, C, C)
        Gram matrices.
    scale : float
        The largest datum: products of larger ones could leave the range of single precision.

    """

    columns: list[NDArray[np.float32]]
    at: list[Indices]
    gram: Array
    scale: float

    @classmethod
    def of(cls, separable: SeparableModel, item: ScanItem, nonlinear_values: Array) -> ScanTable:
        """Evaluate the columns of an item at all grid points, its other parameters as in a vector (P,)."""
        grid, mine = item.grid, item.coefficients
        vectors = np.tile(nonlinear_values, (len(grid.values), 1))
        for slots, values in zip(item.slots, grid.values.T, strict=True):
            vectors[:, slots] = values[:, None]
        chunks = np.array_split(vectors, -(-len(vectors) // MAX_AT_ONCE))
        columns, at, gram = [], [], np.zeros((len(vectors), len(mine), len(mine)))
        for b, block in enumerate(separable.blocks):
            place = separable.column_positions[item.g][block.run]
            kept = np.flatnonzero(np.isin(place, mine) & (item.run in (None, block.run)))
            own = np.zeros((len(vectors), 0, len(block.data)))
            if len(kept):
                own = np.concatenate([separable.rows(item.g, b, part)[:, kept] for part in chunks])
            at.append(np.searchsorted(mine, place[kept]))
            gram[np.ix_(np.arange(len(gram)), at[-1], at[-1])] += own @ own.transpose(0, 2, 1)
            columns.append(own)
        scale = max(1e-300, *(float(np.abs(own).max(initial=0.0)) for own in columns))
        return cls([(own / scale).astype(np.float32) for own in columns], at, gram, scale)

    def products(self, slices: Sequence[slice], rows: Array) -> Array:
        """Compute inner products (k, G, C) of the columns with rows (k, M)."""
        out = np.zeros((len(rows), *self.gram.shape[:2]))
        size = np.maximum(np.abs(rows).max(axis=1, initial=0.0), 1e-300)
        single = (rows / size[:, None]).astype(np.float32)
        for columns, at, cut in zip(self.columns, self.at, slices, strict=True):
            if len(at):
                shown = np.flatnonzero(single[:, cut].any(axis=1))  # most rows belong to one run
                flat = columns.reshape(-1, columns.shape[2])
                own = (single[shown, cut] @ flat.T).reshape(len(shown), *columns.shape[:2])
                out[np.ix_(shown, np.arange(out.shape[1]), at)] += own
        out *= (self.scale * size)[:, None, None]
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
        tangent = problem.tangent(state, problem.separable.free)
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
