"""A model along pieces that are laid end to end: its acceleration, and the sensitivities of that to the unknowns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from frictrack.effects import Path
from frictrack.effects.models import Model, Values
from frictrack.fit.parameters import ParameterLayout
from frictrack.fit.pieces import JoinedPieces, Samples
from frictrack.records import Array
from frictrack.simulate.dynamics import (
    MEMORY_TOLERANCE_M,
    TOLERANCE_M,
    CollocationSolution,
    LinearResponse,
    difference_steps,
    response_with_memory,
)


@dataclass(frozen=True)
class UnknownGroup:
    """One parameter of an effect: a shared unknown, or the unknowns of all runs that have their own.

    Attributes
    ----------
    effect, parameter : str
        Names.
    linear : bool
        Whether it is a coefficient that no other parameter follows.
    slots : dict
        Run (None for all) to the position of the unknown.

    """

    effect: str
    parameter: str
    linear: bool
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
        linear = layout.slots[next(iter(own.values()))].linear and layout.leaders.isdisjoint(own.values())
        groups.append(UnknownGroup(effect, parameter, linear, own))
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
        The pieces.
    p : array of shape (P,)
        The unknowns.
    remembers : bool
        Whether the force depends on the motion since the start of the piece.

    """

    layout: ParameterLayout
    groups: tuple[UnknownGroup, ...]
    joined: JoinedPieces
    p: Array
    remembers: bool

    @property
    def model(self) -> Model:
        """The model."""
        return self.layout.model

    @property
    def tolerance(self) -> float:
        """Newton step at which a motion has converged, m."""
        turns = any(piece.gain for piece in self.joined.pieces)
        return MEMORY_TOLERANCE_M if self.remembers or turns else TOLERANCE_M

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
        of = self.layout.effect(effect)
        return spread[:, None] if of.parameter(parameter).role == "depth" else spread

    @cached_property
    def _samples(self) -> Samples:
        """Where the model is evaluated along a motion."""
        return self.joined.since_start if self.remembers else self.joined.at_nodes

    def accelerations(self, motion: CollocationSolution) -> Array:
        """Return the acceleration at the nodes (3 p,) along a motion."""
        return np.asarray(self.joined.known - self._force(*self._samples.of(motion)) / self.joined.mass)

    def linearised(self, motion: CollocationSolution) -> tuple[Array, LinearResponse]:
        """Return the same, and the linear response of that motion."""
        if self.remembers:
            return self.accelerations(motion), response_with_memory(self, motion)
        (ex, ev), mass, x, v = difference_steps(motion), self.joined.mass, motion.x, motion.v
        force, onward = self._force(x, v), self._force(x, v + ev)
        by_x, by_v, by_turn = (force - self._force(x + ex, v)) / (ex * mass), (force - onward) / (ev * mass), None
        if any(piece.gain for piece in self.joined.pieces):
            faster = self._force(x, v + ev, heading=v)
            by_v, by_turn = (force - faster) / (ev * mass), (faster - onward) / (ev * mass)
        return np.asarray(self.joined.known - force / mass), LinearResponse(motion.panels, by_x, by_v, by_turn)

    def states(self, motion: CollocationSolution) -> Array:
        """Return what the model remembers at the beginning of every panel, (k, p)."""
        samples = self.joined.with_edges
        found = self.model.states(*self._path(samples, *samples.of(motion)))
        edges = np.concatenate([own[~samples.is_node] for own in found.values()], axis=1)
        return edges[motion.panels.begin].T

    def within(self, x: Array, v: Array, states: Array, heading: Array) -> tuple[Array, Array]:
        """Return accelerations at the nodes (3, p), and what is remembered at the end of every panel (k, p)."""
        samples, n = self.joined.within_panels, len(x)
        names, widths = zip(*self._widths.items(), strict=True)
        begin = dict(zip(names, np.split(states.T, np.cumsum(widths)[:-1], axis=1), strict=True))
        path, values = self._path(samples, x.T.ravel(), v.T.ravel(), begin, heading=heading.T.ravel())
        ends: dict[str, Array] = {}
        columns = self.model.force_columns(path, values, ends)
        force = self.model.force_of(columns, values, np.zeros(len(samples.t)))[samples.is_node]
        a = np.asarray(self.joined.known - force / self.joined.mass)
        return a.reshape(-1, 3).T, np.concatenate([ends[name][n - 1 :: n] for name in names], axis=1).T

    def first_states(self, x: Array, v: Array) -> Array:
        """Return what the model remembers at the start (x, v) of every piece, (k, R)."""
        begin = self._states_at_start(self.p, x, v)
        return np.concatenate(list(begin.values()), axis=1).T

    @cached_property
    def _widths(self) -> dict[str, int]:
        """How many numbers every effect with memory remembers."""
        begin = self._states_at_start(self.p, np.zeros(len(self.joined.pieces)), np.ones(len(self.joined.pieces)))
        return {name: own.shape[1] for name, own in begin.items()}

    def _force(self, x: Array, v: Array, heading: Array | None = None) -> Array:
        """Force at the nodes (3 p,) for a motion at the samples, in the direction of velocities `heading`."""
        path, values = self._path(self._samples, x, v, heading=heading)
        return self.model.force(path, values)[self._samples.is_node]

    def _path(
        self,
        samples: Samples,
        x: Array,
        v: Array,
        states: Mapping[str, Array] | None = None,
        p: Array | None = None,
        heading: Array | None = None,
    ) -> tuple[Path, Values]:
        """The path of a motion at some samples, and the values there for unknowns p (P,)."""
        values, levels = self._inputs if p is None else self._inputs_at(p)
        if self.remembers:
            if states is None and any(self._have_history):
                first = [own.start for own in samples.pieces]
                states = self._states_at_start(self.p if p is None else p, x[first], v[first])
            if len(self.joined.pieces) > 1:
                values = {name: _at_samples(own, samples) for name, own in values.items()}
        path = self.joined.path(samples, x, v, levels, states, v if heading is None else heading, self.model.turns)
        return path, values

    @cached_property
    def _have_history(self) -> list[bool]:
        """Whether something is known of the motion before each of the pieces."""
        each = [(piece.path.before, piece.path.s[0]) for piece in self.joined.pieces]
        return [before is not None and before.shape[1] > 1 and bool(s) for before, s in each]

    def _states_at_start(self, p: Array, x: Array, v: Array) -> dict[str, Array]:
        """What every effect remembers at the start (x, v) of each of the pieces, (R, k)."""
        each = []
        for i, known in enumerate(self._have_history):
            key = i, p.tobytes()
            if not known:
                each.append(self._state_at_start(i, p, x[i], v[i]))
                continue
            if key not in self._known_starts:  # what the motion before has left does not depend on the start
                piece = self.joined.pieces[i]
                self._known_starts[key] = self._state_at_start(i, p, piece.x_hat[0], piece.v_hat[0])
            each.append(self._known_starts[key])
        return {name: np.stack([own[name] for own in each]) for name in each[0]}

    def _state_at_start(self, i: int, p: Array, x: float, v: float) -> dict[str, Array]:
        """What every effect remembers where a piece begins with x and v, (k,)."""
        piece = self.joined.pieces[i]
        values, level = self.layout.values(p, piece.run)
        nodes, t = np.zeros(2, dtype=int), np.full(2, piece.panels.edges[0])
        twice = Samples(nodes, nodes, t, nodes > 0, [slice(0, 2)], (0,))
        path = JoinedPieces((piece,)).path(twice, np.full(2, x), np.full(2, v), [level], sharp=True)
        return {name: own[0] for name, own in self.model.states(path, values).items()}

    @cached_property
    def _known_starts(self) -> dict[tuple[int, bytes], dict[str, Array]]:
        """What earlier motions have left, by piece and unknowns."""
        return {}

    def sensitivities(self, motion: CollocationSolution) -> Array:
        """Compute the change of the acceleration at the nodes per unit of the unknown of every group, (K, 3 p)."""
        x, v = self._samples.of(motion)
        path, values = self._path(self._samples, x, v)
        columns, is_node = self.model.force_columns(path, values), self._samples.is_node
        out = np.zeros((len(self.groups), len(motion.x)))
        for j, group in enumerate(self.groups):
            if not group.linear:
                out[j] = self._difference(group, x, v, self.model.force_of(columns, values, np.zeros(len(x))))
            elif group.effect in columns:
                out[j] = columns[group.effect][is_node, self._column(group)]
        return np.divide(out, -1.0 * self.joined.mass, out=out)

    def _column(self, group: UnknownGroup) -> int:
        """Which column of its effect a linear parameter multiplies."""
        of = self.layout.effect(group.effect)
        return [q.name for q in of.linear].index(group.parameter)

    def _difference(self, group: UnknownGroup, x: Array, v: Array, force: Array) -> Array:
        """Change of the force at the nodes per unit of a non-linear unknown, by a difference along a motion."""
        p, steps = self.p.copy(), []
        for piece in self.joined.pieces:
            i = group.slot_in(piece.run)
            steps.append(1.0 if i is None else difference_step(self.p[i], self.layout.slots[i].bounds))
            if i is not None:
                p[i] = self.p[i] + steps[-1]
        path, values = self._path(self._samples, x, v, p=p)
        changed = self.model.force(path, values) - force
        return np.asarray(changed[self._samples.is_node] / self.joined.spread(steps))


def _at_samples(values: Mapping[str, Any], samples: Samples) -> dict[str, Any]:
    """Values of the parameters of an effect, those with one per node at the samples."""
    return {name: value[samples.nodes] if isinstance(value, np.ndarray) else value for name, value in values.items()}


def difference_step(value: float, bounds: tuple[float, float]) -> float:
    """Step of a difference with respect to an unknown of this value and these bounds."""
    width = bounds[1] - bounds[0]
    return float(1e-6 * max(abs(value), 1e-3 * width if np.isfinite(width) else 1.0))
