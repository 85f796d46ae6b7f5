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

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import permutations

import numpy as np

from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.projected import ProjectedProblem, SeparableSolution
from frictrack.fit.separable.scan import ScanGains, ScanItem, ScanTable, SolutionScan, scan_items
from frictrack.records import Array

MAX_PLACES = 3  # grid points of one scan that are refined
ROUGH_STEPS = 3  # steps while effects are still missing
MAX_LAG_SHARE = 0.1  # share of an effect's gain by which a grid point may be behind and still be refined
MAX_LAG_CHI2 = 12.0  # the same in units of chi-squared per frame
MAX_PAIR_GAIN_RATIO = 3.0  # times the gain of one more line: the most that a line may be worth which leaves for a pair
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
        start = problem.refine(without_effect, self._groups_without(items), steps=ROUGH_STEPS)
        return self.exchange_positions(problem, self._add_items(problem, start, items), effect)

    def misses_effect(self, problem: ProjectedProblem, state: SeparableSolution) -> bool:
        """Whether one more effect of any kind would gain far more than by chance, so that a position must be wrong."""
        gains = (self._one_more(problem, state, i).largest for i in self.items)
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

    def _one_more(self, problem: ProjectedProblem, state: SeparableSolution, item: ScanItem) -> ScanGains:
        """The gain of every grid point of one more effect like an item."""
        scans, table = self._scan(problem, state, item)
        return scans.one_more(item, table)

    def _moved(self, problem: ProjectedProblem, state: SeparableSolution, item: ScanItem) -> ScanGains:
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
            scans = {i: self._one_more(problem, state, i) for i in {i.kind: i for i in reversed(remaining)}.values()}
            best = max(scans, key=lambda i: scans[i].largest)
            chosen = {i.run: i for i in sorted(scans, key=lambda i: scans[i].largest) if i.effect is best.effect}
            added = {i: scans[i].summit(scans[i].best) for i in chosen.values()}
            remaining = [i for i in remaining if i not in added]
            state = self._with_items_at(problem, state, added)
            if remaining:
                state = problem.refine(state, self._groups_without(remaining), steps=ROUGH_STEPS, enough=1e-3)
        return problem.refine(state)

    def _groups_without(self, remaining: Sequence[ScanItem]) -> set[int]:
        """Groups without those of the remaining items."""
        return set(range(len(self.separable.groups))) - {i.g for i in remaining}

    def _with_items_at(
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
            found = self._moved(problem, state, item)
            for g in found.peaks(-self._max_lag(state, found.loss))[:MAX_PLACES].tolist():
                if not item.is_at(state.nonlinear_values, g):
                    places.append((float(found.gains[g]), item, found.summit(g)))
        for _, item, values in sorted(places, key=lambda place: -place[0]):
            yield self._with_items_at(problem, state, {item: values})

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
        loss = {i: self._moved(problem, state, i).loss for i in items}
        for one, other in permutations(items, 2):
            gain = self._one_more(problem, state, one).largest
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
        return self._with_items_at(problem, state, {one: axis[[g - 1]], other: axis[[g]]})

    def _with_both_again(
        self, problem: ProjectedProblem, state: SeparableSolution, one: ScanItem, other: ScanItem
    ) -> SeparableSolution:
        """Both items removed, then `one` and after it `other` at their best positions."""
        state = problem.without(state, np.concatenate([one.coefficients, other.coefficients]))
        for item in (one, other):
            found = self._one_more(problem, state, item)
            state = self._with_items_at(problem, state, {item: found.summit(found.best)})
        return state
