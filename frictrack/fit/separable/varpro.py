"""Fit by variable projection: scan effects in closed form, refine off the grid, exchange positions until none helps.

Effects without a scan are in the model from the start. Then every grid point of every missing effect is tried at
once, the best one is added, and all parameters are refined together before the next. A weak spectral line is
otherwise hidden in the leakage of a strong line that is still on the grid. At the end each effect in turn is removed
and scanned again beside all others. Every promising position is refined, and kept if the misfit falls.

References
----------
Golub, G. H. & Pereyra, V. (1973). SIAM J. Numer. Anal. 10, 413-432.

"""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations

import numpy as np

from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.newton import ProjectedProblem, SeparableSolution
from frictrack.fit.separable.scan_tables import ScanItem, ScanTables, coefficients_of, scanned_effects
from frictrack.fit.separable.table_scan import ScanGrid, TableScan
from frictrack.records import Array

MAX_PLACES = 3  # grid points of one scan that are refined
MAX_PAIR_PLACES = 2  # pairs of neighbouring lines that are refined
ROUGH_STEPS = 3  # steps while effects are still missing
MAX_LAG_SHARE = 0.1  # share of an effect's gain by which a grid point may be behind and still be refined
MAX_LAG_CHI2 = 12.0  # the same in units of chi-squared per frame
MIN_COUPLING = 0.1  # least shared variance of two effects that are searched again together
LARGE_GAIN_CHI2 = 30.0  # units of chi-squared per frame; more than the best of a thousand grid points gains by chance
SHORT_SCAN_POINTS = 64  # grid points of a scan of negligible cost
MIN_GAIN_SHARE = 1e-6  # least gain of a trial, share of the misfit
MIN_GAIN_CHI2 = 0.05  # the same in units of chi-squared per frame; less changes no decision


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
        self.tables = ScanTables(separable)
        self.items = scanned_effects(separable)
        self.item_coefficients = {item: coefficients_of(separable, item) for item in self.items}
        self.unscanned_groups = {g for g, group in enumerate(separable.groups) if g not in {i.g for i in self.items}}

    def __call__(self, data: Array | None = None, nonlinear_values: Array | None = None) -> SeparableSolution:
        """Fit data.

        Parameters
        ----------
        data : array of shape (M,), optional
            Whitened data; default those of the blocks.
        nonlinear_values : array of shape (P,), optional
            First values of parameters that no scan finds.

        Returns
        -------
        SeparableSolution
            The best solution found.

        """
        problem = ProjectedProblem(self.separable, self.separable.data if data is None else data, self.tau)
        return self._exchange_until_no_gain(problem, self.start_solution(problem, nonlinear_values))

    def start_solution(self, problem: ProjectedProblem, nonlinear_values: Array | None = None) -> SeparableSolution:
        """Return the solution with every effect at the position that gained most when it was added, refined roughly."""
        start_values = self.start_values() if nonlinear_values is None else nonlinear_values
        state = problem.at(start_values, problem.empty_solution(start_values), self.unscanned_groups)
        if problem.levels:
            state = problem.refine(state, self.unscanned_groups, steps=ROUGH_STEPS)
        return self._add_items(problem, state)

    def unneeded_events(self, state: SeparableSolution, penalty: float) -> frozenset[tuple[str, int]]:
        """Return the events of single runs that gain less than a penalty.

        Parameters
        ----------
        state : SeparableSolution
            The solution.
        penalty : float
            Smallest gain of chi-squared. The best run of every effect is kept in any case.

        Returns
        -------
        frozenset of (str, int)
            Pairs (effect, run).

        """
        problem = ProjectedProblem(self.separable, self.separable.data, self.tau)
        without_item = {i: problem.without(state, self.item_coefficients[i]) for i in self.items if i.run is not None}
        if problem.levels:  # friction levels may explain part of it
            without_item = {i: problem.refine(law, (), steps=ROUGH_STEPS) for i, law in without_item.items()}
        gains = {i: law.misfit - state.misfit for i, law in without_item.items()}
        best = {e: max(g for i, g in gains.items() if i.effect == e) for e in {i.effect for i in gains}}
        return frozenset(
            (i.effect, i.run) for i, g in gains.items() if i.run is not None and g < min(penalty, best[i.effect])
        )

    def exchange_positions(self, problem: ProjectedProblem, state: SeparableSolution, effect: str) -> SeparableSolution:
        """Exchange the positions of one effect, and of all effects with a short scan, until none helps."""
        all_items = self.items
        self.items = [
            i for i in all_items if i.effect == effect or len(self.tables.grid(i).values) <= SHORT_SCAN_POINTS
        ]
        state = self._exchange_until_no_gain(problem, state)
        self.items = all_items
        return state

    def restart_effect(self, problem: ProjectedProblem, state: SeparableSolution, effect: str) -> SeparableSolution:
        """Remove one effect, find it again run by run, largest gain first, and exchange positions."""
        all_items = self.items
        self.items = [i for i in all_items if i.effect == effect]
        without_item = problem.without(state, np.concatenate([self.item_coefficients[i] for i in self.items]))
        found = self._add_items(
            problem, problem.refine(without_item, self._groups_without(self.items), steps=ROUGH_STEPS)
        )
        self.items = all_items
        return self.exchange_positions(problem, found, effect)

    def start_values(self) -> Array:
        """Return first values (P,): levels one, the others inside their bounds."""
        low, high = self.separable.layout.bounds
        out = np.ones(len(low))
        for i, s in enumerate(self.separable.layout.slots):
            if not s.linear and np.isfinite(low[i]) and np.isfinite(high[i]) and not low[i] <= 1.0 <= high[i]:
                out[i] = 0.5 * (low[i] + high[i])
        return out

    def _add_items(self, problem: ProjectedProblem, state: SeparableSolution) -> SeparableSolution:
        """Add one effect after the other, largest gain first."""
        remaining = list(self.items)
        while remaining:
            scans = self._scans(problem, state, remaining)
            item = max(scans, key=lambda i: float(scans[i].gains.max()))
            remaining.remove(item)
            state = self._with_item_at(problem, state, item, scans[item], int(np.argmax(scans[item].gains)))
            state = problem.refine(state, self._groups_without(remaining), steps=ROUGH_STEPS, enough=1e-3)
        return state

    def _groups_without(self, remaining: list[ScanItem]) -> set[int]:
        """Groups without those of the remaining items."""
        return set(range(len(self.separable.groups))) - {i.g for i in remaining}

    def _with_item_at(
        self, problem: ProjectedProblem, state: SeparableSolution, item: ScanItem, found: TableScan, g: int
    ) -> SeparableSolution:
        """The solution with an item at one point of its scan."""
        nonlinear_values = state.nonlinear_values.copy()
        for name, value in zip(found.grid.names, found.grid.values[g], strict=True):
            for i, s in enumerate(self.separable.layout.slots):
                if (s.effect, s.parameter) == (item.effect, name) and (item.run is None or s.run in (None, item.run)):
                    nonlinear_values[i] = value
        return problem.at(nonlinear_values, state, {item.g}, self.item_coefficients[item])

    def _exchange_until_no_gain(self, problem: ProjectedProblem, state: SeparableSolution) -> SeparableSolution:
        """Try other positions of every effect, then of pairs of effects, until none helps."""
        state = problem.refine(state)
        waiting = list(self.items)
        while True:
            item, better = self._try_other_positions(problem, state, waiting)
            if better is None:
                better = self._try_pairs(problem, state)
            if better is None:
                return state
            state = better
            waiting = [i for i in self.items if i != item] or list(self.items)

    def _try_pairs(self, problem: ProjectedProblem, state: SeparableSolution) -> SeparableSolution | None:
        """A better solution with two effects elsewhere: two lines in place of one, or two that exchange places."""
        shares = self._explained_shares(state)
        misses_effect = self.misses_effect(problem, state)
        for one, other in permutations(self.items, 2):
            same_kind = self._are_same_kind(one, other)
            better = (
                self._try_neighbouring_lines(problem, state, one, other)
                if same_kind and self.items.index(one) < self.items.index(other)
                else None
            )
            may_exchange = misses_effect and not _are_in_different_runs(one, other)
            if better is None and (may_exchange or shares(one, other) > MIN_COUPLING):
                better = self._try_both_again(problem, state, one, other)
            if better is not None:
                return better
        return None

    def misses_effect(self, problem: ProjectedProblem, state: SeparableSolution) -> bool:
        """Whether one more effect of any kind would gain far more than by chance, so that a position must be wrong."""
        best = max((float(s.gains.max()) for s in self._scans(problem, state, self.items).values()), default=0.0)
        return best > LARGE_GAIN_CHI2 * state.misfit / self.separable.size

    def _scans(
        self, problem: ProjectedProblem, state: SeparableSolution, items: list[ScanItem]
    ) -> dict[ScanItem, TableScan]:
        """Scans of one more effect of every kind."""
        kinds = {(self.separable.groups[i.g].model.effects[0].columns, i.run): i for i in reversed(items)}
        return {i: self.tables.scan(i, state, problem.data) for i in kinds.values()}

    def _try_other_positions(
        self, problem: ProjectedProblem, state: SeparableSolution, items: list[ScanItem]
    ) -> tuple[ScanItem | None, SeparableSolution | None]:
        """The first item that is better at another position, and that solution; None if there is none."""
        for item in items:
            found = self.tables.moves(item, state, problem.data)
            max_misfit = self._max_promising_misfit(state, state.misfit + found.loss)
            for g in found.best_distinct(MAX_PLACES):
                misfit = state.misfit + found.loss - found.gains[g]
                if misfit > max_misfit or self._is_current_position(item, state, found, g):
                    continue
                without_item = problem.without(state, self.item_coefficients[item])
                trial = self._with_item_at(problem, without_item, item, found, g)
                better = self._refine_if_better(problem, state, trial)
                if better is not None:
                    return item, better
        return None, None

    def _max_promising_misfit(self, state: SeparableSolution, without_item: float) -> float:
        """Largest misfit on the grid that is worth a refinement."""
        return (
            state.misfit
            + MAX_LAG_SHARE * (without_item - state.misfit)
            + MAX_LAG_CHI2 * state.misfit / self.separable.size
        )

    def _try_neighbouring_lines(
        self, problem: ProjectedProblem, state: SeparableSolution, one: ScanItem, other: ScanItem
    ) -> SeparableSolution | None:
        """A better solution with two lines at neighbouring grid points."""
        found = self.tables.pair_moves((one, other), state, problem.data)
        positions = self._slot_positions(one, found.grid.names), self._slot_positions(other, found.grid.names)
        values = self.tables.grid(one).values
        for g in found.best_distinct(MAX_PAIR_PLACES):
            without_both = state.misfit + found.loss
            if without_both - found.gains[g] > self._max_promising_misfit(state, without_both):
                break
            nonlinear_values = state.nonlinear_values.copy()
            nonlinear_values[positions[0]], nonlinear_values[positions[1]] = values[g], values[g + 1]
            better = self._refine_if_better(problem, state, problem.at(nonlinear_values, state, {one.g, other.g}))
            if better is not None:
                return better
        return None

    def _try_both_again(
        self, problem: ProjectedProblem, state: SeparableSolution, one: ScanItem, other: ScanItem
    ) -> SeparableSolution | None:
        """A better solution with both items removed, then `one` and after it `other` at their best positions."""
        without_both = problem.without(
            state, np.concatenate([self.item_coefficients[one], self.item_coefficients[other]])
        )
        start_values = self.tables.scan(one, without_both, problem.data)
        with_one = self._with_item_at(problem, without_both, one, start_values, int(np.argmax(start_values.gains)))
        without_item = problem.without(with_one, self.item_coefficients[other])
        second = self.tables.scan(other, without_item, problem.data)
        g = int(np.argmax(second.gains))
        if without_item.misfit - second.gains[g] > self._max_promising_misfit(state, without_both.misfit):
            return None
        return self._refine_if_better(problem, state, self._with_item_at(problem, with_one, other, second, g))

    def _refine_if_better(
        self, problem: ProjectedProblem, state: SeparableSolution, trial: SeparableSolution
    ) -> SeparableSolution | None:
        """The refined trial, or None if it does not lower the misfit."""
        needed = state.misfit * (1 - max(MIN_GAIN_SHARE, MIN_GAIN_CHI2 / self.separable.size))
        trial = problem.refine(trial, below=needed)
        return trial if trial.misfit < needed else None

    def _are_same_kind(self, one: ScanItem, other: ScanItem) -> bool:
        """Whether two items are instances of one effect with one scanned parameter."""
        a, b = (self.separable.groups[i.g].model.effects[0] for i in (one, other))
        return a.columns is b.columns and one.g != other.g and len(self.tables.grid(one).names) == 1

    def _explained_shares(self, state: SeparableSolution) -> Callable[[ScanItem, ScanItem], float]:
        """Function that returns which share of each other's rows two items explain, all others projected out."""
        rows = np.where(state.excluded[:, None], 0.0, state.rows)
        gram = rows @ rows.T
        size = np.sqrt(np.maximum(gram.diagonal(), 1e-300))
        inverse = np.linalg.inv(gram / size / size[:, None] + 1e-9 * np.eye(len(size)))

        def share(one: ScanItem, other: ScanItem) -> float:
            a, b = self.item_coefficients[one], self.item_coefficients[other]
            across = inverse[np.ix_(a, b)]
            ahead = np.linalg.solve(inverse[np.ix_(a, a)], across)
            return float(np.trace(ahead @ np.linalg.solve(inverse[np.ix_(b, b)], across.T)))

        return share

    def _slot_positions(self, item: ScanItem, names: tuple[str, ...]) -> list[int]:
        """Positions in the layout of the scanned parameters of an item."""
        found = (self.separable.position(item.effect, name, item.run) for name in names)
        return [i for i in found if i is not None]

    @staticmethod
    def _nearest_point(grid: ScanGrid, state: SeparableSolution, positions: list[int]) -> int:
        """Grid point nearest to the current values."""
        axis_range = np.ptp(grid.values, axis=0)
        distance = (grid.values - state.nonlinear_values[positions]) / np.where(axis_range > 0, axis_range, 1.0)
        return int(np.argmin(np.sum(distance**2, axis=1)))

    def _is_current_position(self, item: ScanItem, state: SeparableSolution, found: TableScan, g: int) -> bool:
        """Whether the item is within one grid step of this point already."""
        nearest = self._nearest_point(found.grid, state, self._slot_positions(item, found.grid.names))
        return bool(np.all(np.abs(found.grid.steps[nearest] - found.grid.steps[g]) <= 1))


def _are_in_different_runs(one: ScanItem, other: ScanItem) -> bool:
    """Whether two items are events of different runs, which can only disturb each other through common parameters."""
    return one.run is not None and other.run is not None and one.run != other.run
