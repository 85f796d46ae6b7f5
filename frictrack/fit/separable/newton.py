"""Gauss-Newton on the projected problem: the coefficients follow from the non-linear numbers by bounded least squares.

Golub & Pereyra 1973 with Kaufman's (1975) Jacobian, in the Gram matrix of the law's rows: one small matrix holds all
that a step needs. Levels of friction are non-linear numbers here, held about one.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import count

import numpy as np
from scipy.optimize import lsq_linear

from frictrack.fit.parameters import LEVEL, penalty_jacobian
from frictrack.fit.separable.model import NO_INDICES, Indices, SeparableModel
from frictrack.records import Array, Mask

RELATIVE_STEP = 1e-6  # of a number, or of a thousandth of its box, for derivatives of columns
RIDGE = 1e-12  # of the columns' mean square, where two of them are alike
FIRST_DAMPING, MAX_DAMPING, MIN_DAMPING = 1e-6, 1e6, 1e-10
MAX_PROMISE_FACTOR = 3.0  # times what a step promises: the most that a law is trusted to fall yet

Change = tuple[int, int, Array]  # group, block, change of its rows (columns, m) per unit of a number


@dataclass(frozen=True, eq=False)
class LevelSlopes:
    """How a law answers the levels of R runs: rows (R, M) per unit of each, and what else is known of them.

    `held` (R, R) is the precision with which they are held, `pull` (R,) half the slope of the misfit downwards.
    """

    rows: Array
    held: Array
    pull: Array


@dataclass(frozen=True, eq=False)
class SeparableSolution:
    """One law: numbers (P_layout,), rows (K, M), coefficients (K,), which of these may move, and the misfit.

    `misfit` is the sum of squared residuals and of what holds the levels about one. Rows that are `out` take no part.
    `changes` tells how rows answer each number; `stamps` tells rows of different evaluations apart, group by group.
    `levels` tells how the law answers the levels of its runs.
    """

    nonlinear_values: Array
    rows: Array
    coefficients: Array
    moving: Mask
    residual: Array  # (M,)
    misfit: float
    out: Mask
    stamps: tuple[int, ...]
    levels: LevelSlopes
    changes: dict[int, list[Change]] = field(default_factory=dict)


def bounded_coefficients(gram: Array, right: Array, low: Array, high: Array) -> tuple[Array, Mask]:
    """Minimise c' G c - 2 c' u within bounds: coefficients (K,), and which of them stand at no bound."""
    size = np.sqrt(gram.diagonal())
    dead = size == 0
    size[dead] = 1.0
    unit = gram / size / size[:, None]
    unit.flat[:: len(size) + 1] += RIDGE + dead
    fixed = low == high
    c = np.where(fixed, low, 0.0)
    if not fixed.any():
        c = np.linalg.solve(unit, right / size) / size
    if fixed.any() or (c < low).any() or (c > high).any():
        free = ~fixed
        root = np.linalg.cholesky(unit[np.ix_(free, free)]).T
        target = np.linalg.solve(root.T, (right[free] - gram[np.ix_(free, fixed)] @ low[fixed]) / size[free])
        box = low[free] * size[free], high[free] * size[free]
        c[free] = np.clip(lsq_linear(root, target, box, method="bvls").x / size[free], low[free], high[free])
    return c, (c > low) & (c < high) & ~dead


class ProjectedProblem:
    """The projected problem of one data set (M,): laws and their refinement. `tau` is the spread of the levels."""

    _stamps = count(1)

    def __init__(self, separable: SeparableModel, data: Array, tau: float = 0.03) -> None:
        self.separable, self.data, self.tau = separable, data, tau
        self.layout = separable.layout
        self.levels = self.layout.levels
        self.low, self.high = self.layout.bounds
        effects = {e.name: e for e in self.layout.model.effects}
        turning = [
            s.effect != LEVEL and effects[s.effect].parameter(s.parameter).role == "phase" for s in self.layout.slots
        ]
        self.low[turning], self.high[turning] = -np.inf, np.inf  # a phase goes round
        self._held, self._aim = self._known(tau)
        width = self.high - self.low
        self._least = RELATIVE_STEP * np.where(np.isfinite(width), 1e-3 * width, 1.0)
        self._loaded = np.array([c.loaded for c in separable.coefficients], dtype=bool)
        self._firm = self._held[:, self.levels].T @ self._held[:, self.levels]

    def _known(self, tau: float) -> tuple[Array, Array]:
        """What is known beside the data: rows (m, P) of the numbers and what they aim at, (m,), in deviations.

        Priors of coefficients are left to the refinement.
        """
        levels = np.zeros(len(self.low))
        levels[self.levels] = 1.0
        rows = penalty_jacobian(self.layout, tau)
        rows = rows[: len(rows) - len(self.layout.priors)]
        plain = [q for q in self.layout.priors if q.slot in self.separable.free]
        more = np.zeros((len(plain), len(levels)))
        for row, q in zip(more, plain, strict=True):
            row[q.slot] = 1 / q.std
        return np.vstack([rows, more]), np.concatenate([rows @ levels, [q.mean / q.std for q in plain]])

    def empty_solution(self, nonlinear_values: Array) -> SeparableSolution:
        """No law at all: rows of zeros."""
        k = len(self.separable.coefficients)
        zero = np.zeros((k, self.separable.size))
        none = np.zeros(k, dtype=bool)
        still = LevelSlopes(np.zeros((len(self.levels), self.separable.size)), self._firm, np.zeros(len(self.levels)))
        stamps = (0,) * len(self.separable.groups)
        return SeparableSolution(nonlinear_values, zero, np.zeros(k), none, self.data, np.inf, ~none, stamps, still)

    def without(self, state: SeparableSolution, coefficients: Indices) -> SeparableSolution:
        """The same law with some of its rows gone, the others' coefficients solved again."""
        out = state.out.copy()
        out[coefficients] = True
        return self._solved(state.nonlinear_values, state.rows, out, (state.stamps, state.changes))

    def at(
        self,
        nonlinear_values: Array,
        known: SeparableSolution | None = None,
        groups: Iterable[int] | None = None,
        taken: Indices | None = None,
    ) -> SeparableSolution:
        """The law of given numbers (P_layout,); rows of groups other than `groups` are taken from `known`.

        `taken` (default all of these groups) are the coefficients that take part from now on, if they did not before.
        """
        base = known or self.empty_solution(nonlinear_values)
        rows, out = base.rows.copy(), base.out.copy()
        changes, stamps = dict(base.changes), list(base.stamps)
        if self.levels:
            self._relevel(base.nonlinear_values, nonlinear_values, rows, (changes, stamps))
        for g in range(len(self.separable.groups)) if groups is None else groups:
            self._evaluate(g, nonlinear_values, rows, changes)
            stamps[g] = next(self._stamps)
            out[self.separable.coefficients_of(g) if taken is None else taken] = False
        return self._solved(nonlinear_values, rows, out, (tuple(stamps), changes))

    def _relevel(self, old: Array, new: Array, rows: Array, kept: tuple[dict[int, list[Change]], list[int]]) -> None:
        """Carry what follows the friction levels along with them: rows, changes, and stamps of the groups touched."""
        separable, (changes, stamps) = self.separable, kept
        factor = new[self.levels] / old[self.levels]
        if np.all(factor == 1.0):
            return
        for block, cut in zip(separable.blocks, separable.slices, strict=True):
            rows[self._loaded, cut] *= factor[block.run]
        for i, own in changes.items():
            changes[i] = [(g, b, change * self._follows(g, b, factor)) for g, b, change in own]
        for g in range(len(separable.groups)):
            if self._loaded[separable.coefficients_of(g)].any():
                stamps[g] = next(self._stamps)

    def _follows(self, g: int, b: int, factor: Array) -> Array:
        """By how much the columns of a group change with the levels of the runs, (columns, 1)."""
        run = self.separable.blocks[b].run
        at = self.separable.place[g][run]
        return np.where((at >= 0) & self._loaded[at], factor[run], 1.0)[:, None]

    def _evaluate(self, g: int, nonlinear_values: Array, rows: Array, changes: dict[int, list[Change]]) -> None:
        """Rows of one group and how they answer its numbers, all from one evaluation."""
        separable, group = self.separable, self.separable.groups[g]
        for i in group.nonlinear_slots:
            changes[i] = [c for c in changes.get(i, []) if c[0] != g]
        for b, block in enumerate(separable.blocks):
            mine = [i for i in group.nonlinear_slots if separable.layout.slots[i].run in (None, block.run)]
            moved = np.tile(nonlinear_values, (1 + len(mine), 1))
            steps = np.maximum(RELATIVE_STEP * np.abs(nonlinear_values[mine]), self._least[mine])
            moved[np.arange(1, len(moved)), mine] += steps
            level = float(nonlinear_values[self.levels[block.run]]) if self.levels else 1.0
            made = separable.rows(g, b, moved, level)
            at = separable.place[g][block.run]
            kept = at >= 0
            rows[at[kept], separable.slices[b]] = made[0, kept]
            for j, i in enumerate(mine):
                changes[i].append((g, b, (made[1 + j] - made[0]) / steps[j]))

    def _solved(
        self, nonlinear_values: Array, rows: Array, out: Mask, kept: tuple[tuple[int, ...], dict[int, list[Change]]]
    ) -> SeparableSolution:
        gram, right = rows @ rows.T, rows @ self.data
        if out.any():
            gram[out], gram[:, out], right[out] = 0.0, 0.0, 0.0
        c, moving = bounded_coefficients(gram, right, self.separable.low, self.separable.high)
        residual = self.data - c @ rows
        misfit = float(residual @ residual)
        away = self._held @ nonlinear_values - self._aim
        misfit += float(away @ away)
        levels = self._levels(nonlinear_values, rows, c, (residual, away))
        return SeparableSolution(nonlinear_values, rows, c, moving, residual, misfit, out, kept[0], levels, kept[1])

    def _levels(self, nonlinear_values: Array, rows: Array, c: Array, left: tuple[Array, Array]) -> LevelSlopes:
        """How a law answers its levels; `left` is its residual, and how far its numbers are from what is known."""
        separable, slope = self.separable, np.zeros((len(self.levels), self.separable.size))
        residual, away = left
        if self.levels:
            dry = c[self._loaded] @ rows[self._loaded]
            for block, cut in zip(separable.blocks, separable.slices, strict=True):
                slope[block.run, cut] = dry[cut] / nonlinear_values[self.levels[block.run]]
        return LevelSlopes(slope, self._firm, slope @ residual - self._held[:, self.levels].T @ away)

    def refine(
        self,
        state: SeparableSolution,
        groups: Iterable[int] | None = None,
        *,
        steps: int = 12,
        enough: float = 1e-5,
        below: float = np.inf,
    ) -> SeparableSolution:
        """Levenberg-Marquardt over the numbers of some groups (default all) and the levels.

        Ends when a step promises less than a share `enough` of the misfit, or no hope is left to come below `below`.
        """
        chosen = sorted(set(range(len(self.separable.groups)) if groups is None else groups))
        free = sorted({i for g in chosen for i in self.separable.groups[g].nonlinear_slots}) + self.levels
        touched = [g for g in chosen if self.separable.groups[g].nonlinear_slots]
        damping = FIRST_DAMPING
        linear = self._linearised(state, free) if free else None
        for _ in range(steps if free else 0):
            assert linear is not None
            step, promised = self._step(state, linear, free, damping)
            hopeless = state.misfit - MAX_PROMISE_FACTOR * promised > below
            if promised < enough * state.misfit or damping > MAX_DAMPING or hopeless:
                break
            nonlinear_values = state.nonlinear_values.copy()
            nonlinear_values[free] += step
            trial = self.at(nonlinear_values, state, touched, NO_INDICES)
            if trial.misfit < state.misfit:
                state, linear, damping = trial, self._linearised(trial, free), max(0.1 * damping, MIN_DAMPING)
            else:
                damping = max(30 * damping, 1e-3)
        return state

    def _linearised(self, state: SeparableSolution, free: list[int]) -> tuple[Array, Array]:
        """Normal matrix (d, d) and gradient (d,) of the free numbers beside the coefficients."""
        slope = np.zeros((len(free), self.separable.size))
        slope[[i in self.levels for i in free]] = state.levels.rows
        for row, i in zip(slope, free, strict=True):
            for g, b, change in state.changes.get(i, []):
                at = self.separable.place[g][self.separable.blocks[b].run]
                row[self.separable.slices[b]] += np.where(at >= 0, state.coefficients[at], 0.0) @ change
        rows = state.rows[state.moving]
        normal, gradient = slope @ slope.T, slope @ state.residual
        if len(rows):
            gram, beside = rows @ rows.T, rows @ slope.T
            size = np.sqrt(gram.diagonal())
            unit = gram / size / size[:, None]
            unit.flat[:: len(size) + 1] += RIDGE
            beside /= size[:, None]
            normal -= beside.T @ np.linalg.solve(unit, beside)
        if len(self._aim):
            held = self._held[:, free]
            normal += held.T @ held
            gradient = gradient - held.T @ (self._held @ state.nonlinear_values - self._aim)
        return normal, gradient

    def _step(
        self, state: SeparableSolution, linear: tuple[Array, Array], free: list[int], damping: float
    ) -> tuple[Array, float]:
        """Damped step (d,) of the free numbers within their box, and the fall of the misfit that it promises."""
        normal, gradient = linear
        own = normal.diagonal()
        low, high = self.low[free] - state.nonlinear_values[free], self.high[free] - state.nonlinear_values[free]
        shut = ((low >= 0) & (gradient <= 0)) | ((high <= 0) & (gradient >= 0)) | (own <= 0)
        size = np.sqrt(np.where(own > 0, own, 1.0))
        unit = normal / size / size[:, None]
        unit.flat[:: len(size) + 1] += damping + RIDGE
        step = np.clip(0.0, low, high)
        while not shut.all():  # what would leave its box first goes to its side, and the others make the best of it
            go = ~shut
            aim = gradient[go] / size[go] - unit[np.ix_(go, shut)] @ (step[shut] * size[shut])
            step[go] = np.linalg.solve(unit[np.ix_(go, go)], aim) / size[go]
            beyond = go & ((step < low) | (step > high))
            if not beyond.any():
                break
            side = np.where(step < low, low, high)
            first = int(np.argmin(np.where(beyond, side / np.where(beyond, step, 1.0), np.inf)))
            step[first], shut[first] = side[first], True
        return step, float(2 * gradient @ step - step @ normal @ step)
