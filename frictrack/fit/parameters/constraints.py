"""What follows from other unknowns: ties, and fixed values of what is quoted otherwise than it is sought.

F_s is sought as its rise over F_c, and where the mass is fitted too every force is sought as q times itself (`mass`).
A value that a person fixes or ties is the quoted one; here it is turned into the one that is sought.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictrack.effects import Effect, Parameter
from frictrack.effects.settings import Tie
from frictrack.errors import FrictrackError
from frictrack.models import Model

MASS = "mass"  # pseudo-effect: unit of mass over the mass, less one
Values = dict[str, dict[str, Any]]  # effect -> parameter -> value in one run; numbers, or arrays of a population


@dataclass(frozen=True)
class Rule:
    """One parameter that is not sought: its quoted value, or the parameter that it is tied to."""

    effect: Effect
    parameter: Parameter
    told: float | Tie

    @property
    def quoted(self) -> bool:
        """Whether it is quoted otherwise than it is sought."""
        return self.parameter.name in self.effect.quoted


def rules_of(model: Model) -> tuple[Rule, ...]:
    """Rules in the order in which they can be followed; `Model.check_ties` has looked for circles."""
    rules = []
    for effect in model.effects:
        for p in effect.parameters:
            if p.tie is not None:
                rules.append(Rule(effect, p, Tie.read(p.tie)))
            elif p.fixed is not None and (p.name in effect.quoted or (MASS in model and _is_force(effect, p))):
                rules.append(Rule(effect, p, p.fixed))
    waiting = [r for r in rules if not r.quoted]
    ordered: list[Rule] = []
    while waiting:
        names = {(r.effect.name, r.parameter.name) for r in waiting}
        ready = [r for r in waiting if not isinstance(r.told, Tie) or (r.told.effect, r.told.parameter) not in names]
        if not ready:
            raise FrictrackError("expected ties that end at a free parameter but got a circle", usage=True)
        ordered += ready
        waiting = [r for r in waiting if r not in ready]
    return (*ordered, *(r for r in rules if r.quoted))


def follow(model: Model, rules: tuple[Rule, ...], values: Values) -> None:
    """Fill in what the rules say, in place."""
    q = unit_of_mass(values)
    for rule in rules:
        told = rule.told
        wanted = told.factor * quoted(model, values, told.effect, told.parameter) if isinstance(told, Tie) else told
        name = rule.parameter.name
        if rule.quoted:
            wanted = _sought(model, rule, wanted, values)
        values[rule.effect.name][name] = wanted * q if _is_force(rule.effect, rule.parameter) else wanted


def quoted(model: Model, values: Values, effect: str, parameter: str) -> Any:
    """The value of a parameter as it is quoted."""
    of = next(e for e in model.effects if e.name == effect)
    if parameter in of.quoted and of.quote is not None:
        own, flat = _plain(model, values, of)
        return of.quote(own, flat)[parameter]
    q = unit_of_mass(values) if _is_force(of, of.parameter(parameter)) else 1.0
    return values[effect][parameter] / q


def unit_of_mass(values: Mapping[str, Mapping[str, Any]]) -> Any:
    """Unit of mass over the mass, q: forces are sought as q times themselves; 1 where the mass is known."""
    return 1.0 + values[MASS]["m"] if "m" in values.get(MASS, {}) else 1.0


def _plain(model: Model, values: Values, effect: Effect) -> tuple[dict[str, Any], dict[str, Any]]:
    """Values of one effect and of all, by address, forces in newtons."""
    q = unit_of_mass(values)
    flat = {
        f"{e.name}.{p.name}": values[e.name][p.name] / (q if _is_force(e, p) else 1.0)
        for e in model.effects
        for p in e.parameters
        if p.name in values[e.name]
    }
    return {p.name: flat[f"{effect.name}.{p.name}"] for p in effect.parameters if p.name in values[effect.name]}, flat


def _is_force(effect: Effect, p: Parameter) -> bool:
    return p.linear and effect.acts_on == "force" and effect.name != MASS


def _sought(model: Model, rule: Rule, wanted: Any, values: Values) -> Any:
    """What must be sought so that the parameter is quoted as `wanted`: quotes are straight lines or reciprocals."""
    name, quote = rule.parameter.name, rule.effect.quote
    assert quote is not None
    own, flat = _plain(model, values, rule.effect)
    one, two, three = (quote(own | {name: u}, flat | {f"{rule.effect.name}.{name}": u})[name] for u in (1.0, 2.0, 3.0))
    if np.allclose(three - two, two - one, rtol=1e-9):
        return 1.0 + (wanted - one) / (two - one)
    return one / wanted
