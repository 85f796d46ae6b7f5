"""The separable model along the measured motion: rows per unit coefficient for given non-linear parameters.

Independent effects are evaluated alone, a modifier together with the effects that it modifies (`EffectGroup`). A
sinusoid of one amplitude and one phase enters as two quadratures, which are linear. If the phase belongs to the runs,
every run has its own pair, and their common amplitude is left to the refinement.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.effects import Effect, Path, Tie, is_library
from frictrack.fit.parameters import LEVEL, ParameterLayout, apply_constraints, canonical_form
from frictrack.fit.separable.blocks import DataBlock
from frictrack.fit.separable.stacks import BlockStack
from frictrack.models import Model
from frictrack.records import Array, Mask

Indices = NDArray[np.int_]
Values = dict[str, dict[str, Any]]
QUADRATURES = (0.0, np.pi / 2)
NO_INDICES: Indices = np.zeros(0, dtype=int)


@dataclass(frozen=True)
class Coefficient:
    """One linear coefficient: a parameter of an effect, shared (run None) or of one run.

    Of a sinusoid it is one quadrature.
    """

    effect: str
    parameter: str
    run: int | None
    bounds: tuple[float, float]
    quadrature: int | None = None
    loaded: bool = False


@dataclass(frozen=True)
class EffectGroup:
    """Effects that are evaluated together.

    `nonlinear_slots` are the positions in the layout of the parameters that their columns depend on. The phases of a
    sinusoid (`phase_slots`) are separate, because its quadratures do not depend on them.
    """

    model: Model
    is_sinusoid: bool
    is_measurement: bool
    nonlinear_slots: tuple[int, ...]
    phase_slots: tuple[int, ...] = ()

    @property
    def names(self) -> list[str]:
        """Names of its effects."""
        return self.model.names

    def columns(self, path: Path, values: Values) -> Array:
        """Compute all columns of the group, (n, k)."""
        if len(self.model.effects) == 1:
            effect = self.model.effects[0]
            return effect.columns(path, values[effect.name])
        return np.concatenate(list(self.model.force_columns(path, values).values()), axis=1)


@dataclass(frozen=True, eq=False)
class Segment:
    """A part of a stack with one set of coefficients.

    `at` (k,) are the coefficients of the columns, -1 for none; `inside` is the part among the data of the stack, `cut`
    the same among all data, `members` its blocks.
    """

    at: Indices
    inside: slice
    cut: slice
    members: tuple[int, ...]

    @cached_property
    def kept(self) -> Indices:
        """Which of the columns have a coefficient."""
        return np.flatnonzero(self.at >= 0)


def coupled_effects(model: Model) -> list[list[Effect]]:
    """Effects that are evaluated together: modifiers with all that they modify, the others alone."""
    kinds = {k for e in model.effects for k in e.modifies}
    joined = [e for e in model.effects if e.modifies or e.kind in kinds]
    out: list[list[Effect]] = [[e] for e in model.effects if e not in joined]
    return [joined, *out] if joined else out


@dataclass(eq=False)
class SeparableModel:
    """A layout over data blocks, evaluated for one model or for a population.

    Attributes
    ----------
    layout : ParameterLayout
        The unknowns.
    blocks : sequence of DataBlock
        The data.
    stacks : sequence of BlockStack
        The same blocks, those together that can be; default each alone.
    groups : list of EffectGroup
        Effects that are evaluated together.
    coefficients : list of Coefficient
        The K linear coefficients.
    column_positions : list of dict
        For every group and run, the coefficient of each column; -1 for none.
    free : list of int
        Positions of the searched non-linear parameters: all but levels and the phases of sinusoids.

    """

    layout: ParameterLayout
    blocks: Sequence[DataBlock]
    stacks: Sequence[BlockStack] = ()
    groups: list[EffectGroup] = field(init=False)
    coefficients: list[Coefficient] = field(init=False)
    column_positions: list[dict[int, Indices]] = field(init=False)
    free: list[int] = field(init=False)

    def __post_init__(self) -> None:
        self.blocks = list(self.blocks)
        self.runs = sorted({b.run for b in self.blocks})
        self.groups = [self._group(effects) for effects in coupled_effects(self.layout.model)]
        self.coefficients = []
        self.column_positions = [self._column_positions(group) for group in self.groups]
        self.free = sorted({i for g in self.groups for i in g.nonlinear_slots})
        self.low, self.high = np.array([c.bounds for c in self.coefficients]).reshape(-1, 2).T
        edges = np.cumsum([0, *[len(b.data) for b in self.blocks]])
        self.slices = [slice(int(a), int(b)) for a, b in pairwise(edges)]
        self.size = int(edges[-1])
        self.data = np.concatenate([b.data for b in self.blocks])
        self._mine = [
            np.unique([i for at in column_positions.values() for i in at if i >= 0])
            for column_positions in self.column_positions
        ]
        self.run_of_datum = np.repeat([b.run for b in self.blocks], [len(b.data) for b in self.blocks])
        self._single_blocks = [BlockStack.of_block(i, b) for i, b in enumerate(self.blocks)]
        self._places_cache: dict[tuple[int, tuple[int, ...]], list[tuple[str, str, int, list[int]]]] = {}

    # --- positions of parameters

    def _group(self, effects: list[Effect]) -> EffectGroup:
        """The group of some effects, with the positions of its non-linear parameters."""
        is_sinusoid = len(effects) == 1 and self.is_sinusoid(effects[0])
        phases = {(e.name, q.name) for e in effects for q in e.nonlinear if is_sinusoid and q.role == "phase"}
        wanted = {(e.name, q.name) for e in effects for q in e.nonlinear} - phases
        wanted |= set(self._leaders(wanted))
        slots = self._positions(wanted), self._positions(phases)
        return EffectGroup(Model(tuple(effects)), is_sinusoid, effects[0].acts_on == "measurement", *slots)

    def _positions(self, wanted: set[tuple[str, str]]) -> tuple[int, ...]:
        """Positions of the wanted (effect, parameter) pairs in the layout."""
        slots = enumerate(self.layout.slots)
        return tuple(i for i, s in slots if (s.effect, s.parameter) in wanted and s.run in (None, *self.runs))

    def _leaders(self, followers: set[tuple[str, str]]) -> Iterable[tuple[str, str]]:
        """Parameters that others are tied to, directly or through further ties."""
        for constraint in self.layout.constraints:
            if (constraint.effect.name, constraint.parameter.name) in followers and isinstance(constraint.value, Tie):
                leader = constraint.value.effect, constraint.value.parameter
                yield leader
                yield from self._leaders({leader})

    def is_sinusoid(self, effect: Effect) -> bool:
        """Return whether an effect is a free amplitude times a sine of a free phase, so that quadratures are linear."""
        sizes = [p for p in effect.linear if p.role == "amplitude"]
        phases = [p for p in effect.nonlinear if p.role == "phase"]
        if effect.modifies or len(effect.linear) != 1 or len(sizes) != 1 or len(phases) != 1:
            return False
        own_slots = [
            i
            for i, s in enumerate(self.layout.slots)
            if s.effect == effect.name and s.parameter in (sizes[0].name, phases[0].name)
        ]
        free = {self.layout.slots[i].parameter for i in own_slots} == {sizes[0].name, phases[0].name}
        return free and not self.layout.leaders & set(own_slots)

    def _column_positions(self, group: EffectGroup) -> dict[int, Indices]:
        """Create the coefficients of a group, and return which of them its columns are in every run."""
        column_positions: dict[int, list[int]] = {run: [] for run in self.runs}
        for effect in group.model.effects:
            for p in effect.linear:
                own = p.per_run or (group.is_sinusoid and any(q.per_run for q in effect.nonlinear if q.role == "phase"))
                present_runs = (
                    [r for r in self.runs if (effect.name, r) not in self.layout.absent] if own else self.runs
                )
                for quadrature in (0, 1) if group.is_sinusoid else (None,):
                    first = len(self.coefficients)
                    bounds = (-np.inf, np.inf) if group.is_sinusoid else self._bounds(effect.name, p.name)
                    self.coefficients += [
                        Coefficient(effect.name, p.name, r, bounds, quadrature, p.loaded)
                        for r in (present_runs if own else [None])
                    ]
                    for run in self.runs:
                        column_positions[run].append(
                            (first + present_runs.index(run) if own else first) if run in present_runs else -1
                        )
        return {run: np.array(at, dtype=int) for run, at in column_positions.items()}

    def _bounds(self, effect: str, parameter: str) -> tuple[float, float]:
        fixed = self.layout.fixed.get((effect, parameter))
        if fixed is not None:
            return fixed, fixed
        slots = (s for s in self.layout.slots if (s.effect, s.parameter) == (effect, parameter))
        return next((s.bounds for s in slots), (-np.inf, np.inf))

    def position(self, effect: str, parameter: str, run: int | None = None) -> int | None:
        """Return the position in the layout of a parameter in one run; None if it is fixed, tied or absent."""
        for i, s in enumerate(self.layout.slots):
            if (s.effect, s.parameter) == (effect, parameter) and (run is None or s.run in (None, run)):
                return i
        return None

    def coefficients_of(self, g: int) -> Indices:
        """Return the coefficients of a group."""
        return self._mine[g]

    # --- evaluation

    def is_stackable(self, g: int) -> bool:
        """Return whether a group consists of effects of the library that do not depend on the motion before."""
        effects = self.groups[g].model.effects
        return all(is_library(e.kind) and not e.memory and not e.counts_from_release for e in effects)

    def stacks_of(self, g: int) -> Sequence[BlockStack]:
        """Return the blocks as one group is evaluated along them; if it cannot be stacked, each alone."""
        return self.stacks if self.stacks and self.is_stackable(g) else self._single_blocks

    def segments(self, g: int, stack: BlockStack) -> list[Segment]:
        """Return the parts of a stack in which the columns of a group belong to the same coefficients."""
        at = [self.column_positions[g][run] for run in stack.runs]
        cuts = [self.slices[b] for b in stack.members]
        if all(np.array_equal(at[0], other) for other in at):
            whole = slice(cuts[0].start, cuts[-1].stop)
            return [Segment(at[0], slice(0, sum(stack.lengths)), whole, tuple(range(len(at))))]
        parts = zip(at, stack.slices, cuts, range(len(at)), strict=True)
        return [Segment(own, inside, cut, (m,)) for own, inside, cut, m in parts]

    def rows(self, g: int, b: int, nonlinear_values: Array, level: float = 1.0) -> Array:
        """Compute the forwarded rows of one group in one block.

        Parameters
        ----------
        g, b : int
            Index of the group and of the block.
        nonlinear_values : array of shape (Q, P)
            Parameter vectors of Q individuals; only non-linear values are used.
        level : float
            Friction level of the run.

        Returns
        -------
        array of shape (Q, k, m)
            Data per unit coefficient, in standard deviations.

        """
        return self._rows_at_once(g, self._single_blocks[b], nonlinear_values[:, None], level)

    def stacked_rows(self, g: int, stack: BlockStack, nonlinear_values: Array, levels: Array) -> Array:
        """Compute the forwarded rows of one group in all blocks of a stack.

        Parameters
        ----------
        g : int
            Index of the group.
        stack : BlockStack
            B blocks.
        nonlinear_values : array of shape (Q, B, P)
            Parameter vectors of Q individuals in every block.
        levels : array of shape (B,)
            Friction levels in the blocks.

        Returns
        -------
        array of shape (Q, k, m)
            Data per unit coefficient, in standard deviations.

        """
        if len(levels) == 1:
            return self._rows_at_once(g, stack, nonlinear_values, float(levels[0]))
        rows = self._rows_at_once(g, stack, nonlinear_values, 1.0)
        loaded, scale = self._loaded_columns(g), levels * stack.loads
        if loaded.any() and np.any(scale != 1.0):
            rows *= np.where(loaded[:, None], np.repeat(scale, stack.lengths), 1.0)
        return rows

    def _loaded_columns(self, g: int) -> Mask:
        """Which columns of a group carry the normal load of the run."""
        columns = [p.loaded for e in self.groups[g].model.effects for p in e.linear]
        return np.array(columns * (2 if self.groups[g].is_sinusoid else 1), dtype=bool)

    def _rows_at_once(self, g: int, stack: BlockStack, nonlinear_values: Array, level: float) -> Array:
        """Rows (Q, k, m) of a group along a stack, those of a sinusoid at both quadratures."""
        group = self.groups[g]
        p = len(nonlinear_values) if group.nonlinear_slots else 1
        forward = stack.picture if group.is_measurement else stack.forward
        if not group.is_sinusoid:
            columns = group.columns(self._path(g, stack, p, level), self._values(g, stack, nonlinear_values[:p]))
            return forward(columns.T.reshape(columns.shape[1], p, -1).transpose(1, 0, 2))
        effect, path = group.model.effects[0], self._path(g, stack, 2 * p, level)
        own = self._values(g, stack, nonlinear_values[:p].repeat(2, axis=0))[effect.name]
        phase = next(q.name for q in effect.nonlinear if q.role == "phase")
        own[phase] = np.tile(np.repeat(QUADRATURES, len(path.t) // (2 * p)), p)
        return forward(effect.columns(path, own).reshape(p, 2, -1))

    def _path(self, g: int, stack: BlockStack, p: int, level: float) -> Path:
        path = stack.population_path(self.groups[g].model.memory, p)
        return path if level == 1.0 else replace(path, load=path.load * level)

    def _values(self, g: int, stack: BlockStack, nonlinear_values: Array) -> Values:
        """Non-linear values of a group along a stack: one number, or one per sample where they differ."""
        layout, model, shape = self.layout, self.groups[g].model, nonlinear_values.shape[:2]
        known = layout.model if layout.constraints else model  # ties may lead to any effect
        values: Values = {
            e.name: {q.name: layout.fixed.get((e.name, q.name), 1.0) for q in e.parameters} for e in known.effects
        }
        for effect, name, i, members in self._places(g, stack.runs):
            if not isinstance(values[effect][name], np.ndarray):
                values[effect][name] = np.ones(shape)
            values[effect][name][:, members] = nonlinear_values[:, members, i]
        apply_constraints(known, tuple(r for r in layout.constraints if not r.parameter.linear), values)
        samples = len(stack.evaluation_path(model.memory).t)
        return {
            e.name: {
                q.name: value
                if isinstance(value := values[e.name][q.name], float)
                else stack.repeat_values(np.broadcast_to(value, shape), samples, q.role == "depth")
                for q in e.nonlinear
            }
            for e in model.effects
        }

    def _places(self, g: int, runs: tuple[int, ...]) -> list[tuple[str, str, int, list[int]]]:
        """Effect, parameter, position and members of the values that a group depends on, for blocks of some runs."""
        if (g, runs) not in self._places_cache:
            slots = [(i, s) for i, s in enumerate(self.layout.slots) if not s.linear and s.effect != LEVEL]
            if not self.layout.constraints:
                mine = {*self.groups[g].nonlinear_slots, *self.groups[g].phase_slots}
                slots = [(i, s) for i, s in slots if i in mine]
            each = [(s, i, [m for m, run in enumerate(runs) if s.run in (None, run)]) for i, s in slots]
            self._places_cache[g, runs] = [(s.effect, s.parameter, i, members) for s, i, members in each if members]
        return self._places_cache[g, runs]

    # --- conversion to the unknowns of the layout

    def law(self, nonlinear_values: Array, coefficients: Array) -> Array:
        """Convert a separable solution to the unknowns of the layout.

        Parameters
        ----------
        nonlinear_values : array of shape (P,)
            Parameter vector with the non-linear values.
        coefficients : array of shape (K,)
            Linear coefficients.

        Returns
        -------
        array of shape (P,)
            All unknowns, phases within their bounds. A sinusoid has its amplitude (the mean over runs where it is
            shared) and phases.

        """
        p = np.array(nonlinear_values, dtype=float)
        estimates_by_slot: dict[int, list[float]] = {}
        pairs: dict[tuple[str, int | None], list[float]] = {}
        for c, value in zip(self.coefficients, coefficients, strict=True):
            if c.quadrature is not None:
                pairs.setdefault((c.effect, c.run), []).append(float(value))
            elif (i := self.position(c.effect, c.parameter, c.run)) is not None:
                estimates_by_slot.setdefault(i, []).append(float(value))
        for (effect, run), (a, b) in pairs.items():
            names: dict[str, str] = {
                q.role: q.name for e in self.layout.model.effects if e.name == effect for q in e.parameters
            }
            for role, value in (("amplitude", np.hypot(a, b)), ("phase", np.arctan2(b, a))):
                if (i := self.position(effect, names[role], run)) is not None:
                    estimates_by_slot.setdefault(i, []).append(float(value))
        for i, each in estimates_by_slot.items():
            p[i] = np.mean(each)
        return canonical_form(self.layout, p)
