"""Turn a formula of the last diagnosis, "formula:1", into an effect that can be written into the study file."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from frictrack.errors import FrictrackError

FORMULA = re.compile(r"formula:(\d+)")


def formula_number(effect: str) -> int | None:
    """Return n of "formula:n"; None for the name of an effect.

    Examples
    --------
    >>> formula_number("formula:2"), formula_number("texture")
    (2, None)

    """
    named = FORMULA.fullmatch(effect)
    return int(named[1]) if named else None


def effect_of_formula(found: Mapping[str, Any], taken: Iterable[str]) -> dict[str, Any]:
    """Return the keys of the ``[[effect]]`` table of one formula.

    Parameters
    ----------
    found
        An entry of "formulas" of the JSON of `frictrack diagnose`.
    taken
        Names of the effects that the study has; another name is chosen.

    Returns
    -------
    dict
        The keys, with "effect" for the name; empty if the formula has no table.

    """
    table: dict[str, Any] = tomllib.loads(found["toml"])["effect"][0] if found.get("toml") else {}
    if not table:
        return {}
    known = set(taken)
    names = (f"{table['effect']}{mark}" for mark in ("", *(f"_{k}" for k in range(2, len(known) + 3))))
    return table | {"effect": next(one for one in names if one not in known)}


def choose_formula(
    number: int, diagnosis: Mapping[str, Any] | None, taken: Iterable[str], model: Sequence[str]
) -> dict[str, Any]:
    """Return the keys of the ``[[effect]]`` table of formula `number` of a diagnosis, counted from 1.

    Parameters
    ----------
    number
        Its position.
    diagnosis
        The JSON of the diagnosis of the current model; None if there is none.
    taken
        Names of the effects that the study has.
    model
        Effects of the current model.

    Raises
    ------
    FrictrackError
        (usage) If there is no such formula, or the model lacks effects beside which it was found.

    """
    if diagnosis is None:
        raise FrictrackError(
            f"expected a diagnosis for formula:{number} but the current model has none; run frictrack diagnose first",
            usage=True,
        )
    formulas = (diagnosis.get("unexplained") or {}).get("formulas") or []
    if not 1 <= number <= len(formulas):
        known = f"formula:1 to formula:{len(formulas)}" if formulas else "no formula, because none was needed or found"
        raise FrictrackError(
            f"expected a formula of the last diagnosis but got formula:{number}; it has {known}", usage=True
        )
    one = formulas[number - 1]
    if absent := [name for name in one.get("beside") or [] if name not in model]:
        names = ", ".join(absent)
        raise FrictrackError(f"formula:{number} was found beside {names}; add {names} first", usage=True)
    return effect_of_formula(one, taken)
