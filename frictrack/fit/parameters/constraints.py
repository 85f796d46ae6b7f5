"""Apply constraints between parameters: ties, and fixed values of parameters that are not reported as fitted.

F_s is fitted as its rise over F_c. Where the mass is fitted too, every force is fitted as q times itself (see
`mass`). Users fix and tie reported values; here they are converted to internal ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictrack.effects import Effect, Parameter, Tie
from frictrack.errors import FrictrackError
from frictrack.models import Model

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
    """Collect the constraints of a model in an order in which they can be applied.

    Parameters
    ----------
    model : Model
        The model. Its ties have been checked for circles by `check_ties`.

    Returns
    -------
    tuple of Constraint
        Constraints; a parameter follows only parameters before it.

    Raises
    ------
    FrictrackError
        (usage) If the ties form a circle.

    """
    constraints = []
    for effect in model.effects:
        for p in effect.parameters:
            if p.tie is not None:
                constraints.append(Constraint(effect, p, Tie.read(p.tie)))
            elif p.fixed is not None and (
                p.name in effect.quoted or (MASS in model and _is_force_coefficient(effect, p))
            ):
                constraints.append(Constraint(effect, p, p.fixed))
    waiting = [r for r in constraints if not r.is_reported_differently]
    ordered: list[Constraint] = []
    while waiting:
        names = {(r.effect.name, r.parameter.name) for r in waiting}
        ready = [r for r in waiting if not isinstance(r.value, Tie) or (r.value.effect, r.value.parameter) not in names]
        if not ready:
            raise FrictrackError("expected ties that end at a free parameter but got a circle", usage=True)
        ordered += ready
        waiting = [r for r in waiting if r not in ready]
    return (*ordered, *(r for r in constraints if r.is_reported_differently))


def apply_constraints(model: Model, constraints: tuple[Constraint, ...], values: Values) -> None:
    """Fill in the constrained values of one run, in place.

    Parameters
    ----------
    model : Model
        The model.
    constraints : tuple of Constraint
        Its constraints, from `constraints_of`.
    values : dict
        Effect name to parameter name to internal value; numbers, or arrays (P,) of a population.

    """
    q = mass_unit_ratio(values)
    for constraint in constraints:
        value = constraint.value
        target = (
            value.factor * reported_value(model, values, value.effect, value.parameter)
            if isinstance(value, Tie)
            else value
        )
        name = constraint.parameter.name
        if constraint.is_reported_differently:
            target = _internal_value(model, constraint, target, values)
        values[constraint.effect.name][name] = (
            target * q if _is_force_coefficient(constraint.effect, constraint.parameter) else target
        )


def reported_value(model: Model, values: Values, effect: str, parameter: str) -> Any:
    """Compute the reported value of a parameter from the internal values of one run.

    Parameters
    ----------
    model : Model
        The model.
    values : dict
        Internal values, as for `apply_constraints`.
    effect, parameter : str
        Names of the effect and its parameter.

    Returns
    -------
    float or array
        The reported value, in the unit of the parameter.

    """
    effect_of = next(e for e in model.effects if e.name == effect)
    if parameter in effect_of.quoted and effect_of.quote is not None:
        own, flat_values = _values_in_newtons(model, values, effect_of)
        return effect_of.quote(own, flat_values)[parameter]
    q = mass_unit_ratio(values) if _is_force_coefficient(effect_of, effect_of.parameter(parameter)) else 1.0
    return values[effect][parameter] / q


def mass_unit_ratio(values: Mapping[str, Mapping[str, Any]]) -> Any:
    """Compute q, the unit of mass over the mass. Forces are fitted as q times themselves; q is 1 for a known mass."""
    return 1.0 + values[MASS]["m"] if "m" in values.get(MASS, {}) else 1.0


def _values_in_newtons(model: Model, values: Values, effect: Effect) -> tuple[dict[str, Any], dict[str, Any]]:
    """Values of one effect and of all effects by address, forces in newtons."""
    q = mass_unit_ratio(values)
    flat_values = {
        f"{e.name}.{p.name}": values[e.name][p.name] / (q if _is_force_coefficient(e, p) else 1.0)
        for e in model.effects
        for p in e.parameters
        if p.name in values[e.name]
    }
    return {
        p.name: flat_values[f"{effect.name}.{p.name}"] for p in effect.parameters if p.name in values[effect.name]
    }, flat_values


def _is_force_coefficient(effect: Effect, p: Parameter) -> bool:
    return p.linear and effect.acts_on == "force" and effect.name != MASS


def _internal_value(model: Model, constraint: Constraint, target: Any, values: Values) -> Any:
    """Internal value at which the parameter is reported as `target`. Reported values are linear or reciprocal in it."""
    name, quote = constraint.parameter.name, constraint.effect.quote
    assert quote is not None
    own, flat_values = _values_in_newtons(model, values, constraint.effect)
    one, two, three = (
        quote(own | {name: u}, flat_values | {f"{constraint.effect.name}.{name}": u})[name] for u in (1.0, 2.0, 3.0)
    )
    if np.allclose(three - two, two - one, rtol=1e-9):
        return 1.0 + (target - one) / (two - one)
    return one / target
