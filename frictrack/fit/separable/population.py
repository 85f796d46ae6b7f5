"""The misfit of a whole population of laws at once, each evaluated along the measured motion.

Over all unknowns, the papers' way (`PopulationMisfit`), or over the non-linear numbers alone, the coefficients solved
for every individual (`ReducedPopulationMisfit`). The levels of several runs are not searched: each is the one of
least squares, held about one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from frictrack.fit.parameters import LEVEL, ParameterLayout, apply_constraints, prior_misfit
from frictrack.fit.separable.blocks import DataBlock
from frictrack.fit.separable.model import NO_INDICES, Indices, SeparableModel
from frictrack.records import Array

MAX_AT_ONCE = 20  # laws evaluated at once: what they need stays in the cache
RIDGE = 1e-9  # of the columns' mean square, where two of them are alike
MAX_PIVOT_ROUNDS = 6  # of putting coefficients on their bounds and releasing them


class PopulationMisfit:
    """Squared misfit of a population over all unknowns but levels. Called with points (P, d), it returns (P,).

    `searched` are the places of the d unknowns in the layout; `unit` turns whitened squares into the unit in which the
    misfit is quoted; levels are held about one to within `tau`.
    """

    def __init__(
        self, layout: ParameterLayout, blocks: Sequence[DataBlock], *, tau: float = 0.03, unit: float = 1.0
    ) -> None:
        self.separable, self.layout, self.tau, self.unit = SeparableModel(layout, blocks), layout, tau, unit
        runs = {None, *self.separable.runs}
        self.searched = [i for i, s in enumerate(layout.slots) if s.effect != LEVEL and s.run in runs]
        self._constant = [
            {g: self.separable.rows(g, b, np.zeros((1, len(layout.slots))))[0] for g in self._constant_groups()}
            for b in range(len(self.separable.blocks))
        ]

    @property
    def blocks(self) -> list[DataBlock]:
        """What is compared."""
        return list(self.separable.blocks)

    def __call__(self, points: Array) -> Array:
        """Misfits (P,)."""
        return _in_chunks(points, lambda some: self.evaluate(some)[0])

    def evaluate(self, points: Array) -> tuple[Array, Array]:
        """Misfits (P,) and the levels that go with them, (P, runs)."""
        full_vectors = self.full_vectors(points)
        total = np.full(len(points), sum(b.rest for b in self.separable.blocks))
        levels = np.ones((len(points), len(self.layout.run_names)))
        with np.errstate(over="ignore", invalid="ignore"):
            for run in self.separable.runs:
                parts = [
                    self._explained_data(b, full_vectors)
                    for b, block in enumerate(self.separable.blocks)
                    if block.run == run
                ]
                data = np.concatenate([block.data for block in self.separable.blocks if block.run == run])
                dry, other = (np.concatenate(side, axis=1) for side in zip(*parts, strict=True))
                cost, levels[:, run] = _with_best_level(
                    data - dry - other, dry, self.tau if self.layout.levels else None
                )
                total += cost
        if self.layout.priors:
            total += prior_misfit(self.layout, full_vectors)
        return total * self.unit, levels

    def law(self, points: Array) -> Array:
        """All unknowns (P, P_layout) of points (P, d) as far as these say them."""
        return self.full_vectors(points)

    def full_vectors(self, points: Array) -> Array:
        """Points (P, d) in their places among all unknowns (P, P_layout); the rest is one."""
        out = np.ones((len(points), len(self.layout.slots)))
        out[:, self.searched] = points
        return out

    def _constant_groups(self) -> list[int]:
        """Groups whose columns are the same for every individual."""
        return [
            g for g, group in enumerate(self.separable.groups) if not group.nonlinear_slots and not group.phase_slots
        ]

    def _explained_data(self, b: int, full_vectors: Array) -> tuple[Array, Array]:
        """What the laws explain of one block, (P, m) each: what follows the friction level, and the rest."""
        separable, block = self.separable, self.separable.blocks[b]
        sums: dict[tuple[bool, bool], Array] = {}  # pictured, loaded: force or shift (P, n)
        dry, other = np.zeros((len(full_vectors), len(block.data))), np.zeros((len(full_vectors), len(block.data)))
        for g, group in enumerate(separable.groups):
            sizes, loaded = self._linear_values(g, block.run, full_vectors)
            follows_level = loaded & bool(self.layout.levels)
            if g in self._constant[b]:
                dry += sizes * follows_level @ self._constant[b][g]
                other += sizes * ~follows_level @ self._constant[b][g]
                continue
            rows = separable.unit_rows(g, b, full_vectors)
            for which in (follows_level, ~follows_level):
                if which.any():
                    key = group.is_measurement, bool(follows_level[which][0])
                    total = sizes[:, 0, None] * rows[:, 0] if which.all() and len(which) == 1 else None
                    if total is None:
                        total = np.einsum("pk,pkn->pn", sizes[:, which], rows[:, which])
                    sums[key] = sums[key] + total if key in sums else total
        for (is_measurement, levelled_sum), total in sums.items():
            mapped = (block.picture if is_measurement else block.forward)(total)
            if levelled_sum:
                dry += mapped
            else:
                other += mapped
        return dry, other

    def _linear_values(self, g: int, run: int, full_vectors: Array) -> tuple[Array, Any]:
        """Values (P, k) of the linear parameters of a group in one run, and which follow the level."""
        effects = self.separable.groups[g].model.effects
        pairs = [(e, q) for e in effects for q in e.linear]
        values = self._values(run, full_vectors) if self.layout.constraints else None
        out = np.zeros((len(full_vectors), len(pairs)))
        for j, (e, q) in enumerate(pairs):
            i = self.separable.position(e.name, q.name, run)
            if i is not None:
                out[:, j] = full_vectors[:, i]
            elif values is not None:
                out[:, j] = values[e.name][q.name]
            else:
                out[:, j] = self.layout.fixed.get((e.name, q.name), 0.0)
        return out, np.array([q.loaded for _, q in pairs], dtype=bool)

    def _values(self, run: int, full_vectors: Array) -> dict[str, dict[str, Any]]:
        """Every parameter in one run, (P,) each, those that follow others filled in."""
        model = self.layout.model
        values: dict[str, dict[str, Any]] = {e.name: {q.name: 0.0 for q in e.parameters} for e in model.effects}
        for (effect, name), value in self.layout.fixed.items():
            values[effect][name] = value
        for i in self.layout.active(run):
            slot = self.layout.slots[i]
            if slot.effect != LEVEL:
                values[slot.effect][slot.parameter] = full_vectors[:, i]
        apply_constraints(model, self.layout.constraints, values)
        return values


class ReducedPopulationMisfit:
    """Squared misfit of a population over the non-linear numbers alone. Called with points (P, d), it returns (P,).

    A wave's phase is no number: its two quadratures are linear. Where a phase belongs to the runs, its amplitude is
    free in each of them here.
    """

    def __init__(
        self, layout: ParameterLayout, blocks: Sequence[DataBlock], *, tau: float = 0.03, unit: float = 1.0
    ) -> None:
        self.separable, self.layout, self.tau, self.unit = SeparableModel(layout, blocks), layout, tau, unit
        separable = self.separable
        self.searched = separable.free
        self._varying_groups = [g for g, group in enumerate(separable.groups) if group.nonlinear_slots]
        constant = [
            i
            for g in range(len(separable.groups))
            if g not in self._varying_groups
            for i in separable.coefficients_of(g)
        ]
        self._constant_groups = np.array(constant, dtype=int)
        rows = np.zeros((len(separable.coefficients), separable.size))
        for g in set(range(len(separable.groups))) - set(self._varying_groups):
            for b, block in enumerate(separable.blocks):
                at = separable.column_positions[g][block.run]
                rows[at[at >= 0], separable.slices[b]] = separable.rows(g, b, np.ones((1, len(layout.slots))))[
                    0, at >= 0
                ]
        self._rows = rows
        self._gram, self._right = rows @ rows.T, rows @ separable.data
        self._square = float(separable.data @ separable.data) + sum(b.rest for b in separable.blocks)

    @property
    def blocks(self) -> list[DataBlock]:
        """What is compared."""
        return list(self.separable.blocks)

    def __call__(self, points: Array) -> Array:
        """Misfits (P,)."""
        return _in_chunks(points, lambda some: self.evaluate(some)[0])

    def evaluate(self, points: Array) -> tuple[Array, Array]:
        """Misfits (P,) and the levels that go with them, (P, runs)."""
        c, gram, right, varying_rows = self._solved(points)
        levels = np.ones((len(points), len(self.layout.run_names)))
        if not self.layout.levels:
            gram_times_c = (gram @ c[:, :, None])[:, :, 0]
            cost = self._square - 2 * np.einsum("pk,pk->p", c, right) + np.einsum("pk,pk->p", c, gram_times_c)
            return np.maximum(cost, 0.0) * self.unit, levels
        total = np.full(len(points), sum(b.rest for b in self.separable.blocks))
        for run in self.separable.runs:
            dry, other = self._explained_data(run, c, varying_rows)
            data = np.concatenate([b.data for b in self.separable.blocks if b.run == run])
            cost, levels[:, run] = _with_best_level(data - dry - other, dry, self.tau)
            total += cost
        return total * self.unit, levels

    def coefficients(self, points: Array) -> Array:
        """Coefficients (P, K) of points (P, d)."""
        return self._solved(points)[0]

    def law(self, points: Array) -> Array:
        """All unknowns (P, P_layout) of points (P, d), levels one."""
        nonlinear_values = self._numbers(points)
        pairs = zip(nonlinear_values, self.coefficients(points), strict=True)
        return np.array([self.separable.law(p, c) for p, c in pairs])

    def _numbers(self, points: Array) -> Array:
        out = np.ones((len(points), len(self.layout.slots)))
        out[:, self.searched] = points
        return out

    def _solved(self, points: Array) -> tuple[Array, Array, Array, list[tuple[Array, Indices]]]:
        """Coefficients (P, K), Gram matrices (P, K, K), products with the data (P, K), and the rows that vary."""
        separable, nonlinear_values = self.separable, self._numbers(points)
        gram = np.repeat(self._gram[None], len(points), axis=0)
        right = np.repeat(self._right[None], len(points), axis=0)
        varying_rows: list[tuple[Array, Indices]] = []
        for b, block in enumerate(separable.blocks):
            places = [separable.column_positions[g][block.run] for g in self._varying_groups]
            at = np.concatenate([NO_INDICES, *places])
            rows = np.empty((len(points), len(at), len(block.data)))
            j = 0
            for g in self._varying_groups:
                for part in separable.parts(g, b, nonlinear_values):
                    rows[:, j : j + part.shape[1]] = part
                    j += part.shape[1]
            present = at >= 0
            varying_rows.append((rows, at) if present.all() else (rows[:, present], at[present]))
            self._add(b, *varying_rows[b], (gram, right))
        return _bounded(gram, right, separable.low, separable.high), gram, right, varying_rows

    def _add(self, b: int, rows: Array, at: Indices, into: tuple[Array, Array]) -> None:
        """Add one block's products: rows (P, k, m), which are the coefficients `at`."""
        gram, right = into
        cut = self.separable.slices[b]
        other_rows = np.vstack([self._rows[self._constant_groups][:, cut], self.separable.data[cut]])
        flat = (rows.reshape(-1, rows.shape[2]) @ other_rows.T).reshape(len(rows), rows.shape[1], -1)
        right[:, at] += flat[:, :, -1]
        gram[:, at[:, None], self._constant_groups] += flat[:, :, :-1]
        gram[:, self._constant_groups[:, None], at] += flat[:, :, :-1].transpose(0, 2, 1)
        gram[:, at[:, None], at] += rows @ rows.transpose(0, 2, 1)

    def _explained_data(self, run: int, c: Array, varying_rows: list[tuple[Array, Indices]]) -> tuple[Array, Array]:
        """What the laws explain of one run, (P, m) each: what follows the level, and the rest."""
        separable = self.separable
        loaded = np.array([k.loaded for k in separable.coefficients], dtype=bool)
        parts = []
        for b, block in enumerate(separable.blocks):
            if block.run != run:
                continue
            sides = [
                c[:, self._constant_groups]
                * w[self._constant_groups]
                @ self._rows[self._constant_groups][:, separable.slices[b]]
                for w in (loaded, ~loaded)
            ]
            rows, at = varying_rows[b]
            for i, w in enumerate((loaded, ~loaded)):
                sides[i] = sides[i] + np.einsum("pk,pkm->pm", c[:, at] * w[at], rows)
            parts.append(sides)
        dry, other = (np.concatenate(side, axis=1) for side in zip(*parts, strict=True))
        return dry, other


def _with_best_level(residual: Array, dry: Array, tau: float | None) -> tuple[Array, Array]:
    """Squared residuals (P,) of one run at its best level, and the level: dry friction times 1 + d, d of spread tau."""
    if tau is None:
        return np.einsum("pm,pm->p", residual, residual), np.ones(len(residual))
    d = np.sum(dry * residual, axis=1) / (np.sum(dry**2, axis=1) + tau**-2)
    left = residual - d[:, None] * dry
    return np.einsum("pm,pm->p", left, left) + (d / tau) ** 2, 1 + d


def _bounded(gram: Array, right: Array, low: Array, high: Array) -> Array:
    """Coefficients (P, K) of least squares within bounds, all individuals at once (block pivoting, Portugal 1994)."""
    size = np.sqrt(np.einsum("pkk->pk", gram))
    size[size == 0] = 1.0
    unit = gram / size[:, :, None] / size[:, None, :]
    diagonal = np.arange(len(low))
    unit[:, diagonal, diagonal] += RIDGE
    c = np.linalg.solve(unit, (right / size)[:, :, None])[:, :, 0] / size
    bad = np.flatnonzero(np.any((c < low) | (c > high), axis=1))
    if len(bad):
        c[bad] = _pivot_on_bounds(unit[bad], right[bad] / size[bad], low * size[bad], high * size[bad]) / size[bad]
    return c


def _pivot_on_bounds(unit: Array, right: Array, low: Array, high: Array) -> Array:
    fixed = np.broadcast_to(low == high, right.shape).copy()
    value = np.where(fixed, low, 0.0)
    for _ in range(MAX_PIVOT_ROUNDS):
        system = np.where(fixed[:, :, None] | fixed[:, None, :], 0.0, unit)
        rest = np.where(fixed, value, right - np.einsum("pkj,pj->pk", unit, np.where(fixed, value, 0.0)))
        k = np.arange(right.shape[1])
        system[:, k, k] = np.where(fixed, 1.0, unit[:, k, k])
        c = np.linalg.solve(system, rest[:, :, None])[:, :, 0]
        pull = right - np.einsum("pkj,pj->pk", unit, c)
        leaving = ~fixed & ((c < low) | (c > high))
        returning = fixed & (low < high) & (((c <= low) & (pull > 0)) | ((c >= high) & (pull < 0)))
        if not (leaving | returning).any():
            break
        value = np.where(leaving, np.clip(c, low, high), value)
        fixed = (fixed | leaving) & ~returning
    return np.clip(c, low, high)


def _in_chunks(points: Array, cost: Any) -> Array:
    parts = np.array_split(points, max(1, -(-len(points) // MAX_AT_ONCE)))
    return np.concatenate([cost(part) for part in parts])
