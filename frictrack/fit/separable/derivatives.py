"""Derivatives of the rows of groups of effects, and the response of a solution to its non-linear parameters."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from frictrack.fit.separable.model import Indices, Segment, SeparableModel
from frictrack.fit.separable.stacks import BlockStack
from frictrack.records import Array, Mask

RELATIVE_STEP = 1e-6  # finite-difference step over the value, or over a thousandth of its range


@dataclass(frozen=True, eq=False)
class Tangent:
    """The response of a solution to d non-linear parameters and R friction levels, at constant coefficients.

    A datum belongs to one run, hence responds to one level only.

    Attributes
    ----------
    positions : array of int, shape (d + R,)
        Positions of the parameters in the layout, the levels last.
    slopes : array of shape (d, M)
        Change of the modelled data per unit of every parameter.
    per_datum : array of shape (M,)
        Change of every modelled datum per unit of the level of its run.
    run : array of int, shape (M,)
        The run of every datum.
    precision : array of shape (d + R, d + R), optional
        Precision of the penalties on them.
    gradient : array of shape (d + R,)
        Half the downward slope of the misfit.
    is_inside : array of bool, shape (d + R,)
        Which of them are inside their bounds.

    """

    positions: Indices
    slopes: Array
    per_datum: Array
    run: Indices
    precision: Array | None
    gradient: Array
    is_inside: Mask

    @property
    def n_levels(self) -> int:
        """Number of friction levels."""
        return len(self.positions) - len(self.slopes)

    @cached_property
    def rows(self) -> Array:
        """Change of the modelled data per unit of everything, (d + R, M)."""
        if not self.n_levels:
            return self.slopes
        out = np.zeros((len(self.positions), self.slopes.shape[1]))
        out[: len(self.slopes)] = self.slopes
        out[len(self.slopes) + self.run, np.arange(len(self.run))] = self.per_datum
        return out

    def products(self, others: Array) -> Array:
        """Multiply other data (K, M) with the responses; gives (K, d + R)."""
        own = others @ self.slopes.T
        return np.hstack([own, self._level_products(others)]) if self.n_levels else own

    def _level_products(self, others: Array) -> Array:
        """Products of other data (K, M) with the responses to the levels, (K, R)."""
        return np.stack([np.bincount(self.run, self.per_datum * other, self.n_levels) for other in others])

    @cached_property
    def normal(self) -> Array:
        """Inner products of the responses, with the precision of the penalties, (d + R, d + R)."""
        d, out = len(self.slopes), np.zeros((len(self.positions), len(self.positions)))
        out[:d, :d] = self.slopes @ self.slopes.T
        if self.n_levels:
            across = self._level_products(np.concatenate([self.slopes, self.per_datum[None]]))
            out[:d, d:], out[d:, :d], out[d:, d:] = across[:d], across[:d].T, np.diag(across[d])
        return out if self.precision is None else out + self.precision


@dataclass(frozen=True, eq=False)
class RowChange:
    """Change of the rows of a group per unit of a non-linear parameter.

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
class ChangeTarget:
    """The derivative of the i-th of some groups by its j-th parameter: where it is computed, and where it belongs.

    `place` is the parameter in the layout, `at` (k,) are the coefficients of the rows, `inside` is the part among the
    data of the stack and `cut` the same among all data.
    """

    i: int
    j: int
    place: int
    at: Indices
    inside: slice
    cut: slice


@dataclass(frozen=True, eq=False)
class EvaluationPlan:
    """How n groups with the same columns are evaluated together along a stack of B blocks.

    Attributes
    ----------
    groups : tuple of int
        The groups.
    stack : BlockStack
        The blocks.
    places : array of shape (n, q, B)
        Positions of their q parameters in the layout, those common to the runs first; -1 where a block has fewer.
    present : tuple of array of int
        Parameter, block and position in the layout of all parameters of the first group.
    segments : list of list of Segment
        Where the rows of every group belong.
    targets : list of ChangeTarget
        Where the derivatives belong.

    """

    groups: tuple[int, ...]
    stack: BlockStack
    places: Indices
    present: tuple[Indices, Indices, Indices]
    segments: list[list[Segment]]
    targets: list[ChangeTarget]

    @cached_property
    def has_gaps(self) -> bool:
        """Whether a block has fewer parameters than another."""
        return bool((self.places < 0).any())

    @classmethod
    def of(cls, separable: SeparableModel, groups: tuple[int, ...], stack: BlockStack) -> EvaluationPlan:
        """Plan the evaluation of groups along a stack."""
        places = np.stack([_places(separable, g, stack) for g in groups])
        j, member = np.nonzero(places[0] >= 0)
        segments = [separable.segments(g, stack) for g in groups]
        targets = [
            target
            for i, (parts, own) in enumerate(zip(segments, places, strict=True))
            for part in parts
            for target in _targets(separable, stack, part, (i, own))
        ]
        return cls(groups, stack, places, (j, member, places[0][j, member]), segments, targets)


class RowEvaluator:
    """Evaluate the rows of groups and their derivatives: those with the same columns together, along all blocks.

    Parameters
    ----------
    separable : SeparableModel
        The model.
    min_step : array of shape (P,)
        Smallest finite-difference step of every parameter.

    """

    def __init__(self, separable: SeparableModel, min_step: Array) -> None:
        self.separable, self.min_step = separable, min_step
        self._batches = _batches(separable)
        self._plans: dict[tuple[int, ...], list[EvaluationPlan]] = {}
        self._levels = separable.layout.levels

    def __call__(
        self, groups: Collection[int], nonlinear_values: Array, rows: Array
    ) -> Iterator[tuple[int, RowChange]]:
        """Write the rows of some groups into (K, M), and yield parameters with their derivatives.

        A derivative by a common parameter covers all runs at once, the others come run by run.
        """
        for batch in self._batches:
            chosen = tuple(g for g in batch if g in groups)
            for plan in self._plans_of(chosen) if chosen else ():
                made, slopes = self._evaluated(plan, nonlinear_values)
                for own, parts in zip(made, plan.segments, strict=True):
                    for part in parts:
                        rows[part.at[part.kept], part.cut] = own[part.kept, part.inside]
                for one in plan.targets:
                    change = slopes[one.i, one.j, :, one.inside]
                    yield one.place, RowChange(plan.groups[one.i], one.at, one.cut, change)

    def _plans_of(self, groups: tuple[int, ...]) -> list[EvaluationPlan]:
        if groups not in self._plans:
            stacks = self.separable.stacks_of(groups[0])
            self._plans[groups] = [EvaluationPlan.of(self.separable, groups, stack) for stack in stacks]
        return self._plans[groups]

    def _evaluated(self, plan: EvaluationPlan, nonlinear_values: Array) -> tuple[Array, Array]:
        """Rows (n, k, m) of the groups, and their change per unit of each parameter, (n, q, k, m)."""
        (n, q, b), stack, places = plan.places.shape, plan.stack, plan.places
        own = nonlinear_values[places]
        steps = np.maximum(RELATIVE_STEP * np.abs(own), self.min_step[places])
        if plan.has_gaps:
            steps[places < 0] = 1.0
        shifted = np.repeat(own[:, None], 1 + q, axis=1)
        each = np.arange(q)
        shifted[:, 1 + each, each] += steps
        moved = np.empty((n, 1 + q, b, len(nonlinear_values)))
        moved[:] = nonlinear_values
        j, member, first = plan.present  # the other groups are evaluated in the places of the first one
        moved[:, :, member, first] = shifted[:, :, j, member]
        level = nonlinear_values[self._levels][list(stack.runs)] if self._levels else np.ones(b)
        made = self.separable.stacked_rows(plan.groups[0], stack, moved.reshape(n * (1 + q), b, -1), level)
        made = made.reshape(n, 1 + q, *made.shape[1:])
        slopes = made[:, 1:] - made[:, :1]
        slopes /= np.repeat(steps, stack.lengths, axis=2)[:, :, None] if b > 1 else steps[:, :, :, None]
        return made[:, 0], slopes


def _places(separable: SeparableModel, g: int, stack: BlockStack) -> Indices:
    """Non-linear parameters of a group in every block of a stack, (q, B), common ones first; -1 for fewer."""
    slots, mine = separable.layout.slots, separable.groups[g].nonlinear_slots
    common = [i for i in mine if slots[i].run is None]
    each = [common + [i for i in mine if slots[i].run == run] for run in stack.runs]
    longest = max(len(own) for own in each)
    padded = np.array([own + [-1] * (longest - len(own)) for own in each], dtype=int)
    return padded.reshape(len(each), longest).T


def _targets(
    separable: SeparableModel, stack: BlockStack, part: Segment, group: tuple[int, Indices]
) -> Iterator[ChangeTarget]:
    """Where the derivatives of one group, its index and places (q, B), belong within one part of a stack."""
    i, places = group
    for j, own in enumerate(places[:, list(part.members)]):
        if (own == own[0]).all():
            if own[0] >= 0:
                yield ChangeTarget(i, j, int(own[0]), part.at, part.inside, part.cut)
            continue
        for m, place in zip(part.members, own, strict=True):
            if place >= 0:
                cut = separable.slices[stack.members[m]]
                yield ChangeTarget(i, j, int(place), part.at, stack.slices[m], cut)


def _batches(separable: SeparableModel) -> list[tuple[int, ...]]:
    """Groups that are evaluated together: instances of one effect with the same fixed values and free parameters."""
    out: dict[tuple[object, ...], list[int]] = {}
    for g in range(len(separable.groups)):
        out.setdefault(_batch_key(separable, g), []).append(g)
    return [tuple(groups) for groups in out.values()]


def _batch_key(separable: SeparableModel, g: int) -> tuple[object, ...]:
    """What groups have in common that are evaluated together."""
    group, layout = separable.groups[g], separable.layout
    effect = group.model.effects[0]
    if layout.constraints or not group.nonlinear_slots or not separable.is_stackable(g) or len(group.names) > 1:
        return (g,)
    fixed = tuple(layout.fixed.get((effect.name, q.name)) for q in effect.nonlinear)
    free = tuple((layout.slots[i].parameter, layout.slots[i].run) for i in group.nonlinear_slots)
    return effect.columns, group.is_sinusoid, tuple(p.name for p in effect.linear), fixed, free
