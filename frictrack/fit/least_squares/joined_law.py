"""A model along pieces that are laid end to end: its acceleration, and the sensitivities of that to the unknowns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from frictrack.effects import Path
from frictrack.fit.parameters import LEVEL, ParameterLayout
from frictrack.fit.pieces import JoinedPieces
from frictrack.models import Model, Values
from frictrack.records import Array
from frictrack.simulate.dynamics import CollocationSolution

PATH_SERIES = ("t", "x", "v", "s", "drive", "lift", "angle")  # arrays of a path with one value per node


@dataclass(frozen=True)
class UnknownGroup:
    """One parameter of an effect: a shared unknown, or the unknowns of all runs that have their own.

    Attributes
    ----------
    effect, parameter : str
        Names.
    linear : bool
        Whether it is a coefficient that no other parameter follows.
    leads : bool
        Whether other parameters follow it.
    slots : dict
        Run (None for all) to the position of the unknown.
    part : Model or None
        The part of the model whose force it changes; None if it changes none.

    """

    effect: str
    parameter: str
    linear: bool
    leads: bool
    slots: Mapping[int | None, int]
    part: Model | None

    def slot_in(self, run: int) -> int | None:
        """Return the position of the unknown of one run; None if that run has none."""
        return self.slots.get(None, self.slots.get(run))


@dataclass(frozen=True)
class LawStructure:
    """Which parts of a model depend on what.

    Attributes
    ----------
    groups : tuple of UnknownGroup
        The K groups of unknowns.
    by_x, by_v : Model or None
        The parts whose force depends on position, and on velocity.
    moving, fixed : Model or None
        The parts whose force depends on either, and on neither.

    """

    groups: tuple[UnknownGroup, ...]
    by_x: Model | None
    by_v: Model | None
    moving: Model | None
    fixed: Model | None

    @classmethod
    def of(cls, layout: ParameterLayout, *, together: bool) -> LawStructure:
        """The structure of the model of a layout; `together` keeps it in one part that depends on everything."""
        model = layout.model
        if together:
            return cls(_group_unknowns(layout, together=True), model, model, model, None)
        by_x, by_v = (
            model.interacting(e.name for e in model.effects if e.varies_with is None or q in e.varies_with)
            for q in ("x", "v")
        )
        moving = {e.name for part in (by_x, by_v) if part for e in part.effects}
        rest = model.interacting(e.name for e in model.effects if e.name not in moving)
        return cls(_group_unknowns(layout, together=False), by_x, by_v, model.interacting(moving), rest)


def _group_unknowns(layout: ParameterLayout, *, together: bool) -> tuple[UnknownGroup, ...]:
    """The unknowns of a layout by parameter, in the order of their first position."""
    slots: dict[tuple[str, str], dict[int | None, int]] = {}
    for i, s in enumerate(layout.slots):
        slots.setdefault((s.effect, s.parameter), {})[s.run] = i
    model, groups = layout.model, []
    for (effect, parameter), own in slots.items():
        leads, linear = any(i in layout.leaders for i in own.values()), layout.slots[next(iter(own.values()))].linear
        if leads or together:
            part: Model | None = model
        elif effect == LEVEL:
            part = model.interacting(
                e.name for e in model.effects if e.varies_with is None or any(q.loaded for q in e.parameters)
            )
        else:
            part = model.interacting([effect])
        groups.append(UnknownGroup(effect, parameter, linear and not leads, leads, own, part))
    return tuple(groups)


@dataclass(frozen=True, eq=False)
class JoinedLaw:
    """A model with given unknowns along joined pieces.

    Attributes
    ----------
    layout : ParameterLayout
        Map of the parameter vector.
    structure : LawStructure
        Which parts of the model depend on what.
    joined : JoinedPieces
        The pieces; a single one if the model has memory.
    p : array of shape (P,)
        The unknowns.
    remembers : bool
        Whether the force depends on the motion since the start of the piece.
    so_far : Path, optional
        The motion that the law continues, up to the last of its nodes; by default it begins at the start of the piece.

    """

    layout: ParameterLayout
    structure: LawStructure
    joined: JoinedPieces
    p: Array
    remembers: bool
    so_far: Path | None = None

    @property
    def model(self) -> Model:
        """The model."""
        return self.layout.model

    @cached_property
    def _inputs(self) -> tuple[Values, list[float]]:
        """Values of the parameters at the nodes, and the friction level of every piece."""
        return self._inputs_at(self.p)

    def _inputs_at(self, p: Array) -> tuple[Values, list[float]]:
        """The same for other unknowns p (P,)."""
        runs = [piece.run for piece in self.joined.pieces]
        of_run = {run: self.layout.values(p, run) for run in set(runs)}
        first = of_run[runs[0]][0]
        values = {
            e.name: {
                name: self._spread(e.name, name, [of_run[run][0][e.name][name] for run in runs])
                for name in first[e.name]
            }
            for e in self.model.effects
        }
        return values, [of_run[run][1] for run in runs]

    def _spread(self, effect: str, parameter: str, values: Sequence[float]) -> Any:
        """Values of every piece as effects take them: a number, an array (3 p,), or a column for a depth."""
        spread = self.joined.spread(values)
        if not isinstance(spread, np.ndarray):
            return spread
        of = next(e for e in self.model.effects if e.name == effect)
        return spread[:, None] if of.parameter(parameter).role == "depth" else spread

    def acceleration(self, x: Array, v: Array, t: Array) -> Array:
        """Return the acceleration for a motion at the nodes; a model with memory takes the start in front of them."""
        values, levels = self._inputs
        if not self.remembers:
            return self._fixed - self._force(self.structure.moving, x, v) / self.joined.mass
        piece, force = self.joined.pieces[0], self.model.force(self._path(x, v, t, values, levels), values)
        return np.asarray(piece.known[piece.rows_after(self._first, len(t))] - force / piece.mass)

    def after(self, x: Array, v: Array, t: Array) -> JoinedLaw:
        """Return the law of what follows a motion (n,), from its last node on; its memory need not be read again."""
        values, levels = self._inputs
        path = self._path(x, v, t, values, levels)
        motion = np.stack([t, x, v])[:, :-1]
        before = motion if path.before is None else np.concatenate([path.before, motion], axis=1)
        return replace(self, so_far=replace(path, before=before, states=self.model.states(path, values)))

    @property
    def _first(self) -> int:
        """How many nodes of the piece the motion has passed that the law continues."""
        if self.so_far is None:
            return 0
        return int(np.searchsorted(self.joined.panels.t, self.so_far.t[-1], side="right"))

    def slopes(self, x: Array, v: Array, ex: Array, ev: Array) -> tuple[Array, Array, Array]:
        """Return the acceleration (3 p,) of a model without memory, and its derivatives by x and v.

        The derivatives are differences with steps ex and ev at every node; only the part of the model that depends on
        the one that is stepped is evaluated again.
        """
        values, parts = self._inputs[0], self.structure
        columns = {} if parts.moving is None else parts.moving.force_columns(self._joined_path(x, v), values)
        forces = [_sum_of(part, columns, values, len(x)) for part in (parts.moving, parts.by_x, parts.by_v)]
        by_x = (forces[1] - self._force(parts.by_x, x + ex, v)) / (ex * self.joined.mass)
        by_v = (forces[2] - self._force(parts.by_v, x, v + ev)) / (ev * self.joined.mass)
        return self._fixed - forces[0] / self.joined.mass, by_x, by_v

    @cached_property
    def _fixed(self) -> Array:
        """The part of the acceleration (3 p,) that is the same for every motion."""
        still = np.zeros(len(self.joined.known))
        return np.asarray(self.joined.known - self._force(self.structure.fixed, still, still) / self.joined.mass)

    def _force(self, part: Model | None, x: Array, v: Array) -> Array:
        """Force (3 p,) of a part of the model without memory."""
        return np.zeros(len(x)) if part is None else part.force(self._joined_path(x, v), self._inputs[0])

    def _joined_path(self, x: Array, v: Array) -> Path:
        return self.joined.path_at_nodes(x, v, self._inputs[1])

    def _path(self, x: Array, v: Array, t: Array, values: Values, levels: Sequence[float]) -> Path:
        """The path of a motion; a model with memory begins it with its states at the start."""
        if not self.remembers:
            return self.joined.path_at_nodes(x, v, levels)
        path = self.joined.pieces[0].path_since_start(x, v, t, levels[0], self._first)
        if self.so_far is not None:
            return replace(path, before=self.so_far.before, states=self.so_far.states)
        states = self._states if values is self._inputs[0] else self._initial_states(values)
        return replace(path, states=states)

    @cached_property
    def _states(self) -> dict[str, Array]:
        """The states at the start; computed once for all motions through the piece."""
        return self._initial_states(self._inputs[0])

    def _initial_states(self, values: Values) -> dict[str, Array]:
        """States of effects with memory after the motion before the piece."""
        piece = self.joined.pieces[0]
        path = piece.path
        if path.before is None or path.before.shape[1] < 2 or path.s[0] == 0:
            return {}
        two = {name: getattr(path, name)[[0, 0]] for name in PATH_SERIES if getattr(path, name) is not None}
        states = self.model.states(replace(path, **two), values)
        return {e.name: states[e.name] for e in self.model.effects if e.turns}

    def sensitivities(self, motion: CollocationSolution) -> Array:
        """Compute the change of the acceleration at the nodes per unit of the unknown of every group, (K, 3 p)."""
        x, v, t = motion.x, motion.v, motion.panels.t
        if self.remembers:
            start = motion.x_edge[0], motion.v_edge[0], motion.panels.edges[0]
            x, v, t = (np.append(first, rest) for first, rest in zip(start, (x, v, t), strict=True))
        values, levels = self._inputs
        columns = self.model.force_columns(self._path(x, v, t, values, levels), values)
        out = np.zeros((len(self.structure.groups), len(x)))
        for j, group in enumerate(self.structure.groups):
            if not group.linear:
                out[j] = self._difference(group, (x, v, t), columns)
            elif group.effect in columns:
                out[j] = columns[group.effect][:, self._column(group)]
        out = out[:, -len(motion.x) :]
        return np.divide(out, -1.0 * self.joined.mass, out=out)

    def _column(self, group: UnknownGroup) -> int:
        """Which column of its effect a linear parameter multiplies."""
        of = next(e for e in self.model.effects if e.name == group.effect)
        return [q.name for q in of.linear].index(group.parameter)

    def _difference(
        self, group: UnknownGroup, motion: tuple[Array, Array, Array], columns: Mapping[str, Array]
    ) -> Array:
        """Change of the force per unit of a non-linear unknown, by a difference along a motion with these columns."""
        values, part = self._inputs[0], group.part
        if part is None:
            return np.zeros(len(motion[0]))
        steps = np.array([self._step(group, piece.run) for piece in self.joined.pieces])
        shifted = self._shifted(group, steps)
        base = _sum_of(part, columns, values, len(motion[0]))
        moved = part.force(self._path(*motion, *shifted), shifted[0])
        return (moved - base) / self.joined.spread(np.where(steps > 0, steps, 1.0).tolist())

    def _shifted(self, group: UnknownGroup, steps: Array) -> tuple[Values, list[float]]:
        """Parameter values and levels after a step of one group of unknowns, (R,) by piece."""
        values, levels = self._inputs
        if group.leads:
            p = self.p.copy()
            for piece, step in zip(self.joined.pieces, steps, strict=True):
                if (i := group.slot_in(piece.run)) is not None:
                    p[i] = self.p[i] + step
            return self._inputs_at(p)
        if group.effect == LEVEL:
            return values, [level + step for level, step in zip(levels, steps.tolist(), strict=True)]
        moved = self._spread(group.effect, group.parameter, steps.tolist()) + values[group.effect][group.parameter]
        return {**values, group.effect: {**values[group.effect], group.parameter: moved}}, levels

    def _step(self, group: UnknownGroup, run: int) -> float:
        """Step of the difference in the unknown of one run; 0 if it has none."""
        i = group.slot_in(run)
        return 0.0 if i is None else difference_step(self.p[i], self.layout.slots[i].bounds)


def _sum_of(part: Model | None, columns: Mapping[str, Array], values: Values, n: int) -> Array:
    """Force (n,) of a part of a model whose columns are known."""
    return np.zeros(n) if part is None else part.force_of(columns, values, np.zeros(n))


def difference_step(value: float, bounds: tuple[float, float]) -> float:
    """Step of a difference with respect to an unknown of this value and these bounds."""
    width = bounds[1] - bounds[0]
    return float(1e-6 * max(abs(value), 1e-3 * width if np.isfinite(width) else 1.0))
