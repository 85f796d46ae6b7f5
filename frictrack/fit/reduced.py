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
from scipy.optimize import least_squares

from frictrack.errors import FrictrackError
from frictrack.fit.crowd import Misfit
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
NEAR = 5.0  # misfit over noise along the measured motion, beyond which it need not be re-simulated
PHASES = 8  # tried round the circle
TRIALS = 3  # best places of a scan that are followed downhill
GAIN = 0.98  # of the misfit: a sweep that leaves more was the last
CROWD = 80  # laws evaluated at once
RIDGE = 1e-9  # of the columns' mean square, where two of them are alike


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
        reduced = _Reduced(misfit_of(mine, chains_of(runs, mine.pieces)))
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


class _Reduced:
    """Misfit of one run over its non-linear unknowns (P, d), the coefficients solved."""

    def __init__(self, misfit: Misfit) -> None:
        self.misfit = misfit
        layout = misfit.layout
        effects = {e.name: e for e in layout.model.effects}
        slots = [layout.slots[i] for i in misfit.searched]
        self.linear = [j for j, s in enumerate(slots) if s.linear]
        self.free = [j for j, s in enumerate(slots) if not s.linear]
        known = [effects[slots[j].effect].parameter(slots[j].parameter) for j in self.free]
        self.phases = [k for k, q in enumerate(known) if q.role == "phase"]
        highest = max(b.highest for b in misfit.balances)
        self.scans = {}
        for k, q in enumerate(known):
            if q.scan is not None:
                grid = q.scan(layout.span)
                self.scans[k] = grid[grid < highest] if q.unit == "Hz" and np.any(grid < highest) else grid
        self.box = bounds_of(misfit)[self.free]
        self.frames = sum(len(b.base) for b in misfit.balances)

    def __call__(self, points: Array) -> Array:
        """Misfits (P,)."""
        crowds = np.array_split(points, max(1, -(-len(points) // CROWD)))
        return np.concatenate([np.sum(self.residuals(q) ** 2, axis=1) for q in crowds])

    def residuals(self, points: Array) -> Array:
        """Residuals (P, M), the coefficients solved."""
        columns, base, _ = self._columns(points)
        out: Array = base + np.einsum("pmk,pk->pm", columns, _solved(columns, base))
        return out

    def _columns(self, points: Array) -> tuple[Array, Array, Array]:
        """Change of the residual per unit of every coefficient (P, M, K), the residual without them (M,), and points.

        The points (P, D) hold all searched unknowns, the coefficients at zero.
        """
        whole = np.zeros((len(points), len(self.misfit.searched)))
        whole[:, self.free] = points
        made, base = [], []
        for b in self.misfit.balances:
            path, values = self.misfit.end_to_end(b, whole)
            force = np.concatenate(list(self.misfit.layout.model.force_columns(path, values).values()), axis=1)
            each = force.reshape(len(points), -1, force.shape[1]).transpose(2, 0, 1)
            made.append(np.stack([b.moved(column) for column in each], axis=2))
            base.append(b.base)
        return np.concatenate(made, axis=1), np.concatenate(base), whole

    def law(self, rng: np.random.Generator) -> tuple[Array, float]:
        """All unknowns (P,) of the law that one search and its sweeps find, and its misfit; of other runs: one."""
        found = minimise(self, self.box, method="de", rng=rng, max_evaluations=BUDGET)
        point, misfit = self._swept(found.x)
        columns, base, whole = self._columns(point[None])
        whole[0, self.linear] = _solved(columns, base)[0]
        p = np.ones(len(self.misfit.layout.slots))
        p[self.misfit.searched] = whole[0]
        return p, misfit

    def phased(self, rng: np.random.Generator, known: Array) -> Array:
        """The law `known` (P,) with the phases of this run, and its other own numbers."""
        slots = [self.misfit.searched[j] for j in self.free]
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
        low, width = self.box[:, 0], self.box[:, 1] - self.box[:, 0]
        step = 1e-6

        def residual(unit: Array) -> Array:
            return self.residuals((low + width * unit)[None])[0]

        def slope(unit: Array) -> Array:
            moved = self.residuals(low + width * np.vstack([unit, unit + step * np.eye(len(unit))]))
            return (moved[1:] - moved[0]).T / step

        start = np.clip((point - low) / width, step, 1 - step)
        found = least_squares(residual, start, slope, bounds=(0, 1), max_nfev=40, x_scale="jac")
        return low + width * found.x, 2 * float(found.cost)


def _solved(columns: Array, base: Array) -> Array:
    """Coefficients (P, K) that bring base (M,) plus columns (P, M, K) closest to zero."""
    gram = columns.transpose(0, 2, 1) @ columns
    size = np.maximum(np.sqrt(np.einsum("pkk->pk", gram)), 1e-30)
    unit = gram / size[:, :, None] / size[:, None, :] + RIDGE * np.eye(gram.shape[1])
    right = -np.einsum("pmk,m->pk", columns, base) / size
    out: Array = np.linalg.solve(unit, right[:, :, None])[:, :, 0] / size
    return out
