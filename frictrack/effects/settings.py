"""What a user sets of one effect, as an `[[effect]]` table says it: fixed values, bounds, priors, ties, per run.

A table with a formula defines an effect. EffectSettings change a copy of the effect's parameters; a model is made of
such copies and so carries its settings.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NoReturn

import numpy as np
from pydantic import Field, ValidationError

from frictrack.base.errors import FrictrackError, UsageError, describe_invalid, suggest
from frictrack.effects.definition import Effect, Parameter
from frictrack.effects.registry import get, is_library
from frictrack.effects.user import formula as define
from frictrack.study import EffectTable

TIE = re.compile(
    r"\s*(?:(?P<factor>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*\*\s*)?(?P<of>[\w:]+)\.(?P<name>\w+)\s*"
)
MAX_TIE_LENGTH = 120  # characters
Pair = tuple[float, float]
Correlation = Annotated[float, Field(gt=-1, lt=1, strict=True)]
# What each key of a table changes of a parameter.
FIELDS = {"fix": "fixed"} | {key: key for key in ("bounds", "prior", "prior_correlation", "tie", "per_run")}


class EffectSettings(EffectTable):
    """One `[[effect]]` table; beside the keys of a study file it has what a model written as TOML has."""

    prior_correlation: dict[str, dict[str, Correlation]] = Field({})  # with other priors, by address

    def defined(self) -> Effect | None:
        """The effect that the table's formula defines, None without a formula."""
        if self.formula is None:
            if self.units:
                self._refuse("expected units only beside a formula; the library knows its own")
            return None
        if is_library(self.effect) or not re.fullmatch(r"[A-Za-z]\w*", self.effect, re.ASCII):
            self._refuse("expected a name of its own for a formula (letters, digits and _), not one of the library")
        return define(self.effect, self.formula, units=self.units, bounds=self.bounds, acts_on=self.acts_on)

    def applied(self, effect: Effect) -> Effect:
        """The effect with these settings; raises FrictrackError (usage) for what does not go together."""
        if self.follows_level is not None and not effect.may_follow_level:
            self._refuse("follows_level: expected it of friction that may follow the friction levels of the runs")
        if self.follows_level is not None and self.follows_level != effect.linear[0].loaded:
            effect = effect.with_other_level()
        changes: dict[str, dict[str, Any]] = {}
        for key, what in FIELDS.items():
            if key == "bounds" and self.formula is not None:
                continue  # a formula has them from its definition
            for name, value in getattr(self, key).items():
                self._check_name(effect, name)
                given = tuple(value.items()) if isinstance(value, Mapping) else value
                changes.setdefault(name, {})[what] = None if key == "fix" and value is False else given
        for name, change in changes.items():
            self._check(effect, effect.parameter(name), change)
        return effect.adjusted(**changes)

    def _check_name(self, effect: Effect, name: str) -> None:
        known = [p.name for p in effect.parameters]
        if name not in known:
            self._refuse(f'unknown parameter "{name}"; {suggest(name, known)}')

    def _check(self, effect: Effect, p: Parameter, change: Mapping[str, Any]) -> None:
        """What the settings of one parameter must be to each other."""
        low, high = change.get("bounds", p.bounds)
        given = [word for word, key in (("fixed", "fixed"), ("tied", "tie")) if change.get(key) is not None]
        if len(given) == 2:
            self._refuse(f"expected {p.name} to be either fixed or tied but got both")
        if change.get("tie") is not None and "bounds" in change:
            self._refuse(f"expected no bounds of {p.name}, which is tied; give them to the parameter that it follows")
        if given and "prior" in change:
            self._refuse(f"expected no prior of {p.name}, which is {given[0]} and so not fitted")
        if not low < high:
            self._refuse(
                f"bounds: expected the lower bound of {p.name} below the upper one but got [{low:g}, {high:g}]"
            )
        if "bounds" in change and p.name in effect.quoted:
            self._refuse(
                f"bounds: {p.name} is not fitted itself but as its difference from another parameter, and cannot be "
                f"held between bounds; give prior = {{{p.name} = [mean, std]}} or fix it"
            )
        if p.name in effect.quoted:
            low, high = -np.inf, np.inf
        value = change.get("fixed")
        if value is not None and not low <= value <= high:
            self._refuse(f"fix: expected {p.name} between {low:g} and {high:g} {p.unit} but got {value:g}")
        if "prior" in change:
            self._check_prior(p, change["prior"], (low, high))
        if change.get("tie") is not None and not _parse_tie(change["tie"]):
            self._refuse(
                f'tie: expected another parameter for {p.name}, as in "vibration.frequency" or '
                f'"2*vibration.frequency", but got "{change["tie"]}"'
            )

    def _check_prior(self, p: Parameter, prior: Pair, bounds: Pair) -> None:
        mean, std = prior
        if not (np.isfinite(mean) and 0 < std < np.inf):
            self._refuse(f"prior: expected [mean, standard deviation above 0] of {p.name} but got [{mean:g}, {std:g}]")
        if not bounds[0] <= mean <= bounds[1]:
            self._refuse(
                f"prior: expected a mean of {p.name} between {bounds[0]:g} and {bounds[1]:g} {p.unit} but got {mean:g}"
            )

    def _refuse(self, what: str) -> NoReturn:
        raise UsageError(f'[[effect]] "{self.effect}": {what}')


def _parse_tie(text: str) -> re.Match[str] | None:
    """Parse a tie 'effect.parameter'; return None if it is not one."""
    return TIE.fullmatch(text) if len(text) <= MAX_TIE_LENGTH else None


@dataclass(frozen=True)
class Tie:
    """What a parameter equals: `factor` times another effect's (or its own effect's) parameter."""

    effect: str
    parameter: str
    factor: float = 1.0

    def __str__(self) -> str:
        return ("" if self.factor == 1 else f"{self.factor:g}*") + f"{self.effect}.{self.parameter}"

    @classmethod
    def read(cls, text: str) -> Tie:
        """Read ``"vibration.frequency"`` or ``"2*vibration.frequency"``, which `EffectSettings` has checked."""
        found = _parse_tie(text)
        if found is None:
            raise UsageError(f'expected a tie such as "vibration.frequency" but got "{text}"')
        return cls(found["of"], found["name"], float(found["factor"] or 1.0))


def read_settings(table: Mapping[str, Any]) -> EffectSettings:
    """Read an `[[effect]]` table.

    Parameters
    ----------
    table : mapping
        The table as TOML gives it.

    Returns
    -------
    EffectSettings
        Its keys, checked one by one; `EffectSettings.applied` checks them against the effect.

    Raises
    ------
    FrictrackError
        For an unknown key, or a value of another kind.

    Examples
    --------
    >>> read_settings({"effect": "texture", "fix": {"period": 0.03}}).fix
    {'period': 0.03}

    """
    try:
        return EffectSettings.model_validate(table)
    except ValidationError as invalid:
        named = f' "{table["effect"]}"' if isinstance(table.get("effect"), str) else ""
        raise UsageError(f"[[effect]]{named}: {describe_invalid(invalid)}") from None


def definitions(tables: Iterable[EffectSettings]) -> list[Effect]:
    """The effects that tables define by a formula; raises FrictrackError (usage) for a table that makes no sense."""
    tables = list(tables)
    names = [one.effect for one in tables]
    for one in tables:
        if names.count(one.effect) > 1:
            one._refuse("expected one table for each effect but got two; write their keys into one")
    made = [effect for one in tables if (effect := one.defined()) is not None]
    for one in tables:
        try:
            base = get(one.effect, made)
        except FrictrackError as e:
            one._refuse(f"{e}, or give a formula")
        one.applied(base)
    return made


def check_ties(members: Sequence[Effect]) -> None:
    """Raise FrictrackError (usage) for a tie that leads nowhere, to another unit, or in a circle."""
    ties = {(e.name, p.name): Tie.read(p.tie) for e in members for p in e.parameters if p.tie}
    for (effect, name), tie in ties.items():
        p = next(e for e in members if e.name == effect).parameter(name)
        target = _target(members, effect, p, tie)
        if target.unit != p.unit:
            _untied(effect, f"{name} is in {p.unit} but {tie.effect}.{tie.parameter} is in {target.unit}")
        seen, at = {(effect, name)}, (tie.effect, tie.parameter)
        while at in ties and at not in seen:
            seen.add(at)
            at = (ties[at].effect, ties[at].parameter)
        if at in seen:
            _untied(effect, f"expected a tie that ends at a free parameter but {name} leads back in a circle")


def _target(members: Sequence[Effect], effect: str, p: Parameter, tie: Tie) -> Parameter:
    """The parameter that another one is tied to."""
    found = next((e for e in members if e.name == tie.effect), None)
    if found is None:
        _untied(
            effect,
            f"{p.name} follows {tie.effect}.{tie.parameter} but the model is {', '.join(e.name for e in members)}; "
            f"add {tie.effect}, or take the tie out",
        )
    known = [q.name for q in found.parameters]
    if tie.parameter not in known:
        hint = suggest(tie.parameter, known)
        _untied(effect, f'unknown parameter "{tie.parameter}" of {tie.effect}; {hint}')
    if tie.parameter in found.quoted:
        _untied(effect, f"{tie.effect}.{tie.parameter} is fitted relative to another parameter; no tie can refer to it")
    return found.parameter(tie.parameter)


def _untied(effect: str, what: str) -> NoReturn:
    raise UsageError(f'[[effect]] "{effect}": tie: {what}')


def differences(effect: Effect, base: Effect) -> dict[str, Any]:
    """What sets an effect apart from the one it was made from, by the keys of an `[[effect]]` table."""
    out: dict[str, Any] = {"follows_level": effect.linear[0].loaded} if effect.level_is_chosen else {}
    for p, was in zip(effect.parameters, base.parameters, strict=True):
        for key, what in FIELDS.items():
            now = getattr(p, what)
            if now != getattr(was, what):
                out.setdefault(key, {})[p.name] = False if now is None else now
    return {key: {k: dict(v) for k, v in of.items()} if key == "prior_correlation" else of for key, of in out.items()}
