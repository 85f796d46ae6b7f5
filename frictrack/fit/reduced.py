"""A start for models without a level to start from, such as ATM2: search the non-linear numbers, solve the rest.

Along the measured motion the coefficients follow by least squares (variable projection), so only frequencies, phases
and speeds are searched: differential evolution first, then, until nothing helps, one number after the other over its
whole scan (a frequency together with its phase), and like pairs in every order, each trial followed downhill.
The run of most frames is solved first; the phases of the others follow from its law. Refinement goes on from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.fit.along import Projected
from frictrack.fit.along.misfit import Reduced
from frictrack.fit.force import chains_of
from frictrack.fit.papers import bounds_of, misfit_of
from frictrack.fit.problem import Problem
from frictrack.fit.solve import Solution, refine, settle_scatter
from frictrack.models import Model
from frictrack.records import Array, Run
from frictrack.search import minimise

STARTS = 6  # searches, each followed by sweeps; the first that explains the run ends it
BUDGET = 5000  # evaluations of each search
EXPLAINED = 1.3  # chi-squared per frame of the re-simulated motion: a law that good is the one
ENOUGH = 1.12  # the same along the measured motion of a force series
NEAR = 5.0  # misfit over noise along the measured motion, beyond which it need not be re-simulated
PHASES = 8  # tried round the circle
TRIALS = 3  # best places of a scan that are followed downhill
GAIN = 0.98  # of the misfit: a sweep that leaves more was the last


def starts_alone(model: Model) -> bool:
    """Whether something in the model is linear without a scan: a level from which scans can go on."""
    return any(all(p.fixed is not None for p in e.nonlinear) for e in model.effects)


def solve_reduced(problem: Problem, runs: Sequence[Run], rng: np.random.Generator) -> Solution:
    """Fit a model from scratch by the reduced search and refinement."""
    count = [sum(len(p.t) for p in problem.pieces if p.run == r) for r in range(len(runs))]
    order = np.argsort(count)[::-1]
    p = np.ones(len(problem.layout.slots))
    for i, run in enumerate(map(int, order)):
        mine = Problem(problem.model, problem.layout, [q for q in problem.pieces if q.run == run])
        misfit = misfit_of(mine, chains_of(runs, mine.pieces), "nonlinear")
        assert isinstance(misfit, Reduced)
        reduced = _Reduced(misfit)
        p = _first_law(mine, reduced, rng) if i == 0 else reduced.phased(rng, p)
    return settle_scatter(problem, p, problem.first_starts())


def _first_law(problem: Problem, reduced: _Reduced, rng: np.random.Generator) -> Array:
    """All unknowns (P,) of the best law of one run; those of other runs are one."""
    best, least = np.ones(len(problem.layout.slots)), np.inf
    for _ in range(STARTS):
        p, misfit = reduced.law(rng)
        if misfit < least:
            best, least = p, misfit
        if misfit < NEAR * reduced.frames and _explains(problem, p):
            return p
    return best


def _explains(problem: Problem, p: Array) -> bool:
    try:
        return refine(problem, p, problem.first_starts()).chi2 < EXPLAINED * problem.n_frames
    except FrictrackError:  # its motion cannot be integrated
        return False


def law_along(misfit: Reduced, rng: np.random.Generator) -> tuple[Array, float]:
    """All unknowns (P,) of the best law along the measured motion, and its misfit in units of the noise."""
    reduced = _Reduced(misfit)
    found = []
    for _ in range(STARTS):
        found.append(reduced.law(rng))
        if found[-1][1] < ENOUGH * reduced.frames:
            break
    return min(found, key=lambda law: law[1])


class _Reduced:
    """Misfit of one run over its non-linear unknowns (P, d), the coefficients solved."""

    def __init__(self, misfit: Reduced) -> None:
        self.misfit = misfit
        layout = misfit.layout
        effects = {e.name: e for e in layout.model.effects}
        slots = [layout.slots[i] for i in misfit.searched]
        known = [effects[s.effect].parameter(s.parameter) for s in slots]
        self.phases = [k for k, q in enumerate(known) if q.role == "phase"]
        highest = max(b.highest for b in misfit.blocks)
        self.scans = {}
        for k, q in enumerate(known):
            if q.scan is not None:
                grid = q.scan(layout.span)
                self.scans[k] = grid[grid < highest] if q.unit == "Hz" and np.any(grid < highest) else grid
        self.box = bounds_of(misfit)
        self.frames = misfit.along.size
        self.problem = Projected(misfit.along, misfit.along.data)

    def __call__(self, points: Array) -> Array:
        """Misfits (P,)."""
        return self.misfit(points) / self.misfit.unit

    def law(self, rng: np.random.Generator) -> tuple[Array, float]:
        """All unknowns (P,) of the law that one search and its sweeps find, and its misfit; of other runs: one."""
        found = minimise(self, self.box, method="de", rng=rng, max_evaluations=BUDGET)
        point, misfit = self._swept(found.x)
        return self.misfit.law(point[None])[0], misfit

    def phased(self, rng: np.random.Generator, known: Array) -> Array:
        """The law `known` (P,) with the phases of this run, and its other own numbers."""
        slots = self.misfit.searched
        own = [k for k, i in enumerate(slots) if self.misfit.layout.slots[i].run is not None]
        point = known[slots]
        if not own:
            return known

        def cost(points: Array) -> Array:
            whole = np.tile(point, (len(points), 1))
            whole[:, own] = points
            return self(whole)

        found = minimise(cost, self.box[own], method="de", rng=rng, max_evaluations=BUDGET)
        out = known.copy()
        out[[slots[k] for k in own]] = found.x
        return out

    def _swept(self, point: Array) -> tuple[Array, float]:
        """Sweep after sweep over all scans and orders, until one gains little."""
        state = self._downhill(point)
        while True:
            before = state[1]
            for k in self.scans:
                state = self._best(state, self._scanned(state[0], k))
            state = self._best(state, self._exchanged(state[0]))
            if state[1] > GAIN * before:
                return state

    def _best(self, state: tuple[Array, float], points: list[Array]) -> tuple[Array, float]:
        return min([state, *map(self._downhill, points)], key=lambda s: s[1])

    def _scanned(self, point: Array, k: int) -> list[Array]:
        """The best places of one number over its scan, a phase that follows it going round the circle."""
        grid = self.scans[k]
        turns = PHASES if k + 1 in self.phases else 1
        points = np.tile(point, (len(grid) * turns, 1))
        points[:, k] = np.repeat(grid, turns)
        if turns > 1:
            points[:, k + 1] = np.tile(np.arange(turns) * 2 * np.pi / turns - np.pi, len(grid))
        apart = 2 * float(np.min(np.diff(np.sort(grid)))) if len(grid) > 1 else 0.0
        chosen: list[Array] = []
        for i in np.argsort(self(points)):
            if all(abs(points[i, k] - q[k]) > apart for q in chosen):
                chosen.append(points[i])
            if len(chosen) == TRIALS:
                break
        return chosen

    def _exchanged(self, point: Array) -> list[Array]:
        """Pairs of a frequency and its phase in every order that makes another law."""
        pairs = [k for k in self.scans if k + 1 in self.phases]
        orders = np.array(list(permutations(pairs)), dtype=int).reshape(-1, len(pairs))
        moved = np.tile(point, (len(orders), 1))
        for place, source in zip(pairs, orders.T, strict=True):
            moved[:, place], moved[:, place + 1] = point[source], point[source + 1]
        misfits = self(moved)
        _, first = np.unique(np.round(misfits / misfits[0], 6), return_index=True)  # two sines of one sum: the same
        return [moved[i] for i in first if i > 0]

    def _downhill(self, point: Array) -> tuple[Array, float]:
        """The nearest minimum within the box, and its misfit."""
        numbers = np.ones(len(self.misfit.layout.slots))
        numbers[self.misfit.searched] = point
        state = self.problem.refine(self.problem.at(numbers), steps=40)
        return state.numbers[self.misfit.searched], state.misfit + sum(b.rest for b in self.misfit.blocks)
