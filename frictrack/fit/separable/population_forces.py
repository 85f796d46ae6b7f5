"""Compute the data that a model explains, for a whole population of parameter vectors along all runs at once.

The paths of all blocks are laid end to end. A group of effects is then evaluated by one call for all individuals and
runs, and only the map from forces to data is applied block by block.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.fit.parameters import LEVEL, ParameterLayout, apply_constraints
from frictrack.fit.separable.blocks import DataBlock
from frictrack.fit.separable.groups import EffectGroup
from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.stacks import BlockStack, are_stackable, joined_path
from frictrack.records import Array

Columns = NDArray[np.int_]


class PopulationForces:
    """What a model explains of the data, with all its parameters given.

    Parameters
    ----------
    layout : ParameterLayout
        The unknowns.
    blocks : sequence of DataBlock
        The data.

    Attributes
    ----------
    separable : SeparableModel
        The model over the blocks.

    """

    def __init__(self, layout: ParameterLayout, blocks: Sequence[DataBlock]) -> None:
        self.separable = SeparableModel(layout, blocks, _joined_stack(blocks))
        groups = self.separable.groups
        self._linear = [LinearValues(self.separable, group) for group in groups]
        self._constant_rows = {g: self._rows(g) for g, group in enumerate(groups) if not _varies(group)}
        self._stacks = [self._stacks_of(g) for g in range(len(groups))]
        self._samples = _cuts([len(b.path.t) for b in blocks])
        self._data = np.array([len(b.data) for b in blocks])

    def explained_data(self, vectors: Array) -> tuple[Array, Array]:
        """Compute what the model explains.

        Parameters
        ----------
        vectors : array of shape (Q, P)
            Parameter vectors.

        Returns
        -------
        dry, other : array of shape (Q, N)
            The part of all data that follows the friction level of the run, and the rest, in standard deviations.

        """
        sums: dict[tuple[bool, bool], Array] = {}  # measurement, follows the level: force or shift (Q, samples)
        out = np.zeros((2, len(vectors), self.separable.size))
        for g, group in enumerate(self.separable.groups):
            sizes = self._linear[g].of(vectors)
            for follows_level, columns in self._linear[g].sides:
                if g in self._constant_rows:
                    out[int(follows_level)] += _weighted_sum(sizes, self._constant_rows[g], columns, self._data)
                    continue
                total = self._force(g, vectors, sizes, columns)
                key = group.is_measurement, follows_level
                sums[key] = sums[key] + total if key in sums else total
        for (is_measurement, follows_level), total in sums.items():
            self._add_mapped(total, out[int(follows_level)], is_measurement=is_measurement)
        return out[1], out[0]

    def _rows(self, g: int) -> Array:
        """Data (1, k, N) per unit of every linear parameter of a group that has no other parameters."""
        vector = np.zeros((1, len(self.separable.layout.slots)))
        return np.concatenate([self.separable.rows(g, b, vector) for b in range(len(self.separable.blocks))], axis=2)

    def _force(self, g: int, vectors: Array, sizes: Array, columns: Columns) -> Array:
        """Force or shift (Q, samples) of some columns of a group, of sizes (Q, B, k), along all blocks."""
        parts = [
            _weighted_sum(sizes[:, members] * factors, self._stack_rows(g, stack, vectors), columns, lengths)
            for stack, members, factors, lengths in self._stacks[g]
        ]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)

    def _stack_rows(self, g: int, stack: BlockStack, vectors: Array) -> Array:
        """Rows (Q, k, n) of a group along a stack."""
        return self.separable.unit_rows(g, stack, np.repeat(vectors[:, None], len(stack.members), axis=1))

    def _stacks_of(self, g: int) -> list[tuple[BlockStack, slice, Array, Columns]]:
        """Every stack of a group: its blocks, what its path leaves out of the columns (B, k), and samples by block."""
        return [
            (
                stack,
                slice(stack.members[0], stack.members[-1] + 1),
                self.separable.load_factors(g, stack),
                np.array([len(self.separable.blocks[b].path.t) for b in stack.members]),
            )
            for stack in self.separable.stacks_of(g)
        ]

    def _add_mapped(self, total: Array, out: Array, *, is_measurement: bool) -> None:
        """Add the data that a force or shift (Q, samples) makes."""
        for block, at, cut in zip(self.separable.blocks, self._samples, self.separable.slices, strict=True):
            out[:, cut] += (block.picture if is_measurement else block.forward)(total[:, at])


class LinearValues:
    """Values of the linear parameters of a group of effects.

    Attributes
    ----------
    sides : list of (bool, array)
        Whether they follow the friction level of the run, and which columns do.

    """

    def __init__(self, separable: SeparableModel, group: EffectGroup) -> None:
        self._layout, self._runs = separable.layout, [b.run for b in separable.blocks]
        self._pairs = [(e.name, q.name) for e in group.model.effects for q in e.linear]
        loaded = np.array([q.loaded for e in group.model.effects for q in e.linear], dtype=bool)
        follows = loaded & bool(self._layout.levels)
        columns = [(side, np.flatnonzero(follows == side)) for side in (True, False)]
        self.sides = [(side, own) for side, own in columns if len(own)]
        found = [[separable.position(*pair, run) for pair in self._pairs] for run in self._runs]
        self._places = np.array([[-1 if i is None else i for i in own] for own in found], dtype=np.int_)
        self._fixed = np.array([self._layout.fixed.get(pair, 0.0) for pair in self._pairs])

    def of(self, vectors: Array) -> Array:
        """Return the values (Q, B, k) of parameter vectors (Q, P) in every block."""
        out = np.where(self._places >= 0, vectors[:, self._places], self._fixed)
        if self._layout.constraints and (self._places < 0).any():
            for b, run in enumerate(self._runs):
                values = _constrained_values(self._layout, run, vectors)
                for j in np.flatnonzero(self._places[b] < 0):
                    effect, name = self._pairs[j]
                    out[:, b, j] = values[effect][name]
        return out


def _constrained_values(layout: ParameterLayout, run: int, vectors: Array) -> dict[str, dict[str, Any]]:
    """Every parameter in one run, (Q,) each, constraints applied."""
    values: dict[str, dict[str, Any]] = {e.name: {q.name: 0.0 for q in e.parameters} for e in layout.model.effects}
    for (effect, name), value in layout.fixed.items():
        values[effect][name] = value
    for i in layout.active(run):
        slot = layout.slots[i]
        if slot.effect != LEVEL:
            values[slot.effect][slot.parameter] = vectors[:, i]
    apply_constraints(layout.model, layout.constraints, values)
    return values


def _joined_stack(blocks: Sequence[DataBlock]) -> list[BlockStack]:
    """Join all blocks; none where their paths cannot be laid end to end."""
    paths = [b.path for b in blocks]
    if len(paths) == 1 or not all(are_stackable(paths[0], path) for path in paths[1:]):
        return []
    cuts = _cuts([len(path.t) for path in paths])

    def forward(rows: Array) -> Array:
        return np.concatenate([b.forward(rows[..., cut]) for b, cut in zip(blocks, cuts, strict=True)], axis=-1)

    def picture(rows: Array) -> Array:
        return np.concatenate([b.picture(rows[..., cut]) for b, cut in zip(blocks, cuts, strict=True)], axis=-1)

    return [
        BlockStack(
            members=tuple(range(len(blocks))),
            runs=tuple(b.run for b in blocks),
            path=joined_path(paths),
            forward=forward,
            picture=picture,
            lengths=tuple(len(b.data) for b in blocks),
            loads=tuple(float(path.load) for path in paths),
        )
    ]


def _varies(group: EffectGroup) -> bool:
    """Return whether the columns of a group differ between individuals."""
    return bool(group.nonlinear_slots or group.phase_slots)


def _weighted_sum(sizes: Array, rows: Array, columns: Columns, lengths: Columns) -> Array:
    """Sum columns of rows (Q or 1, k, n), weighted by sizes (Q, B, k) of B blocks of these lengths."""
    each = [sizes[:, :, j].repeat(lengths, axis=1) * rows[:, j] for j in columns]
    return np.asarray(sum(each[1:], start=each[0]))


def _cuts(lengths: Sequence[int]) -> list[slice]:
    """Where stretches of some lengths are that lie end to end."""
    return [slice(int(a), int(b)) for a, b in pairwise(np.cumsum([0, *lengths]))]
