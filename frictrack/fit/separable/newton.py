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
    precision: Array
    gradient: Array


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
    unconstrained: Mask
    residual: Array  # (M,)
    misfit: float
    excluded: Mask
    versions: tuple[int, ...]
    levels: LevelSlopes
    row_derivatives: dict[int, list[Change]] = field(default_factory=dict)


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

    _versions = count(1)

    def __init__(self, separable: SeparableModel, data: Array, tau: float = 0.03) -> None:
        self.separable, self.data, self.tau = separable, data, tau
        self.layout = separable.layout
        self.levels = self.layout.levels
        self.low, self.high = self.layout.bounds
        effects = {e.name: e for e in self.layout.model.effects}
        is_phase = [
            s.effect != LEVEL and effects[s.effect].parameter(s.parameter).role == "phase" for s in self.layout.slots
        ]
        self.low[is_phase], self.high[is_phase] = -np.inf, np.inf  # a phase goes round
        self._prior_rows, self._prior_target = self._prior_equations(tau)
        width = self.high - self.low
        self._min_step = RELATIVE_STEP * np.where(np.isfinite(width), 1e-3 * width, 1.0)
        self._loaded = np.array([c.loaded for c in separable.coefficients], dtype=bool)
        self._level_precision = self._prior_rows[:, self.levels].T @ self._prior_rows[:, self.levels]

    def _prior_equations(self, tau: float) -> tuple[Array, Array]:
        """What is known beside the data: rows (m, P) of the numbers and what they aim at, (m,), in deviations.

        Priors of coefficients are left to the refinement.
        """
        levels = np.zeros(len(self.low))
        levels[self.levels] = 1.0
        rows = penalty_jacobian(self.layout, tau)
        rows = rows[: len(rows) - len(self.layout.priors)]
        priors = [q for q in self.layout.priors if q.slot in self.separable.free]
        prior_rows = np.zeros((len(priors), len(levels)))
        for row, q in zip(prior_rows, priors, strict=True):
            row[q.slot] = 1 / q.std
        return np.vstack([rows, prior_rows]), np.concatenate([rows @ levels, [q.mean / q.std for q in priors]])

    def empty_solution(self, nonlinear_values: Array) -> SeparableSolution:
        """No law at all: rows of zeros."""
        k = len(self.separable.coefficients)
        zero = np.zeros((k, self.separable.size))
        no_coefficient = np.zeros(k, dtype=bool)
        level_slopes = LevelSlopes(
            np.zeros((len(self.levels), self.separable.size)), self._level_precision, np.zeros(len(self.levels))
        )
        versions = (0,) * len(self.separable.groups)
        return SeparableSolution(
            nonlinear_values,
            zero,
            np.zeros(k),
            no_coefficient,
            self.data,
            np.inf,
            ~no_coefficient,
            versions,
            level_slopes,
        )

    def without(self, state: SeparableSolution, coefficients: Indices) -> SeparableSolution:
        """The same law with some of its rows gone, the others' coefficients solved again."""
        excluded = state.excluded.copy()
        excluded[coefficients] = True
        return self._solution_of(state.nonlinear_values, state.rows, excluded, (state.versions, state.row_derivatives))

    def at(
        self,
        nonlinear_values: Array,
        known: SeparableSolution | None = None,
        groups: Iterable[int] | None = None,
        taking_part: Indices | None = None,
    ) -> SeparableSolution:
        """The law of given numbers (P_layout,); rows of groups other than `groups` are taken from `known`.

        `taken` (default all of these groups) are the coefficients that take part from now on, if they did not before.
        """
        base = known or self.empty_solution(nonlinear_values)
        rows, excluded = base.rows.copy(), base.excluded.copy()
        row_derivatives, versions = dict(base.row_derivatives), list(base.versions)
        if self.levels:
            self._rescale_levels(base.nonlinear_values, nonlinear_values, rows, (row_derivatives, versions))
        for g in range(len(self.separable.groups)) if groups is None else groups:
            self._evaluate(g, nonlinear_values, rows, row_derivatives)
            versions[g] = next(self._versions)
            excluded[self.separable.coefficients_of(g) if taking_part is None else taking_part] = False
        return self._solution_of(nonlinear_values, rows, excluded, (tuple(versions), row_derivatives))

    def _rescale_levels(
        self, old: Array, new: Array, rows: Array, kept: tuple[dict[int, list[Change]], list[int]]
    ) -> None:
        """Carry what follows the friction levels along with them: rows, changes, and stamps of the groups touched."""
        separable, (row_derivatives, versions) = self.separable, kept
        factor = new[self.levels] / old[self.levels]
        if np.all(factor == 1.0):
            return
        for block, cut in zip(separable.blocks, separable.slices, strict=True):
            rows[self._loaded, cut] *= factor[block.run]
        for i, own in row_derivatives.items():
            row_derivatives[i] = [(g, b, change * self._level_factors(g, b, factor)) for g, b, change in own]
        for g in range(len(separable.groups)):
            if self._loaded[separable.coefficients_of(g)].any():
                versions[g] = next(self._versions)

    def _level_factors(self, g: int, b: int, factor: Array) -> Array:
        """By how much the columns of a group change with the levels of the runs, (columns, 1)."""
        run = self.separable.blocks[b].run
        at = self.separable.column_positions[g][run]
        return np.where((at >= 0) & self._loaded[at], factor[run], 1.0)[:, None]

    def _evaluate(self, g: int, nonlinear_values: Array, rows: Array, row_derivatives: dict[int, list[Change]]) -> None:
        """Rows of one group and how they answer its numbers, all from one evaluation."""
        separable, group = self.separable, self.separable.groups[g]
        for i in group.nonlinear_slots:
            row_derivatives[i] = [c for c in row_derivatives.get(i, []) if c[0] != g]
        for b, block in enumerate(separable.blocks):
            own_slots = [i for i in group.nonlinear_slots if separable.layout.slots[i].run in (None, block.run)]
            moved = np.tile(nonlinear_values, (1 + len(own_slots), 1))
            steps = np.maximum(RELATIVE_STEP * np.abs(nonlinear_values[own_slots]), self._min_step[own_slots])
            moved[np.arange(1, len(moved)), own_slots] += steps
            level = float(nonlinear_values[self.levels[block.run]]) if self.levels else 1.0
            rows_made = separable.rows(g, b, moved, level)
            at = separable.column_positions[g][block.run]
            kept = at >= 0
            rows[at[kept], separable.slices[b]] = rows_made[0, kept]
            for j, i in enumerate(own_slots):
                row_derivatives[i].append((g, b, (rows_made[1 + j] - rows_made[0]) / steps[j]))

    def _solution_of(
        self,
        nonlinear_values: Array,
        rows: Array,
        excluded: Mask,
        kept: tuple[tuple[int, ...], dict[int, list[Change]]],
    ) -> SeparableSolution:
        gram, right = rows @ rows.T, rows @ self.data
        if excluded.any():
            gram[excluded], gram[:, excluded], right[excluded] = 0.0, 0.0, 0.0
        c, unconstrained = bounded_coefficients(gram, right, self.separable.low, self.separable.high)
        residual = self.data - c @ rows
        misfit = float(residual @ residual)
        departure = self._prior_rows @ nonlinear_values - self._prior_target
        misfit += float(departure @ departure)
        levels = self._level_slopes(nonlinear_values, rows, c, (residual, departure))
        return SeparableSolution(
            nonlinear_values, rows, c, unconstrained, residual, misfit, excluded, kept[0], levels, kept[1]
        )

    def _level_slopes(self, nonlinear_values: Array, rows: Array, c: Array, left: tuple[Array, Array]) -> LevelSlopes:
        """How a law answers its levels; `left` is its residual, and how far its numbers are from what is known."""
        separable, slope = self.separable, np.zeros((len(self.levels), self.separable.size))
        residual, departure = left
        if self.levels:
            dry = c[self._loaded] @ rows[self._loaded]
            for block, cut in zip(separable.blocks, separable.slices, strict=True):
                slope[block.run, cut] = dry[cut] / nonlinear_values[self.levels[block.run]]
        return LevelSlopes(
            slope, self._level_precision, slope @ residual - self._prior_rows[:, self.levels].T @ departure
        )

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
        changed_groups = [g for g in chosen if self.separable.groups[g].nonlinear_slots]
        damping = FIRST_DAMPING
        normal_equations = self._normal_equations(state, free) if free else None
        for _ in range(steps if free else 0):
            assert normal_equations is not None
            step, predicted_fall = self._step(state, normal_equations, free, damping)
            hopeless = state.misfit - MAX_PROMISE_FACTOR * predicted_fall > below
            if predicted_fall < enough * state.misfit or damping > MAX_DAMPING or hopeless:
                break
            nonlinear_values = state.nonlinear_values.copy()
            nonlinear_values[free] += step
            trial = self.at(nonlinear_values, state, changed_groups, NO_INDICES)
            if trial.misfit < state.misfit:
                state, normal_equations, damping = (
                    trial,
                    self._normal_equations(trial, free),
                    max(0.1 * damping, MIN_DAMPING),
                )
            else:
                damping = max(30 * damping, 1e-3)
        return state

    def _normal_equations(self, state: SeparableSolution, free: list[int]) -> tuple[Array, Array]:
        """Normal matrix (d, d) and gradient (d,) of the free numbers beside the coefficients."""
        slope = np.zeros((len(free), self.separable.size))
        slope[[i in self.levels for i in free]] = state.levels.rows
        for row, i in zip(slope, free, strict=True):
            for g, b, change in state.row_derivatives.get(i, []):
                at = self.separable.column_positions[g][self.separable.blocks[b].run]
                row[self.separable.slices[b]] += np.where(at >= 0, state.coefficients[at], 0.0) @ change
        rows = state.rows[state.unconstrained]
        normal, gradient = slope @ slope.T, slope @ state.residual
        if len(rows):
            gram, products = rows @ rows.T, rows @ slope.T
            size = np.sqrt(gram.diagonal())
            unit = gram / size / size[:, None]
            unit.flat[:: len(size) + 1] += RIDGE
            products /= size[:, None]
            normal -= products.T @ np.linalg.solve(unit, products)
        if len(self._prior_target):
            prior_rows = self._prior_rows[:, free]
            normal += prior_rows.T @ prior_rows
            gradient = gradient - prior_rows.T @ (self._prior_rows @ state.nonlinear_values - self._prior_target)
        return normal, gradient

    def _step(
        self, state: SeparableSolution, normal_equations: tuple[Array, Array], free: list[int], damping: float
    ) -> tuple[Array, float]:
        """Damped step (d,) of the free numbers within their box, and the fall of the misfit that it promises."""
        normal, gradient = normal_equations
        own = normal.diagonal()
        low, high = self.low[free] - state.nonlinear_values[free], self.high[free] - state.nonlinear_values[free]
        fixed_steps = ((low >= 0) & (gradient <= 0)) | ((high <= 0) & (gradient >= 0)) | (own <= 0)
        size = np.sqrt(np.where(own > 0, own, 1.0))
        unit = normal / size / size[:, None]
        unit.flat[:: len(size) + 1] += damping + RIDGE
        step = np.clip(0.0, low, high)
        # the number that would leave its box first is set to the bound, and the others are solved again
        while not fixed_steps.all():
            movable = ~fixed_steps
            target = gradient[movable] / size[movable] - unit[np.ix_(movable, fixed_steps)] @ (
                step[fixed_steps] * size[fixed_steps]
            )
            step[movable] = np.linalg.solve(unit[np.ix_(movable, movable)], target) / size[movable]
            outside = movable & ((step < low) | (step > high))
            if not outside.any():
                break
            side = np.where(step < low, low, high)
            first = int(np.argmin(np.where(outside, side / np.where(outside, step, 1.0), np.inf)))
            step[first], fixed_steps[first] = side[first], True
        return step, float(2 * gradient @ step - step @ normal @ step)
