"""Gauss-Newton on the projected problem: the coefficients follow from the non-linear numbers by bounded least squares.

Golub & Pereyra 1973 with Kaufman's (1975) Jacobian, in the Gram matrix of the law's rows: one small matrix holds all
that a step needs. Levels of friction are non-linear numbers here, held about one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from frictrack.fit.along.columns import Along
from frictrack.fit.layout import LEVEL
from frictrack.fit.scatter import restraint, restraint_rows
from frictrack.records import Array, Mask

STEP = 1e-6  # of a number, or of a thousandth of its box, for derivatives of columns
RIDGE = 1e-12  # of the columns' mean square, where two of them are alike
FIRST_DAMPING, MOST_DAMPED = 1e-6, 1e6


@dataclass(frozen=True, eq=False)
class State:
    """One law: numbers (P_layout,), rows (K, M), coefficients (K,), which of these may move, and the misfit.

    `misfit` is the sum of squared residuals and of what holds the levels about one.
    """

    numbers: Array
    rows: Array
    coefficients: Array
    moving: Mask
    residual: Array  # (M,)
    misfit: float


def bounded(gram: Array, right: Array, low: Array, high: Array) -> tuple[Array, Mask]:
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


class Projected:
    """The projected problem of one data set (M,): states, steps, refinement. `tau` is the spread of the levels."""

    def __init__(self, along: Along, data: Array, tau: float = 0.03) -> None:
        self.along, self.data, self.tau = along, data, tau
        self.layout = along.layout
        self.levels = self.layout.levels
        self.low, self.high = self.layout.bounds
        self._held = restraint_rows(self.layout, tau)

    def state(self, numbers: Array, rows: Array) -> State:
        """The law of given numbers and rows, its coefficients solved."""
        c, moving = bounded(rows @ rows.T, rows @ self.data, self.along.low, self.along.high)
        residual = self.data - c @ rows
        held = restraint(self.layout, numbers, self.tau) if self.levels else np.zeros(0)
        return State(numbers, rows, c, moving, residual, float(residual @ residual + held @ held))

    def at(self, numbers: Array, known: Array | None = None, only: set[int] | None = None) -> State:
        """The law of given numbers; rows of groups not in `only` are taken from `known`."""
        levels = self._levels(numbers)
        return self.state(numbers, self.along.design(numbers, levels, known, only))

    def refine(self, state: State, groups: set[int], steps: int = 12, enough: float = 1e-5) -> State:
        """Levenberg-Marquardt over the numbers of the given groups (and the levels) until a step promises nothing.

        `enough` is the promised fall of the misfit, as a share of it, that is not worth a step.
        """
        free = [i for g in groups for i in self.along.groups[g].numbers] + self.levels
        if not free:
            return state
        damping = FIRST_DAMPING
        slope: tuple[Array, Array] | None = None
        for _ in range(steps):
            if slope is None:
                slope = self._slope(state, free)
            step, promised = self._step(state, slope, free, damping)
            if promised < enough * state.misfit or damping > MOST_DAMPED:
                break
            numbers = state.numbers.copy()
            numbers[free] += step
            trial = self.at(numbers, state.rows, self._touched(groups))
            if trial.misfit < state.misfit:
                state, slope, damping = trial, None, max(damping * 0.1, 1e-10)
            else:
                damping = max(damping * 30, 1e-3)
        return state

    def _touched(self, groups: set[int]) -> set[int]:
        return set(range(len(self.along.groups))) if self.levels else groups

    def _levels(self, numbers: Array) -> Array | None:
        return numbers[self.levels] if self.levels else None

    def _slope(self, state: State, free: list[int]) -> tuple[Array, Array]:
        """Change (d, M) of the law per unit of every free number, coefficients held, and the Gram matrix beside it."""
        out = np.zeros((len(free), self.along.size))
        for j, i in enumerate(free):
            slot = self.layout.slots[i]
            if slot.effect == LEVEL:
                self._by_level(state, i, out[j])
            else:
                self._by_number(state, i, out[j])
        return out, out @ state.rows.T

    def _by_number(self, state: State, i: int, out: Array) -> None:
        along = self.along
        g = next(k for k, group in enumerate(along.groups) if i in group.numbers)
        width = self.high[i] - self.low[i]
        step = STEP * max(abs(state.numbers[i]), 1e-3 * width if np.isfinite(width) else 1.0)
        moved = state.numbers.copy()
        moved[i] += step
        levels = self._levels(state.numbers)
        for b, block in enumerate(along.blocks):
            if self.layout.slots[i].run not in (None, block.run):
                continue
            at = along.place[g][block.run]
            kept = at >= 0
            level = 1.0 if levels is None else float(levels[block.run])
            rows = along.rows(g, b, moved[None], level)[0][kept]
            change = (rows - state.rows[at[kept], along.slices[b]]) / step
            out[along.slices[b]] = state.coefficients[at[kept]] @ change

    def _by_level(self, state: State, i: int, out: Array) -> None:
        run = self.layout.slots[i].run
        loaded = np.array([c.loaded for c in self.along.coefficients])
        for b, block in enumerate(self.along.blocks):
            if block.run == run:
                rows = state.rows[loaded, self.along.slices[b]]
                out[self.along.slices[b]] = state.coefficients[loaded] @ rows / state.numbers[i]

    def _step(self, state: State, slope: tuple[Array, Array], free: list[int], damping: float) -> tuple[Array, float]:
        """Damped step (d,) of the free numbers within their box, and the fall of the misfit that it promises."""
        change, beside = slope[0], slope[1][:, state.moving]
        normal = change @ change.T
        gradient = change @ state.residual
        if state.moving.any():
            gram = state.rows[state.moving] @ state.rows[state.moving].T
            size = np.sqrt(gram.diagonal())
            unit = gram / size / size[:, None]
            unit.flat[:: len(size) + 1] += RIDGE
            normal = normal - (beside / size) @ np.linalg.solve(unit, (beside / size).T)
        if self.levels:
            held = self._held[:, free]
            normal = normal + held.T @ held
            gradient = gradient - held.T @ restraint(self.layout, state.numbers, self.tau)
        return self._within(state, free, normal, gradient, damping)

    def _within(
        self, state: State, free: list[int], normal: Array, gradient: Array, damping: float
    ) -> tuple[Array, float]:
        size = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
        low, high = self.low[free] - state.numbers[free], self.high[free] - state.numbers[free]
        stuck = ((low >= 0) & (gradient <= 0)) | ((high <= 0) & (gradient >= 0)) | (normal.diagonal() <= 0)
        unit = normal / size / size[:, None]
        unit.flat[:: len(size) + 1] += damping + 1e-12
        unit[stuck] = 0.0
        unit[:, stuck] = 0.0
        unit[stuck, stuck] = 1.0
        step = np.linalg.solve(unit, np.where(stuck, 0.0, gradient / size)) / size
        step = np.clip(step, low, high)
        return step, float(2 * gradient @ step - step @ normal @ step)
