"""Evaluate the rows of a group of effects and their derivatives with respect to its non-linear parameters."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from frictrack.fit.separable.groups import Indices, Segment
from frictrack.fit.separable.model import SeparableModel
from frictrack.fit.separable.stacks import BlockStack
from frictrack.records import Array, Mask

RELATIVE_STEP = 1e-6  # finite-difference step over the value, or over a thousandth of its range


@dataclass(frozen=True, eq=False)
class RowChange:
    """RowChange of the rows of a group per unit of a non-linear parameter.

    `at` (k,) are the coefficients of the rows, `cut` is the part of the data, `rows` (k, m) the change there.
    """

    g: int
    at: Indices
    cut: slice
    rows: Array

    def rescaled(self, loaded: Mask, factors: Array) -> RowChange:
        """Return the change with the rows of `loaded` coefficients (K,) multiplied by `factors` (M,)."""
        affected = (self.at >= 0) & loaded[self.at]
        if not affected.any():
            return self
        return replace(self, rows=self.rows * np.where(affected[:, None], factors[self.cut], 1.0))


@dataclass(frozen=True, eq=False)
class EvaluatedStack:
    """The rows of one group in the B blocks of a stack, and how they change with its q non-linear parameters.

    Attributes
    ----------
    separable : SeparableModel
        The model.
    g : int
        The group.
    stack : BlockStack
        The blocks.
    places : array of shape (q, B)
        Positions of the parameters in the layout, those common to the runs first; -1 where a block has fewer.
    rows : array of shape (k, m)
        Data per unit coefficient.
    slopes : array of shape (q, k, m)
        Their change per unit of each parameter.

    """

    separable: SeparableModel
    g: int
    stack: BlockStack
    places: Indices
    rows: Array
    slopes: Array

    @classmethod
    def of(
        cls, separable: SeparableModel, which: tuple[int, BlockStack], nonlinear_values: Array, min_step: Array
    ) -> EvaluatedStack:
        """Evaluate a group along a stack, (g, stack), at values (P,), with finite differences of at least a step."""
        g, stack = which
        places = separable.places(g, stack)
        steps = np.maximum(RELATIVE_STEP * np.abs(nonlinear_values[places]), min_step[places])
        steps[places < 0] = 1.0
        moved = np.empty((1 + len(places), len(stack.members), len(nonlinear_values)))
        moved[:] = nonlinear_values
        j, member = np.nonzero(places >= 0)
        moved[1 + j, member, places[j, member]] += steps[j, member]
        levels = separable.layout.levels
        level = nonlinear_values[levels][list(stack.runs)] if levels else np.ones(len(stack.runs))
        made = separable.stacked_rows(g, stack, moved, level)
        slopes = made[1:] - made[:1]
        slopes /= np.repeat(steps, stack.lengths, axis=1)[:, None] if len(stack.members) > 1 else steps[:, :, None]
        return cls(separable, g, stack, places, made[0], slopes)

    def write_rows(self, into: Array) -> None:
        """Write the rows at their coefficients and data, into (K, M)."""
        for part in self.separable.segments(self.g, self.stack):
            kept = part.at >= 0
            into[part.at[kept], part.cut] = self.rows[kept, part.inside]

    def changes(self) -> Iterator[tuple[int, RowChange]]:
        """Yield parameters and their derivatives: of a common parameter at once, of others run by run."""
        for part in self.separable.segments(self.g, self.stack):
            members = list(part.members)
            for places, slope in zip(self.places, self.slopes, strict=True):
                if (places[members] == places[members[0]]).all():
                    yield from self._change(places[members[0]], slope, part)
                else:
                    for m in members:
                        cut = self.separable.slices[self.stack.members[m]]
                        yield from self._change(places[m], slope, Segment(part.at, self.stack.slices[m], cut, (m,)))

    def _change(self, place: int, slope: Array, part: Segment) -> Iterator[tuple[int, RowChange]]:
        if place >= 0:
            yield int(place), RowChange(self.g, part.at, part.cut, slope[:, part.inside])
