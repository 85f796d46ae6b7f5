"""The separable model along the measured motion: rows per unit coefficient for given non-linear parameters.

Independent effects are evaluated alone, a modifier together with the effects that it modifies (`EffectGroup`). A
sinusoid of one amplitude and one phase enters as two quadratures, which are linear. If the phase belongs to the runs,
every run has its own pair, and their common amplitude is left to the refinement.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.effects import Effect, Path, Tie
from frictrack.fit.parameters import ParameterLayout, apply_constraints
from frictrack.fit.separable.blocks import DataBlock
from frictrack.models import Model
from frictrack.records import Array

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


@dataclass(eq=False)
class SeparableModel:
    """A layout over data blocks, evaluated for one model or for a population.

    Attributes
    ----------
    layout : ParameterLayout
        The unknowns.
    blocks : sequence of DataBlock
        The data.
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
    groups: list[EffectGroup] = field(init=False)
    coefficients: list[Coefficient] = field(init=False)
    column_positions: list[dict[int, Indices]] = field(init=False)
    free: list[int] = field(init=False)

    def __post_init__(self) -> None:
        self.blocks = list(self.blocks)
        self.runs = sorted({b.run for b in self.blocks})
        self.groups = [self._group(effects) for effects in _coupled_effects(self.layout.model)]
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
        self._tiled: dict[tuple[int, int, int], Path] = {}
        self._fixed_and_free_cache: dict[tuple[int, int], tuple[Values, list[tuple[int, str, str, bool]]]] = {}

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
        parts = list(self.parts(g, b, nonlinear_values, level))
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)

    def parts(self, g: int, b: int, nonlinear_values: Array, level: float = 1.0) -> Iterator[Array]:
        """Yield the same rows part by part: one quadrature of a sinusoid after the other."""
        group, block = self.groups[g], self.blocks[b]
        forward = block.picture if group.is_measurement else block.forward
        if not group.is_sinusoid:
            yield forward(self.unit_rows(g, b, nonlinear_values, level))
            return
        p = len(nonlinear_values) if group.nonlinear_slots else 1
        effect = group.model.effects[0]
        phase = next(q.name for q in effect.nonlinear if q.role == "phase")
        own, path = self._values(g, b, nonlinear_values[:p])[effect.name], self._path(g, b, p, level)
        for q in QUADRATURES:
            yield forward(_by_individual(effect.columns(path, own | {phase: q}), p))

    def unit_rows(self, g: int, b: int, nonlinear_values: Array, level: float = 1.0) -> Array:
        """Compute rows (Q, k, n) along block b per unit of every linear parameter, N or m; sinusoids at their phase."""
        group = self.groups[g]
        p = len(nonlinear_values) if group.nonlinear_slots or group.phase_slots else 1
        return _by_individual(group.columns(self._path(g, b, p, level), self._values(g, b, nonlinear_values[:p])), p)

    def _evaluation_path(self, g: int, b: int) -> Path:
        """Path on which a group is evaluated: effects without memory at the compared samples only."""
        block = self.blocks[b]
        return block.path if block.compared_path is None or self.groups[g].model.memory else block.compared_path

    def _path(self, g: int, b: int, p: int, level: float) -> Path:
        path = self._evaluation_path(g, b) if p == 1 else self.tiled_path(g, b, p)
        return path if level == 1.0 else replace(path, load=path.load * level)

    def _values(self, g: int, b: int, nonlinear_values: Array) -> Values:
        """Non-linear values of a group along one block: one number, or one per frame for a population."""
        n, run = len(self._evaluation_path(g, b).t), self.blocks[b].run
        if self.layout.constraints:
            return self._constrained_values(g, b, nonlinear_values)
        fixed, places = self._fixed_and_free(g, run)
        values = {name: own.copy() for name, own in fixed.items()}
        for i, effect, parameter, is_depth in places:
            values[effect][parameter] = repeat_values(nonlinear_values[:, i], n, is_depth)
        return values

    def _fixed_and_free(self, g: int, run: int) -> tuple[Values, list[tuple[int, str, str, bool]]]:
        """Fixed values of a group and positions of its free ones, for one run."""
        if (g, run) not in self._fixed_and_free_cache:
            group, layout = self.groups[g], self.layout
            fixed: Values = {e.name: {} for e in group.model.effects}
            for e in group.model.effects:
                for q in e.nonlinear:
                    fixed[e.name][q.name] = layout.fixed.get((e.name, q.name), 1.0)
            places = [
                (i, s.effect, s.parameter, _is_depth(group.model, s.effect, s.parameter))
                for i in (*group.nonlinear_slots, *group.phase_slots)
                if (s := layout.slots[i]).run in (None, run)
            ]
            self._fixed_and_free_cache[g, run] = fixed, places
        return self._fixed_and_free_cache[g, run]

    def _constrained_values(self, g: int, b: int, nonlinear_values: Array) -> Values:
        """The same where parameters are tied: all values first, then the constraints."""
        model, block = self.layout.model, self.blocks[b]
        all_values: Values = {e.name: {q.name: np.ones(1) for q in e.parameters} for e in model.effects}
        for (effect, name), value in self.layout.fixed.items():
            all_values[effect][name] = np.full(1, value)
        for i, s in enumerate(self.layout.slots):
            if s.effect in all_values and s.run in (None, block.run) and not s.linear:
                all_values[s.effect][s.parameter] = nonlinear_values[:, i]
        apply_constraints(model, tuple(r for r in self.layout.constraints if not r.parameter.linear), all_values)
        own_slots, n = self.groups[g].model, len(self._evaluation_path(g, b).t)
        return {
            e.name: {q.name: repeat_values(all_values[e.name][q.name], n, q.role == "depth") for q in e.nonlinear}
            for e in own_slots.effects
        }

    def tiled_path(self, g: int, b: int, p: int) -> Path:
        """Return one path through p individuals laid end to end, as a group is evaluated along a block."""
        path = self._evaluation_path(g, b)
        n = len(path.t)
        if (b, p, n) not in self._tiled:
            if len(self._tiled) > 2 * len(self.blocks):
                self._tiled.clear()
            repeated: dict[str, Any] = {
                name: np.tile(value, p)
                for name, value in vars(path).items()
                if isinstance(value, np.ndarray) and value.shape == (n,)
            }
            self._tiled[b, p, n] = replace(path, starts=tuple(range(0, n * p, n)), **repeated)
        return self._tiled[b, p, n]

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
            All unknowns. A sinusoid has its amplitude (the mean over runs where it is shared) and phases.

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
        return p


def repeat_values(each: Array, n: int, is_depth: bool = False) -> Any:
    """Repeat the values (Q,) of a population frame by frame, (Q n,); a single value stays a number.

    A depth multiplies whole columns (n, k), so it has shape (Q n, 1).
    """
    if len(each) == 1:
        return float(each[0])
    repeated = np.repeat(each, n)
    return repeated[:, None] if is_depth else repeated


def _by_individual(columns: Array, p: int) -> Array:
    """Columns (Q n, k) of individuals laid end to end as rows (Q, k, n)."""
    return columns.T.reshape(columns.shape[1], p, -1).transpose(1, 0, 2)


def _is_depth(model: Model, effect: str, parameter: str) -> bool:
    return next(e for e in model.effects if e.name == effect).parameter(parameter).role == "depth"


def _coupled_effects(model: Model) -> list[list[Effect]]:
    """Effects that are evaluated together: modifiers with all that they modify, the others alone."""
    kinds = {k for e in model.effects for k in e.modifies}
    joined = [e for e in model.effects if e.modifies or e.kind in kinds]
    out: list[list[Effect]] = [[e] for e in model.effects if e not in joined]
    return [joined, *out] if joined else out
