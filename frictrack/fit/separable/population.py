"""Compute the misfit of a whole population of parameter vectors, each evaluated along the measured motion.

`PopulationMisfit` is over all unknowns, as in the papers. `ReducedPopulationMisfit` is over the non-linear parameters
only and solves the coefficients for every individual. Friction levels of several runs are not searched: each has its
least-squares value, with a penalty about one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from frictrack.fit.parameters import LEVEL, ParameterLayout, prior_misfit
from frictrack.fit.separable.blocks import DataBlock, repeat_values, tiled_path
from frictrack.fit.separable.bounded import bounded_population
from frictrack.fit.separable.model import SeparableModel
from frictrack.records import Array

MAX_AT_ONCE = 40  # individuals evaluated at once, a whole generation of the genetic searches
MAX_VALUES_AT_ONCE = 2**18  # individuals times data, so that an array stays in the cache of the processor


class _SearchMisfit(ABC):
    """Misfit of points of a search. Called with points (Q, d), it returns misfits (Q,).

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

    """

    def __init__(
        self, layout: ParameterLayout, blocks: Sequence[DataBlock], *, tau: float = 0.03, unit: float = 1.0
    ) -> None:
        self.layout, self.blocks, self.tau, self.unit = layout, list(blocks), tau, unit
        self.separable = SeparableModel(layout, blocks)

    @property
    @abstractmethod
    def searched(self) -> list[int]:
        """Positions of the d unknowns in the layout."""

    @abstractmethod
    def _explained(self, points: Array) -> tuple[Array, Array]:
        """Modelled data at level one, (Q, M) each: the part that follows the level of the run, and the rest."""

    @abstractmethod
    def law(self, points: Array) -> Array:
        """Return parameter vectors (Q, P) of points (Q, d), with levels one."""

    def __call__(self, points: Array) -> Array:
        """Compute the misfits (Q,) of points (Q, d)."""
        at_once = min(MAX_AT_ONCE, max(1, MAX_VALUES_AT_ONCE // self.separable.size))
        parts = np.array_split(points, max(1, -(-len(points) // at_once)))
        return np.concatenate([self.evaluate(part)[0] for part in parts])

    def evaluate(self, points: Array) -> tuple[Array, Array]:
        """Compute misfits and friction levels.

        A level is 1 + d; d has mean zero and standard deviation tau.

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
        levels = np.ones((len(points), len(self.layout.run_names)))
        misfits = np.full(len(points), sum(b.rest for b in self.blocks))
        with np.errstate(over="ignore", invalid="ignore"):
            dry, other = self._explained(points)
            residual = self.separable.data - dry - other
            for run in self.separable.runs if self.layout.levels else ():
                mine = self.separable.run_of_datum == run
                own = dry[:, mine]
                d = np.einsum("qm,qm->q", own, residual[:, mine]) / (np.einsum("qm,qm->q", own, own) + self.tau**-2)
                residual[:, mine] -= d[:, None] * own
                misfits += (d / self.tau) ** 2
                levels[:, run] += d
            misfits += np.einsum("qm,qm->q", residual, residual)
        return misfits * self.unit, levels

    def full_vectors(self, points: Array) -> Array:
        """Insert points (Q, d) into parameter vectors (Q, P); the other entries are one."""
        out = np.ones((len(points), len(self.layout.slots)))
        out[:, self.searched] = points
        return out


class PopulationMisfit(_SearchMisfit):
    """Misfit over all unknowns but the friction levels."""

    @cached_property
    def searched(self) -> list[int]:
        """Positions of the d unknowns in the layout."""
        runs = {None, *self.separable.runs}
        return [i for i, s in enumerate(self.layout.slots) if s.effect != LEVEL and s.run in runs]

    def evaluate(self, points: Array) -> tuple[Array, Array]:
        """Compute misfits (Q,), with those of the priors, and friction levels (Q, R) of points (Q, d)."""
        misfits, levels = super().evaluate(points)
        if self.layout.priors:
            misfits += prior_misfit(self.layout, self.full_vectors(points)) * self.unit
        return misfits, levels

    def law(self, points: Array) -> Array:
        """Return parameter vectors (Q, P) of points (Q, d), as far as these determine them."""
        return self.full_vectors(points)

    def _explained(self, points: Array) -> tuple[Array, Array]:
        vectors = self.full_vectors(points)
        dry, other = np.concatenate([self._explained_in(block, vectors) for block in self.blocks], axis=2)
        return dry, other

    def _explained_in(self, block: DataBlock, vectors: Array) -> Array:
        """Both parts of the modelled data of one block, (2, Q, m)."""
        model, count = self.layout.model, len(vectors)
        path = tiled_path(block.evaluation_path(model.memory), count)
        values, n = self.layout.values(vectors, block.run)[0], len(path.t) // count
        nonlinear = {
            e.name: {q.name: repeat_values(values[e.name][q.name], n, q.role == "depth") for q in e.nonlinear}
            for e in model.effects
        }
        columns = model.force_columns(path, nonlinear) | model.measurement_columns(path, nonlinear)
        force, shift = np.zeros((2, 2, count, n))
        for e in (e for e in model.effects if e.name in columns):  # a modifier only changes the columns of others
            total = force if e.acts_on == "force" else shift
            for column, q in zip(columns[e.name].T, e.linear, strict=True):
                follows_level = q.loaded and bool(self.layout.levels)
                size = np.reshape(values[e.name][q.name], (-1, 1))
                total[0 if follows_level else 1] += size * column.reshape(count, -1)
        data = block.forward(force)
        return data + block.picture(shift) if any(e.acts_on == "measurement" for e in model.effects) else data


class ReducedPopulationMisfit(_SearchMisfit):
    """Misfit over the non-linear parameters, with the best coefficients of every individual.

    The phase of a sinusoid is not searched, because its two quadratures are linear. If the phase belongs to the runs,
    the amplitude is free in every run here.
    """

    @property
    def searched(self) -> list[int]:
        """Positions of the d unknowns in the layout."""
        return self.separable.free

    @cached_property
    def _constant_rows(self) -> Array:
        """Rows (1, K, M) of the groups without non-linear parameters, the others zero."""
        rows = np.zeros((1, len(self.separable.coefficients), self.separable.size))
        self._write_rows(False, np.ones((1, len(self.layout.slots))), rows)
        return rows

    def coefficients(self, points: Array) -> Array:
        """Compute the coefficients (Q, K) of points (Q, d)."""
        return self._solved(points)[0]

    def law(self, points: Array) -> Array:
        """Compute parameter vectors (Q, P) of points (Q, d), with levels one."""
        pairs = zip(self.full_vectors(points), self.coefficients(points), strict=True)
        return np.array([self.separable.law(p, c) for p, c in pairs])

    def _explained(self, points: Array) -> tuple[Array, Array]:
        c, rows = self._solved(points)
        if not self.layout.levels:
            return np.zeros((len(points), 1)), (c[:, None] @ rows)[:, 0]
        loaded = self.separable.loaded
        dry, other = (np.stack([c * loaded, c * ~loaded], axis=1) @ rows).transpose(1, 0, 2)
        return dry, other

    def _solved(self, points: Array) -> tuple[Array, Array]:
        """Coefficients (Q, K) and rows (Q, K, M)."""
        rows = np.repeat(self._constant_rows, len(points), axis=0)
        self._write_rows(True, self.full_vectors(points), rows)
        gram, right = rows @ rows.transpose(0, 2, 1), rows @ self.separable.data
        return bounded_population(gram, right, self.separable.low, self.separable.high), rows

    def _write_rows(self, varying: bool, vectors: Array, rows: Array) -> None:
        """Write the rows of the groups with or without non-linear parameters at vectors (Q, P) into (Q, K, M)."""
        for g in (g for g, group in enumerate(self.separable.groups) if bool(group.nonlinear_slots) == varying):
            for b, block in enumerate(self.blocks):
                at = self.separable.column_positions[g][block.run]
                own = at < rows.shape[1]
                rows[:, at[own], self.separable.slices[b]] = self.separable.rows(g, b, vectors)[:, own]
