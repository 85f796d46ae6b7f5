"""Evaluate the parts of an effect with common amplitudes in one run: its waves, and what else it consists of.

The effect names its parts (`Effect.relaxed`). The waves of one amplitude make a sum. A parameter that several parts
share, such as v_s, may have any value in every evaluation.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from frictrack.effects import Effect, Parameter, RelaxedPart
from frictrack.fit.parameters import ParameterLayout, known_value
from frictrack.fit.separable.blocks import DataBlock
from frictrack.fit.separable.model import SeparableModel
from frictrack.models import Model
from frictrack.records import Array


@dataclass(frozen=True)
class Wave:
    """One wave of a sum: its group in the relaxed model, and the names of its amplitude, frequency and phase."""

    g: int
    part: str
    size: str
    frequency: str
    phase: str


@dataclass(frozen=True)
class SharedParameter:
    """The parameter that several parts share, and the values at which it is first tried."""

    name: str
    values: tuple[float, ...]

    @property
    def is_free(self) -> bool:
        """Whether there is more than one value to try."""
        return len(self.values) > 1


class RelaxedWaves:
    """The relaxed form of a model in one run: rows of its waves and of its other parts."""

    def __init__(self, full_model: SeparableModel, effect: Effect) -> None:
        self.full_model, self.effect = full_model, effect
        self.shared = _shared_parameter(full_model.layout, effect)
        self.parts = {f"{effect.name}.{part.effect.name}": part for part in effect.relaxed}
        self.separable = SeparableModel(
            _layout_of(full_model.layout, effect, self._part_effects(None)), full_model.blocks
        )
        self.waves = list(self._waves())
        self.sums = {
            size: [w for w in self.waves if w.size == size] for size in dict.fromkeys(w.size for w in self.waves)
        }
        groups, is_wave = self.separable.groups, {w.g for w in self.waves}
        self._other_parts = [g for g in range(len(groups)) if g not in is_wave and groups[g].names[0] in self.parts]
        self._other_effects = [
            g for g in range(len(groups)) if g not in is_wave and groups[g].names[0] not in self.parts
        ]

    def _part_effects(self, shared_value: float | None, chosen: Sequence[str] | None = None) -> list[Effect]:
        """The parts as effects of their own; the shared parameter is free for None."""
        value = {self.shared.name: shared_value} if self.shared is not None and shared_value is not None else {}
        return [
            _effect_of_part(name, part, self.effect, value)
            for name, part in self.parts.items()
            if chosen is None or name in chosen
        ]

    def _waves(self) -> Iterator[Wave]:
        """The waves among the groups of the relaxed model."""
        shared = self.shared.name if self.shared is not None else None
        for g, group in enumerate(self.separable.groups):
            part = self.parts.get(group.names[0])
            if part is not None and group.is_sinusoid:
                names = _names(part)
                own_parameters = [p for p in part.effect.nonlinear if names[p.name] != shared]
                frequency = next(p for p in own_parameters if p.role != "phase")
                phase = next(p for p in own_parameters if p.role == "phase")
                yield Wave(
                    g, group.names[0], names[part.effect.linear[0].name], names[frequency.name], names[phase.name]
                )

    def waves_alone(self, waves: Sequence[Wave], shared_value: float, blocks: Sequence[DataBlock]) -> SeparableModel:
        """Return a model of some waves with free amplitudes beside the other effects, over blocks of the run."""
        parts = self._part_effects(shared_value, [w.part for w in waves])
        return SeparableModel(_layout_of(self.full_model.layout, self.effect, parts), blocks)

    # --- rows

    def quadratures(self, w: Wave, frequencies: Array, shared_values: Array) -> Array:
        """Compute both quadratures (Q, 2, M) of a wave at frequencies (Q,) and values (Q,) of the shared parameter."""
        values = self._values({w.frequency: frequencies, self._shared_name: shared_values})
        rows = self._rows(w.g, values)
        return np.broadcast_to(rows, (len(frequencies), *rows.shape[1:]))

    def depends_on_shared(self, w: Wave) -> bool:
        """Return whether a wave depends on the shared parameter."""
        return self.shared is not None and self.shared.name in self.parts[w.part].names

    def other_parts(self, shared_values: Array) -> Array:
        """Compute the rows (Q, k, M) of the parts that are no waves, at values (Q,) of the shared parameter."""
        values = self._values({self._shared_name: shared_values})
        rows = [np.zeros((len(values), 0, self.separable.size))]
        for g in self._other_parts:
            own = self._rows(g, values)
            rows.append(np.broadcast_to(own, (len(values), *own.shape[1:])))
        return np.concatenate(rows, axis=1)

    def other_effects(self, p: Array) -> Array:
        """Compute the rows (k, M) of the other effects of the model at a parameter vector (P,) of it."""
        known = {(s.effect, s.parameter): float(v) for s, v in zip(self.full_model.layout.slots, p, strict=True)}
        values = np.array([[known.get((s.effect, s.parameter), 1.0) for s in self.separable.layout.slots]])
        rows = [self._rows(g, values)[0] for g in self._other_effects]
        return np.concatenate([np.zeros((0, self.separable.size)), *rows])

    @property
    def _shared_name(self) -> str:
        return self.shared.name if self.shared is not None else ""

    def _values(self, by_name: Mapping[str, Array]) -> Array:
        """Parameter vectors (Q, P) of the relaxed model with some parameters of the effect set in all parts."""
        out = np.ones((len(next(iter(by_name.values()))), len(self.separable.layout.slots)))
        for i, slot in enumerate(self.separable.layout.slots):
            if (part := self.parts.get(slot.effect)) is not None:
                name = _names(part)[slot.parameter]
                if name in by_name:
                    out[:, i] = by_name[name]
        return out

    def _rows(self, g: int, values: Array) -> Array:
        """Rows (Q, k, M) of one group over all blocks."""
        return np.concatenate([self.separable.rows(g, b, values) for b in range(len(self.separable.blocks))], axis=2)

    # --- parameter vectors of the full model

    def full_name(self, part: str, parameter: str) -> str:
        """Return what the whole effect calls a parameter of a part."""
        return _names(self.parts[part])[parameter]

    def value(self, p: Array, name: str) -> float:
        """Return the value of a parameter of the effect in a parameter vector (P,)."""
        k = self.full_model.position(self.effect.name, name)
        return self.full_model.layout.fixed[self.effect.name, name] if k is None else float(p[k])

    def set_value(self, p: Array, name: str, value: float) -> None:
        """Set a parameter of the effect in a parameter vector (P,), in place, unless it is fixed."""
        k = self.full_model.position(self.effect.name, name)
        if k is not None:
            p[k] = value

    def bounds(self, name: str) -> tuple[float, float]:
        """Return the bounds of a parameter of the effect; both are its value if it is fixed."""
        k = self.full_model.position(self.effect.name, name)
        if k is None:
            value = self.full_model.layout.fixed[self.effect.name, name]
            return value, value
        low, high = self.full_model.layout.bounds
        return float(low[k]), float(high[k])

    def exchanged(self, p: Array) -> Iterator[Array]:
        """Yield parameter vectors (P,) with two waves of different sums exchanged."""
        for one, other in combinations(self.waves, 2):
            if one.size != other.size:
                q = p.copy()
                for w, v in ((one, other), (other, one)):
                    self.set_value(q, w.frequency, self.value(p, v.frequency))
                    self.set_value(q, w.phase, self.value(p, v.phase))
                yield q

    def wave_rows(self, p: Array, w: Wave, shared_values: Array) -> Array:
        """Compute the rows (Q, M) of a wave at its frequency and phase in p (P,), per unit amplitude."""
        phase = self.value(p, w.phase)
        rows = self.quadratures(w, np.full(len(shared_values), self.value(p, w.frequency)), shared_values)
        return np.asarray(np.cos(phase) * rows[:, 0] + np.sin(phase) * rows[:, 1])


def _names(part: RelaxedPart) -> dict[str, str]:
    """Names in the whole effect of the parameters of a part."""
    return dict(zip((p.name for p in part.effect.parameters), part.names, strict=True))


def _layout_of(layout: ParameterLayout, effect: Effect, parts: Sequence[Effect]) -> ParameterLayout:
    """The layout with an effect replaced by parts."""
    effects = [q for e in layout.model.effects for q in (parts if e.name == effect.name else [e])]
    return replace(layout, model=Model(tuple(effects)))


def _shared_parameter(layout: ParameterLayout, effect: Effect) -> SharedParameter | None:
    """The parameter that several parts share, and its values to try: its known value, or its scan."""
    shared = [q for q in effect.nonlinear if sum(q.name in part.names for part in effect.relaxed) > 1]
    if not shared:
        return None
    (q,) = shared
    return SharedParameter(q.name, tuple(map(float, _values_to_try(q, layout))))


def _values_to_try(q: Parameter, layout: ParameterLayout) -> Sequence[float]:
    known = known_value(q, layout.span)
    if known is not None:
        return [known]
    return [1.0] if q.scan is None else list(q.scan(layout.span))


def _effect_of_part(name: str, part: RelaxedPart, effect: Effect, shared_values: Mapping[str, float]) -> Effect:
    """A part as an effect of its own: bounds and fixed values of the whole, shared parameters fixed."""
    own_parameters = []
    for q, reported_name in zip(part.effect.parameters, part.names, strict=True):
        parameter = effect.parameter(reported_name)
        fixed_value = shared_values.get(reported_name, parameter.fixed)
        if q.role == "amplitude":
            own_parameters.append(q)
        else:
            own_parameters.append(replace(q, bounds=parameter.bounds, scan=parameter.scan, fixed=fixed_value))
    return replace(part.effect, name=name, parameters=tuple(own_parameters))
