"""A model along pieces that are laid end to end: its acceleration, and the sensitivities of that to the unknowns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from frictrack.effects import Path
from frictrack.effects.models import Model, Values
from frictrack.fit.parameters import LEVEL, ParameterLayout
from frictrack.fit.pieces import JoinedPieces
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

    """

    effect: str
    parameter: str
    linear: bool
    leads: bool
    slots: Mapping[int | None, int]

    def slot_in(self, run: int) -> int | None:
        """Return the position of the unknown of one run; None if that run has none."""
        return self.slots.get(None, self.slots.get(run))


def group_unknowns(layout: ParameterLayout) -> tuple[UnknownGroup, ...]:
    """Group the unknowns of a layout by parameter, in the order of their first position."""
    slots: dict[tuple[str, str], dict[int | None, int]] = {}
    for i, s in enumerate(layout.slots):
        slots.setdefault((s.effect, s.parameter), {})[s.run] = i
    groups = []
    for (effect, parameter), own in slots.items():
        leads, linear = any(i in layout.leaders for i in own.values()), layout.slots[next(iter(own.values()))].linear
        groups.append(UnknownGroup(effect, parameter, linear and not leads, leads, own))
    return tuple(groups)


@dataclass(frozen=True, eq=False)
class JoinedLaw:
    """A model with given unknowns along joined pieces.

    Attributes
    ----------
    layout : ParameterLayout
        Map of the parameter vector.
    groups : tuple of UnknownGroup
        The K groups of unknowns.
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
    groups: tuple[UnknownGroup, ...]
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
            return np.asarray(self.joined.known - self._force(x, v) / self.joined.mass)
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

        The derivatives are differences with steps ex and ev at every node.
        """
        force, mass = self._force(x, v), self.joined.mass
        by_x = (force - self._force(x + ex, v)) / (ex * mass)
        by_v = (force - self._force(x, v + ev)) / (ev * mass)
        return np.asarray(self.joined.known - force / mass), by_x, by_v

    def _force(self, x: Array, v: Array) -> Array:
        """Force (3 p,) of a model without memory."""
        values, levels = self._inputs
        return self.model.force(self.joined.path_at_nodes(x, v, levels), values)

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
        out = np.zeros((len(self.groups), len(x)))
        for j, group in enumerate(self.groups):
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
        values = self._inputs[0]
        steps = np.array([self._step(group, piece.run) for piece in self.joined.pieces])
        shifted = self._shifted(group, steps)
        base = self.model.force_of(columns, values, np.zeros(len(motion[0])))
        moved = self.model.force(self._path(*motion, *shifted), shifted[0])
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


def difference_step(value: float, bounds: tuple[float, float]) -> float:
    """Step of a difference with respect to an unknown of this value and these bounds."""
    width = bounds[1] - bounds[0]
    return float(1e-6 * max(abs(value), 1e-3 * width if np.isfinite(width) else 1.0))
