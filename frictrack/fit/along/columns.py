"""A model along the measured motion: rows that its coefficients multiply, as functions of the non-linear numbers.

Effects that act by themselves are evaluated by themselves, a modifier together with what it modifies (a `Group`). A
wave of one amplitude and one phase enters as its two quadratures, which are linear; where the phase belongs to the
runs, every run has its own pair, and the amplitude they share is left to the refinement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictrack.effects import Effect, Path
from frictrack.fit.along.blocks import Block
from frictrack.fit.layout import Layout
from frictrack.models import Model
from frictrack.records import Array

Indices = NDArray[np.int_]
QUADRATURES = (0.0, np.pi / 2)


@dataclass(frozen=True)
class Coefficient:
    """One linear number: a parameter of an effect, shared (run None) or of one run; of a wave one quadrature."""

    effect: str
    parameter: str
    run: int | None
    bounds: tuple[float, float]
    quadrature: int | None = None
    loaded: bool = False


@dataclass(frozen=True)
class Group:
    """Effects that are evaluated together; `numbers` are positions in the layout of what their columns depend on."""

    model: Model
    wave: bool
    pictured: bool
    numbers: tuple[int, ...]
    columns: int  # of one run
    deep: frozenset[tuple[str, str]]  # parameters that multiply whole columns

    @property
    def names(self) -> list[str]:
        """Its effects."""
        return self.model.names


@dataclass(eq=False)
class Along:
    """A layout over blocks, ready to be evaluated for one law or a population.

    `free` are the positions in the layout of the non-linear numbers that are searched: all but levels and the phases
    of waves. `coefficients` are the linear ones, K in all; `place[g][run]` (columns,) tells which of them the columns
    of group g are in that run, -1 for none.
    """

    layout: Layout
    blocks: Sequence[Block]
    groups: list[Group] = field(init=False)
    coefficients: list[Coefficient] = field(init=False)
    place: list[dict[int, Indices]] = field(init=False)
    free: list[int] = field(init=False)

    def __post_init__(self) -> None:
        self.blocks = list(self.blocks)
        self.runs = sorted({b.run for b in self.blocks})
        self.groups = [self._group(effects) for effects in _clusters(self.layout.model)]
        self.coefficients, self.place = [], []
        for group in self.groups:
            self.place.append(self._placed(group))
        self.free = sorted({i for g in self.groups for i in g.numbers})
        self.low, self.high = np.array([c.bounds for c in self.coefficients]).reshape(-1, 2).T
        edges = np.cumsum([0, *[len(b.data) for b in self.blocks]])
        self.slices = [slice(int(a), int(b)) for a, b in pairwise(edges)]
        self.size = int(edges[-1])
        self.data = np.concatenate([b.data for b in self.blocks])
        self._tiled: dict[tuple[int, int], Path] = {}

    # --- where numbers stand

    def _group(self, effects: list[Effect]) -> Group:
        names = {e.name for e in effects}
        wave = len(effects) == 1 and is_wave(effects[0])
        numbers = tuple(
            i
            for i, s in enumerate(self.layout.slots)
            if s.effect in names
            and not s.linear
            and s.run in (None, *self.runs)
            and not (wave and effects[0].parameter(s.parameter).role == "phase")
        )
        deep = frozenset((e.name, p.name) for e in effects for p in e.parameters if p.role == "depth")
        count = sum(len(e.linear) for e in effects) * (2 if wave else 1)
        return Group(Model(tuple(effects)), wave, effects[0].acts_on == "measurement", numbers, count, deep)

    def _placed(self, group: Group) -> dict[int, Indices]:
        place: dict[int, list[int]] = {run: [] for run in self.runs}
        for effect in group.model.effects:
            for p in effect.linear:
                own = p.per_run or (group.wave and any(q.per_run for q in effect.nonlinear if q.role == "phase"))
                bounds = self._bounds(effect.name, p.name)
                for quadrature in (0, 1) if group.wave else (None,):
                    limits = (-np.inf, np.inf) if quadrature is not None else bounds
                    shown = [r for r in self.runs if (effect.name, r) not in self.layout.absent] if own else self.runs
                    first = len(self.coefficients)
                    self.coefficients += [
                        Coefficient(effect.name, p.name, r, limits, quadrature, p.loaded)
                        for r in (shown if own else [None])
                    ]
                    for run in self.runs:
                        at = first + shown.index(run) if own and run in shown else (-1 if own else first)
                        place[run].append(at)
        return {run: np.array(at, dtype=int) for run, at in place.items()}

    def _bounds(self, effect: str, parameter: str) -> tuple[float, float]:
        fixed = self.layout.fixed.get((effect, parameter))
        if fixed is not None:
            return fixed, fixed
        return next(s.bounds for s in self.layout.slots if (s.effect, s.parameter) == (effect, parameter))

    def position(self, effect: str, parameter: str, run: int) -> int | None:
        """Position in the layout of a parameter in one run; None where it has none (fixed or absent)."""
        for i, s in enumerate(self.layout.slots):
            if s.effect == effect and s.parameter == parameter and s.run in (None, run):
                return i
        return None

    # --- evaluation

    def rows(self, g: int, b: int, numbers: Array | None, level: float = 1.0) -> Array:
        """Forwarded rows (P, columns, m) of group g in block b; `numbers` (P, P_layout) or None for a group without."""
        block, group = self.blocks[b], self.groups[g]
        force = self.forces(g, b, numbers, level)
        return (block.picture if group.pictured else block.forward)(force)

    def forces(self, g: int, b: int, numbers: Array | None, level: float = 1.0) -> Array:
        """Rows (P, columns, n) of group g along block b: N (or m) per unit of every coefficient."""
        group, block = self.groups[g], self.blocks[b]
        p = 1 if numbers is None or not group.numbers else len(numbers)
        turns = [{"phase": q} for q in QUADRATURES] if group.wave else [{}]
        made = [self._evaluated(group, b, numbers, p, (turn, level)) for turn in turns]
        return np.concatenate(made, axis=1).reshape(p, -1, len(block.path.t))

    def _evaluated(
        self, group: Group, b: int, numbers: Array | None, p: int, how: tuple[dict[str, float], float]
    ) -> Array:
        turn, level = how
        block = self.blocks[b]
        n = len(block.path.t)
        path = block.path if p == 1 else self._end_to_end(b, p)
        if level != 1.0:
            path = replace(path, load=path.load * level)
        values = self._values(group, block.run, numbers, p, n)
        if group.wave:
            effect = group.model.effects[0]
            phase = next(q.name for q in effect.nonlinear if q.role == "phase")
            values[effect.name][phase] = turn["phase"]
        make = group.model.measurement_columns if group.pictured else group.model.force_columns
        columns = np.concatenate(list(make(path, values).values()), axis=1)
        out: Array = columns.T.reshape(columns.shape[1], p, n).transpose(1, 0, 2)
        return out

    def _values(self, group: Group, run: int, numbers: Array | None, p: int, n: int) -> dict[str, dict[str, Any]]:
        values: dict[str, dict[str, Any]] = {name: {} for name in group.names}
        for e in group.model.effects:
            for q in e.nonlinear:
                if (e.name, q.name) in self.layout.fixed:
                    values[e.name][q.name] = self.layout.fixed[e.name, q.name]
                elif (e.name, run) in self.layout.absent:
                    values[e.name][q.name] = 1.0
        for i in group.numbers:
            slot = self.layout.slots[i]
            if slot.run not in (None, run):
                continue
            assert numbers is not None
            if p == 1:
                values[slot.effect][slot.parameter] = float(numbers[0, i])
            else:
                each = np.repeat(numbers[:, i], n)
                deep = (slot.effect, slot.parameter) in group.deep  # a depth multiplies whole columns (n, k)
                values[slot.effect][slot.parameter] = each[:, None] if deep else each
        return values

    def _end_to_end(self, b: int, p: int) -> Path:
        """One path through p individuals laid end to end."""
        if (b, p) not in self._tiled:
            if len(self._tiled) > 8:
                self._tiled.clear()
            path = self.blocks[b].path
            n = len(path.t)
            long: dict[str, Any] = {
                name: np.tile(value, p)
                for name, value in vars(path).items()
                if isinstance(value, np.ndarray) and value.shape[:1] == (n,)
            }
            self._tiled[b, p] = replace(path, starts=tuple(range(0, n * p, n)), **long)
        return self._tiled[b, p]

    def law(self, numbers: Array, coefficients: Array) -> Array:
        """All unknowns (P,) of the layout: of a wave amplitude and phases, its amplitude shared as their mean."""
        p = np.array(numbers, dtype=float)
        sizes: dict[int, list[float]] = {}
        pairs: dict[tuple[str, int | None], list[float]] = {}
        for c, value in zip(self.coefficients, coefficients, strict=True):
            if c.quadrature is not None:
                pairs.setdefault((c.effect, c.run), []).append(float(value))
                continue
            i = self._slot(c.effect, c.parameter, c.run)
            if i is not None:
                p[i] = value
        for (effect, run), pair in pairs.items():
            for role, value in (("amplitude", np.hypot(pair[0], pair[1])), ("phase", np.arctan2(pair[1], pair[0]))):
                name = next(
                    q.name
                    for e in self.layout.model.effects
                    if e.name == effect
                    for q in e.parameters
                    if q.role == role
                )
                i = self._slot(effect, name, run)
                if i is not None:
                    sizes.setdefault(i, []).append(float(value))
        for i, each in sizes.items():
            p[i] = np.mean(each)
        return p

    def _slot(self, effect: str, parameter: str, run: int | None) -> int | None:
        return next(
            (
                i
                for i, s in enumerate(self.layout.slots)
                if (s.effect, s.parameter) == (effect, parameter) and (run is None or s.run in (None, run))
            ),
            None,
        )

    def design(
        self, numbers: Array, levels: Array | None = None, known: Array | None = None, only: set[int] | None = None
    ) -> Array:
        """All rows (K, M) of one law, numbers (P_layout,); of `known` those groups not in `only` are taken over."""
        out = np.zeros((len(self.coefficients), self.size)) if known is None else known.copy()
        for g in range(len(self.groups)) if only is None else only:
            for b, block in enumerate(self.blocks):
                level = 1.0 if levels is None else float(levels[block.run])
                at = self.place[g][block.run]
                kept = at >= 0
                out[at[kept], self.slices[b]] = self.rows(g, b, numbers[None], level)[0][kept]
        return out


def is_wave(effect: Effect) -> bool:
    """Whether an effect is one amplitude times a sine of one free phase, so that its quadratures are linear."""
    phases = [p for p in effect.nonlinear if p.role == "phase" and p.fixed is None]
    free = len(effect.linear) == 1 and effect.linear[0].role == "amplitude" and effect.linear[0].fixed is None
    return free and len(phases) == 1 and not effect.modifies


def _clusters(model: Model) -> list[list[Effect]]:
    """Effects that are evaluated together, in the order of the model: modifiers with all that they modify."""
    kinds = {k for e in model.effects for k in e.modifies}
    joined = [e for e in model.effects if e.modifies or e.kind in kinds]
    out: list[list[Effect]] = [[e] for e in model.effects if e not in joined]
    return [joined, *out] if joined else out
