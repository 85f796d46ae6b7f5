"""Apply constraints between parameters: ties, and fixed values of parameters that are not reported as fitted.

F_s is fitted as its rise over F_c. Where the mass is fitted too, every force is fitted as q times itself (see
`mass`). Users fix and tie reported values; here they are converted to internal ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from graphlib import TopologicalSorter
from typing import Any

import numpy as np

from frictrack.effects import Effect, Parameter, Tie
from frictrack.effects.models import Model

MASS = "mass"  # pseudo-effect; its parameter is the unit of mass over the mass, minus one
Values = dict[str, dict[str, Any]]  # effect -> parameter -> value in one run; numbers, or arrays of a population


@dataclass(frozen=True)
class Constraint:
    """One parameter that is not an unknown: its reported value, or the tie that it follows."""

    effect: Effect
    parameter: Parameter
    value: float | Tie

    @property
    def is_reported_differently(self) -> bool:
        """Whether the reported value differs from the internal one."""
        return self.parameter.name in self.effect.quoted


def constraints_of(model: Model) -> tuple[Constraint, ...]:
    """Collect the constraints of a model; a parameter follows only parameters before it, without circles."""
    found = []
    for e in model.effects:
        for p in e.parameters:
            if p.tie is not None:
                found.append(Constraint(e, p, Tie.read(p.tie)))
            elif p.fixed is not None and (p.name in e.quoted or (MASS in model and _is_force_coefficient(e, p))):
                found.append(Constraint(e, p, p.fixed))
    same = {(c.effect.name, c.parameter.name): c for c in found if not c.is_reported_differently}
    leaders = {key: [(c.value.effect, c.value.parameter)] for key, c in same.items() if isinstance(c.value, Tie)}
    order = TopologicalSorter({key: [at for at in leaders.get(key, []) if at in same] for key in same}).static_order()
    return (*(same[key] for key in order), *(c for c in found if c.is_reported_differently))


def apply_constraints(model: Model, constraints: tuple[Constraint, ...], values: Values) -> None:
    """Fill in the constrained values of one run, in place: internal ones, numbers or arrays (P,) of a population."""
    q = mass_unit_ratio(values)
    for c in constraints:
        target: Any = c.value
        if isinstance(target, Tie):
            target = target.factor * reported_value(model, values, target.effect, target.parameter)
        if c.is_reported_differently:
            target = _internal_value(model, c, target, values)
        values[c.effect.name][c.parameter.name] = target * q if _is_force_coefficient(c.effect, c.parameter) else target


def reported_value(model: Model, values: Values, effect: str, parameter: str) -> Any:
    """Compute the reported value of a parameter, in its unit, from the internal values of one run."""
    found = next(e for e in model.effects if e.name == effect)
    if parameter in found.quoted and found.quote is not None:
        return found.quote(*_values_in_newtons(model, values, found))[parameter]
    q = mass_unit_ratio(values) if _is_force_coefficient(found, found.parameter(parameter)) else 1.0
    return values[effect][parameter] / q


def mass_unit_ratio(values: Mapping[str, Mapping[str, Any]]) -> Any:
    """Compute q, the unit of mass over the mass. Forces are fitted as q times themselves; q is 1 for a known mass."""
    return 1.0 + values[MASS]["m"] if "m" in values.get(MASS, {}) else 1.0


def _values_in_newtons(model: Model, values: Values, effect: Effect) -> tuple[dict[str, Any], dict[str, Any]]:
    """Values of one effect by name and of all effects by address, forces in newtons."""
    q = mass_unit_ratio(values)
    known = {
        (e.name, p.name): values[e.name][p.name] / (q if _is_force_coefficient(e, p) else 1.0)
        for e in model.effects
        for p in e.parameters
        if p.name in values[e.name]
    }
    own = {name: value for (of, name), value in known.items() if of == effect.name}
    return own, {f"{of}.{name}": value for (of, name), value in known.items()}


def _is_force_coefficient(effect: Effect, p: Parameter) -> bool:
    return p.linear and effect.acts_on == "force" and effect.name != MASS


def _internal_value(model: Model, constraint: Constraint, target: Any, values: Values) -> Any:
    """Internal value at which the parameter is reported as `target`. Reported values are linear or reciprocal in it."""
    name, quote = constraint.parameter.name, constraint.effect.quote
    assert quote is not None
    own, known = _values_in_newtons(model, values, constraint.effect)
    one, two, three = (
        quote(own | {name: u}, known | {f"{constraint.effect.name}.{name}": u})[name] for u in (1.0, 2.0, 3.0)
    )
    if np.allclose(three - two, two - one, rtol=1e-9):
        return 1.0 + (target - one) / (two - one)
    return one / target
