"""The default search: scan in closed form, refine off the grid, exchange one effect after the other until none helps.

Whatever is not scanned stands from the start. Then, again and again, every form of every effect that is still out is
tried beside the law at once, the best is taken in and all numbers are refined together before the next: a weak line
hides in the leakage of a strong one that stands on the grid. At the end every effect in turn is taken out and its
scan, beside all the others, says where else it may stand; each such place is refined and kept if the misfit falls.
"""

from __future__ import annotations

import numpy as np

from frictrack.fit.along.columns import Along
from frictrack.fit.along.newton import Projected, State
from frictrack.fit.along.table import Item, Scan, Tables, coefficients_of, items_of, scan
from frictrack.records import Array

PICKS = 3  # places of one scan that are tried
ROUGH = 3  # steps while the law is incomplete
SLACK = 0.1  # of what an effect explains: how far behind a place may look before it is refined
NOISE = 12.0  # the same in units of the noise
GAIN = 1e-6  # of the misfit that a trial must gain to be kept


class Search:
    """Variable projection along the measured motion. Reused for many data sets, it keeps its tables."""

    def __init__(self, along: Along, tau: float = 0.03) -> None:
        self.along, self.tau = along, tau
        self.tables = Tables(along)
        self.items = items_of(along)
        self.mine = {item: coefficients_of(along, item) for item in self.items}
        self.plain = {g for g, group in enumerate(along.groups) if g not in {i.g for i in self.items}}

    def __call__(self, data: Array | None = None, numbers: Array | None = None) -> State:
        """The law that explains data (M,), default the blocks' own, best; `numbers` (P,) of what no scan finds."""
        problem = Projected(self.along, self.along.data if data is None else data, self.tau)
        first = self.first() if numbers is None else numbers
        state = problem.at(first, np.zeros((len(self.along.coefficients), self.along.size)), self.plain)
        state = self._complete(problem, state)
        return self._exchanged(problem, state)

    def first(self) -> Array:
        """Numbers (P,) before anything is known: levels one, the rest inside their bounds."""
        low, high = self.along.layout.bounds
        out = np.ones(len(low))
        for i, s in enumerate(self.along.layout.slots):
            if not s.linear and np.isfinite(low[i]) and np.isfinite(high[i]) and not low[i] <= 1.0 <= high[i]:
                out[i] = 0.5 * (low[i] + high[i])
        return out

    def _complete(self, problem: Projected, state: State) -> State:
        """Take in one effect after the other, the one that gains most first."""
        left = list(self.items)
        while left:
            kinds = {self.along.groups[i.g].model.effects[0].columns: i for i in reversed(left)}
            scans = {i: self._scanned(i, state) for i in kinds.values()}
            item = max(scans, key=lambda i: float(scans[i].gains.max()))
            left.remove(item)
            state = self._taken(problem, state, item, scans[item], int(np.argmax(scans[item].gains)))
            state = problem.refine(state, self._inside(left), ROUGH, 1e-3)
        return state

    def _inside(self, left: list[Item]) -> set[int]:
        return set(range(len(self.along.groups))) - {i.g for i in left}

    def _scanned(self, item: Item, state: State) -> Scan:
        mine = self.mine[item]
        low, high = self.along.low[mine], self.along.high[mine]
        return scan(self.tables.table(item, state), state, self.along.slices, low, high)

    def _taken(self, problem: Projected, state: State, item: Item, found: Scan, g: int) -> State:
        """The law with an item at one point of its scan."""
        numbers = state.numbers.copy()
        for name, value in zip(found.grid.names, found.grid.values[g], strict=True):
            for i, s in enumerate(self.along.layout.slots):
                if (s.effect, s.parameter) == (item.effect, name) and (item.run is None or s.run in (None, item.run)):
                    numbers[i] = value
        return problem.at(numbers, state.rows, {item.g})

    def _exchanged(self, problem: Projected, state: State) -> State:
        """Try other places for every effect until none helps."""
        everything = set(range(len(self.along.groups)))
        state = problem.refine(state, everything)
        waiting = list(self.items)
        while waiting:
            item = waiting.pop(0)
            better = self._elsewhere(problem, state, item)
            if better is not None:
                state = better
                waiting = [i for i in self.items if i != item]
        return state

    def _elsewhere(self, problem: Projected, state: State, item: Item) -> State | None:
        rows = state.rows.copy()
        rows[self.mine[item]] = 0.0
        bare = problem.state(state.numbers, rows)
        found = self._scanned(item, bare)
        noise = state.misfit / self.along.size
        near = state.misfit + SLACK * (bare.misfit - state.misfit) + NOISE * noise
        for g in found.picks(PICKS):
            if bare.misfit - found.gains[g] > near or self._stands(item, state, found, g):
                continue
            trial = self._taken(problem, bare, item, found, g)
            trial = problem.refine(trial, set(range(len(self.along.groups))))
            if trial.misfit < state.misfit * (1 - GAIN):
                return trial
        return None

    def _stands(self, item: Item, state: State, found: Scan, g: int) -> bool:
        """Whether the law has the item at that place already, within a step of its scan."""
        where = [self.along.position(item.effect, name, item.run or 0) for name in found.grid.names]
        own = np.array([state.numbers[i] for i in where])
        nearest = np.argmin(np.sum(((found.grid.values - own) / np.ptp(found.grid.values, axis=0)) ** 2, axis=1))
        return bool(np.all(np.abs(found.grid.steps[nearest] - found.grid.steps[g]) <= 1))
