"""Fit by variable projection: scan effects in closed form, refine off the grid, exchange positions until none helps.

Effects without a scan are in the model from the start. Then every grid point of every missing effect is tried at
once, the best one is added, and all parameters are refined together before the next. A weak spectral line is
otherwise hidden in the leakage of a strong line that is still on the grid. At the end each effect in turn is removed
and scanned again with all others. Every promising position is refined, and kept if the misfit falls.

References
----------
Golub, G. H. & Pereyra, V. (1973). SIAM J. Numer. Anal. 10, 413-432.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from itertools import permutations
from typing import Any

import numpy as np

from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.newton import ProjectedProblem, SeparableSolution
from frictrack.fit.separable.scan_tables import ScanItem, ScanTables, coefficients_of, scanned_effects
from frictrack.fit.separable.table_scan import ScanGrid
from frictrack.records import Array

MAX_PLACES = 3  # grid points of one scan that are refined
MAX_PAIR_PLACES = 2  # pairs of neighbouring lines that are refined
ROUGH_STEPS = 3  # steps while effects are still missing
MAX_LAG_SHARE = 0.1  # share of an effect's gain by which a grid point may be behind and still be refined
MAX_LAG_CHI2 = 12.0  # the same in units of chi-squared per frame
MAX_PAIR_GAIN_RATIO = 3.0  # times the gain of one more line: the most that a line may be worth which leaves for a pair
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
        problem = self.problem(self.separable.data if data is None else data)
        return self._exchange_until_no_gain(problem, self.start_solution(problem, nonlinear_values))

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
        return self._unscanned(self._problem, self.start_values())

    def _unscanned(self, problem: ProjectedProblem, nonlinear_values: Array) -> SeparableSolution:
        """The solution without any scanned effect."""
        return problem.at(nonlinear_values, problem.empty_solution(nonlinear_values), self.unscanned_groups)

    def start_solution(self, problem: ProjectedProblem, nonlinear_values: Array | None = None) -> SeparableSolution:
        """Return the solution with every effect at the position that gained most when it was added, refined."""
        state = (
            problem.solved_again(self._start)
            if nonlinear_values is None
            else self._unscanned(problem, nonlinear_values)
        )
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
        problem = self._problem
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
        state = self._exchange_until_no_gain(problem, problem.refine(state))
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
        """Add the effects that gain most together, refine them, and go on until none is missing."""
        remaining = list(self.items)
        while remaining:
            added = self.tables.best_positions(remaining, state, problem.data)
            remaining = [i for i in remaining if i not in added]
            state = self._with_items_at(problem, state, added)
            if remaining:
                state = problem.refine(state, self._groups_without(remaining), steps=ROUGH_STEPS, enough=1e-3)
        return problem.refine(state)

    def _groups_without(self, remaining: list[ScanItem]) -> set[int]:
        """Groups without those of the remaining items."""
        return set(range(len(self.separable.groups))) - {i.g for i in remaining}

    def _with_items_at(
        self, problem: ProjectedProblem, state: SeparableSolution, values: Mapping[ScanItem, Array]
    ) -> SeparableSolution:
        """The solution with the scanned parameters of some items at some values (d,)."""
        nonlinear_values = state.nonlinear_values.copy()
        for item, own in values.items():
            for slots, value in zip(self.tables.slots(item), own, strict=True):
                nonlinear_values[slots] = value
        taking_part = np.concatenate([self.item_coefficients[item] for item in values])
        return problem.at(nonlinear_values, state, {item.g for item in values}, taking_part)

    def _exchange_until_no_gain(self, problem: ProjectedProblem, state: SeparableSolution) -> SeparableSolution:
        """Try other positions of every effect, then of pairs of effects, until none helps."""
        better: SeparableSolution | None = state
        while better is not None:
            state = better
            better = self._try_other_positions(problem, state) or self._try_pairs(problem, state)
        return state

    def _try_pairs(self, problem: ProjectedProblem, state: SeparableSolution) -> SeparableSolution | None:
        """A better solution with two effects elsewhere: two lines in place of one, or two that exchange places."""
        if len(self.items) < 2:
            return None
        shares, losses = self._shares_and_losses(state)
        gains = self._gains_of_one_more(problem, state)
        misses_effect = self._is_large(max(gains.values()), state)
        for (i, one), (j, other) in permutations(enumerate(self.items), 2):
            better = None
            pays = min(losses[i], losses[j]) < MAX_PAIR_GAIN_RATIO * gains[self._kind(one)]
            if i < j and pays and self._are_same_kind(one, other):
                better = self._try_neighbouring_lines(problem, state, one, other)
            may_exchange = misses_effect and not _are_in_different_runs(one, other)
            if better is None and (may_exchange or shares[i, j] > MIN_COUPLING):
                better = self._try_both_again(problem, state, one, other)
            if better is not None:
                return better
        return None

    def misses_effect(self, problem: ProjectedProblem, state: SeparableSolution) -> bool:
        """Whether one more effect of any kind would gain far more than by chance, so that a position must be wrong."""
        return self._is_large(max(self._gains_of_one_more(problem, state).values(), default=0.0), state)

    def _is_large(self, gain: float, state: SeparableSolution) -> bool:
        """Whether an effect gains far more than by chance."""
        return gain > LARGE_GAIN_CHI2 * state.misfit / self.separable.size

    def _gains_of_one_more(self, problem: ProjectedProblem, state: SeparableSolution) -> dict[tuple[Any, ...], float]:
        """The largest gain of one more effect of every kind."""
        kinds = {self._kind(i): i for i in reversed(self.items)}
        return {kind: self.tables.scan(i, state, problem.data).largest for kind, i in kinds.items()}

    def _kind(self, item: ScanItem) -> tuple[Any, ...]:
        """What items have in common that are instances of one effect in one run."""
        return self.separable.groups[item.g].model.effects[0].columns, item.run

    def _try_other_positions(self, problem: ProjectedProblem, state: SeparableSolution) -> SeparableSolution | None:
        """A better solution with one effect at another position, the most promising first; None if there is none."""
        places = [place for item in self.items for place in self._other_places(problem, state, item)]
        for _, item, values in sorted(places, key=lambda place: place[0]):
            better = self._refine_if_better(problem, state, self._with_items_at(problem, state, {item: values}))
            if better is not None:
                return better
        return None

    def _other_places(
        self, problem: ProjectedProblem, state: SeparableSolution, item: ScanItem
    ) -> Iterator[tuple[float, ScanItem, Array]]:
        """Other positions of an effect that are worth a refinement: misfit on the grid, effect and scanned values."""
        found = self.tables.moves(item, state, problem.data)
        without_item = state.misfit + found.loss
        for g in found.peaks(without_item - self._max_promising_misfit(state, without_item))[:MAX_PLACES]:
            if not self._is_current_position(item, state, found.grid, int(g)):
                yield without_item - float(found.gains[g]), item, found.summit(g)

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
        slots = self.tables.slots(one)[0], self.tables.slots(other)[0]
        values = self.tables.grid(one).values
        without_both = state.misfit + found.loss
        for g in found.peaks(without_both - self._max_promising_misfit(state, without_both))[:MAX_PAIR_PLACES]:
            nonlinear_values = state.nonlinear_values.copy()
            nonlinear_values[slots[0]], nonlinear_values[slots[1]] = values[g], values[g + 1]
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
        first = self.tables.scan(one, without_both, problem.data)
        with_one = self._with_items_at(problem, without_both, {one: first.summit(first.best)})
        without_item = problem.without(with_one, self.item_coefficients[other])
        second = self.tables.scan(other, without_item, problem.data)
        best_misfit = without_item.misfit - second.gains[second.best]
        if best_misfit > self._max_promising_misfit(state, without_both.misfit):
            return None
        trial = self._with_items_at(problem, with_one, {other: second.summit(second.best)})
        return self._refine_if_better(problem, state, trial)

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

    def _shares_and_losses(self, state: SeparableSolution) -> tuple[Array, Array]:
        """Which share of each other's rows two of N items explain, all others given, (N, N), and what each gains (N,).

        All of it stands in the inverse Gram matrix, whose blocks are the covariances of the items' coefficients.
        """
        size = np.sqrt(np.maximum(state.gram.diagonal(), 1e-300))
        covariance = np.linalg.inv(state.gram / size / size[:, None] + 1e-9 * np.eye(len(size)))
        c, parts, losses = state.coefficients * size, [], []
        for own in self.item_coefficients.values():
            precision = np.linalg.inv(covariance[np.ix_(own, own)])
            parts.append(precision @ covariance[own])
            losses.append(float(c[own] @ precision @ c[own]))
        coefficients = list(self.item_coefficients.values())
        shares = [
            [float(np.sum(a[:, theirs] * b[:, mine].T)) for b, theirs in zip(parts, coefficients, strict=True)]
            for a, mine in zip(parts, coefficients, strict=True)
        ]
        return np.array(shares), np.array(losses)

    def _is_current_position(self, item: ScanItem, state: SeparableSolution, grid: ScanGrid, g: int) -> bool:
        """Whether the item is within one grid step of this point already."""
        nearest = grid.nearest(state.nonlinear_values[[slots[0] for slots in self.tables.slots(item)]])
        return bool(np.all(np.abs(grid.steps[nearest] - grid.steps[g]) <= 1))


def _are_in_different_runs(one: ScanItem, other: ScanItem) -> bool:
    """Whether two items are events of different runs, which can only disturb each other through common parameters."""
    return one.run is not None and other.run is not None and one.run != other.run
