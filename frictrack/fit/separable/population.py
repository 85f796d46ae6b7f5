"""Compute the misfit of a whole population of parameter vectors, each evaluated along the measured motion.

`PopulationMisfit` is over all unknowns, as in the papers. `ReducedPopulationMisfit` is over the non-linear parameters
only and solves the coefficients for every individual. Friction levels of several runs are not searched: each has its
least-squares value, with a penalty about one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from frictrack.fit.parameters import LEVEL, ParameterLayout, prior_misfit
from frictrack.fit.separable.blocks import DataBlock
from frictrack.fit.separable.groups import NO_INDICES, Indices
from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.population_forces import PopulationForces
from frictrack.records import Array

MAX_AT_ONCE = 40  # individuals evaluated at once, a whole generation of the genetic searches
MAX_VALUES_AT_ONCE = 2**18  # individuals times data, so that an array stays in the cache of the processor
RIDGE = 1e-9  # relative; keeps nearly equal columns solvable
MAX_PIVOT_ROUNDS = 6  # rounds of block pivoting


class PopulationMisfit:
    """Misfit over all unknowns but the friction levels. Called with points (Q, d), it returns misfits (Q,).

    Parameters
    ----------
    layout : ParameterLayout
        The unknowns.
    blocks : sequence of DataBlock
        The data.
    tau : float
        Relative standard deviation of the friction levels.
    unit : float
        Factor from whitened squares to the unit in which the misfit is reported.

    Attributes
    ----------
    searched : list of int
        Positions of the d unknowns in the layout.

    """

    def __init__(
        self, layout: ParameterLayout, blocks: Sequence[DataBlock], *, tau: float = 0.03, unit: float = 1.0
    ) -> None:
        self.layout, self.tau, self.unit = layout, tau, unit
        self._forces = PopulationForces(layout, blocks)
        self.separable = self._forces.separable
        runs = {None, *self.separable.runs}
        self.searched = [i for i, s in enumerate(layout.slots) if s.effect != LEVEL and s.run in runs]
        self._by_run = _RunSums(self.separable.run_of_datum)

    @property
    def blocks(self) -> list[DataBlock]:
        """The data that are compared."""
        return list(self.separable.blocks)

    def __call__(self, points: Array) -> Array:
        """Compute the misfits (Q,) of points (Q, d)."""
        return _in_chunks(points, lambda some: self.evaluate(some)[0], self.separable.size)

    def evaluate(self, points: Array) -> tuple[Array, Array]:
        """Compute misfits and friction levels.

        Parameters
        ----------
        points : array of shape (Q, d)
            Points of the search.

        Returns
        -------
        misfits : array of shape (Q,)
            Squared misfits.
        levels : array of shape (Q, R)
            Friction levels of the R runs.

        """
        full_vectors = self.full_vectors(points)
        levels = np.ones((len(points), len(self.layout.run_names)))
        with np.errstate(over="ignore", invalid="ignore"):
            dry, other = self._forces.explained_data(full_vectors)
            residual = self.separable.data - dry - other
            cost, levels[:, self.separable.runs] = self._by_run.with_best_levels(
                residual, dry, self.tau if self.layout.levels else None
            )
        total = cost + sum(b.rest for b in self.separable.blocks)
        if self.layout.priors:
            total += prior_misfit(self.layout, full_vectors)
        return total * self.unit, levels

    def law(self, points: Array) -> Array:
        """Return parameter vectors (Q, P) of points (Q, d), as far as these determine them."""
        return self.full_vectors(points)

    def full_vectors(self, points: Array) -> Array:
        """Insert points (Q, d) into parameter vectors (Q, P); the other entries are one."""
        out = np.ones((len(points), len(self.layout.slots)))
        out[:, self.searched] = points
        return out


class ReducedPopulationMisfit:
    """Misfit over the non-linear parameters. Called with points (Q, d), it returns misfits (Q,).

    The phase of a sinusoid is not searched, because its two quadratures are linear. If the phase belongs to the runs,
    the amplitude is free in every run here. Parameters are those of `PopulationMisfit`.
    """

    def __init__(
        self, layout: ParameterLayout, blocks: Sequence[DataBlock], *, tau: float = 0.03, unit: float = 1.0
    ) -> None:
        self.separable, self.layout, self.tau, self.unit = SeparableModel(layout, blocks), layout, tau, unit
        separable = self.separable
        self._by_run = _RunSums(separable.run_of_datum)
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
        """The data that are compared."""
        return list(self.separable.blocks)

    def __call__(self, points: Array) -> Array:
        """Compute the misfits (Q,) of points (Q, d)."""
        return _in_chunks(points, lambda some: self.evaluate(some)[0], self.separable.size)

    def evaluate(self, points: Array) -> tuple[Array, Array]:
        """Compute misfits (Q,) and friction levels (Q, R) of points (Q, d)."""
        c, gram, right, varying_rows = self._solved(points)
        levels = np.ones((len(points), len(self.layout.run_names)))
        if not self.layout.levels:
            gram_times_c = (gram @ c[:, :, None])[:, :, 0]
            cost = self._square - 2 * np.einsum("pk,pk->p", c, right) + np.einsum("pk,pk->p", c, gram_times_c)
            return np.maximum(cost, 0.0) * self.unit, levels
        dry, other = self._explained_data(c, varying_rows)
        residual = self.separable.data - dry - other
        cost, levels[:, self.separable.runs] = self._by_run.with_best_levels(residual, dry, self.tau)
        return (cost + sum(b.rest for b in self.separable.blocks)) * self.unit, levels

    def coefficients(self, points: Array) -> Array:
        """Compute the coefficients (Q, K) of points (Q, d)."""
        return self._solved(points)[0]

    def law(self, points: Array) -> Array:
        """Compute parameter vectors (Q, P) of points (Q, d), with levels one."""
        nonlinear_values = self._numbers(points)
        pairs = zip(nonlinear_values, self.coefficients(points), strict=True)
        return np.array([self.separable.law(p, c) for p, c in pairs])

    def _numbers(self, points: Array) -> Array:
        out = np.ones((len(points), len(self.layout.slots)))
        out[:, self.searched] = points
        return out

    def _solved(self, points: Array) -> tuple[Array, Array, Array, list[tuple[Array, Indices]]]:
        """Coefficients (Q, K), Gram matrices (Q, K, K), products with the data (Q, K), and the rows that vary."""
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
        """Add the products of one block; `rows` (Q, k, m) belong to the coefficients `at`."""
        gram, right = into
        cut = self.separable.slices[b]
        other_rows = np.vstack([self._rows[self._constant_groups][:, cut], self.separable.data[cut]])
        flat = (rows.reshape(-1, rows.shape[2]) @ other_rows.T).reshape(len(rows), rows.shape[1], -1)
        right[:, at] += flat[:, :, -1]
        gram[:, at[:, None], self._constant_groups] += flat[:, :, :-1]
        gram[:, self._constant_groups[:, None], at] += flat[:, :, :-1].transpose(0, 2, 1)
        gram[:, at[:, None], at] += rows @ rows.transpose(0, 2, 1)

    def _explained_data(self, c: Array, varying_rows: list[tuple[Array, Indices]]) -> tuple[Array, Array]:
        """Modelled data of all runs, (Q, N) each: the part that follows the level of the run, and the rest."""
        separable = self.separable
        loaded = np.array([k.loaded for k in separable.coefficients], dtype=bool)
        parts = []
        for b in range(len(separable.blocks)):
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


class _RunSums:
    """Sums over the data of every run.

    Parameters
    ----------
    run_of_datum : array of int, shape (N,)
        The run of every datum.

    """

    def __init__(self, run_of_datum: Indices) -> None:
        self._first = np.flatnonzero(np.diff(run_of_datum, prepend=-1))  # of every stretch of one run
        _, self._run = np.unique(run_of_datum[self._first], return_inverse=True)
        self._lengths = np.diff([*self._first, len(run_of_datum)])
        self._sorted = np.array_equal(self._run, np.arange(len(self._run)))

    def of(self, values: Array) -> Array:
        """Sum values (Q, N) over every run, (Q, R)."""
        stretches: Array = np.add.reduceat(values, self._first, axis=1)
        return stretches if self._sorted else stretches @ (self._run[:, None] == np.arange(self._run.max() + 1))

    def spread(self, values: Array) -> Array:
        """Repeat values (Q, R) of every run over its data, (Q, N)."""
        return np.repeat(values[:, self._run], self._lengths, axis=1)

    def with_best_levels(self, residual: Array, dry: Array, tau: float | None) -> tuple[Array, Array | float]:
        """Sum squared residuals (Q,) with every run at its best level, and return the levels (Q, R).

        A level is 1 + d; d has standard deviation tau. The residuals (Q, N) are those at level one.
        """
        if tau is None:
            return np.einsum("pm,pm->p", residual, residual), 1.0
        d = self.of(dry * residual) / (self.of(dry * dry) + tau**-2)
        left = residual - self.spread(d) * dry
        return np.einsum("pm,pm->p", left, left) + np.sum((d / tau) ** 2, axis=1), 1 + d


def _bounded(gram: Array, right: Array, low: Array, high: Array) -> Array:
    """Least-squares coefficients (Q, K) within bounds, all individuals at once.

    References
    ----------
    Portugal, L. F., Judice, J. J. & Vicente, L. N. (1994). A comparison of block pivoting and interior-point
    algorithms. Mathematics of Computation 63, 625-643.

    """
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
    """Block pivoting: set coefficients on their bounds and release them until none changes."""
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


def _in_chunks(points: Array, cost: Callable[[Array], Array], size: int) -> Array:
    """Costs of points, as many at once as keep arrays of `size` values each short."""
    at_once = min(MAX_AT_ONCE, max(1, MAX_VALUES_AT_ONCE // size))
    parts = np.array_split(points, max(1, -(-len(points) // at_once)))
    return np.concatenate([cost(part) for part in parts])
