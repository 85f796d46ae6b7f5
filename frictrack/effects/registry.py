"""Look up effects by name: the library, effects declared in Python, and formulas of a study."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from frictrack.base.errors import UsageError, suggest
from frictrack.effects.atm2 import atm2, atm2_printed
from frictrack.effects.definition import LEVEL, NEEDS, Effect, Parameter
from frictrack.effects.library import load_library

MAX_INSTANCES = 99  # of one effect in a model
MAX_ORDER = 20  # sines of ATM1 and ATM2: 60 parameters and more; the papers stop at 4

LIBRARY = load_library()
OF_AN_ORDER = {"atm2": atm2, "atm2_printed": atm2_printed}  # effects whose colon is an order
DECLARED: dict[str, Effect] = {}  # effects declared in Python by `effect`, in the order of declaration


def is_library(name: str) -> bool:
    """Return whether a name is taken by the library."""
    return name in LIBRARY or name in (*OF_AN_ORDER, "mass", "level")


def known(extra: Iterable[Effect] = ()) -> dict[str, Effect]:
    """Return every effect by name.

    Parameters
    ----------
    extra : iterable of Effect
        Further effects, such as the formulas of a study; they win over the library.

    Returns
    -------
    dict of Effect
        The library, then effects declared in Python, then `extra`.

    """
    return LIBRARY | DECLARED | {e.name: e for e in extra}


def get(name: str, extra: Iterable[Effect] = ()) -> Effect:
    """Return the effect of a name.

    Parameters
    ----------
    name : str
        "texture", a further instance "vibration:2", ATM2 of an order, "atm2:2", or a parameter of an effect that is
        freed, "stribeck.delta".
    extra : iterable of Effect
        Further effects, such as the formulas of a study.

    Returns
    -------
    Effect
        The effect, called by `name`.

    Raises
    ------
    FrictrackError
        For an unknown name; the message suggests the nearest known one.

    Examples
    --------
    >>> get("texture").equation
    'amplitude L s sin(2 pi x/period + phase)'
    >>> get("vibration:2").kind
    'vibration'

    """
    whole, dot, parameter = name.partition(".")
    if dot:
        effect = get(whole, extra)
        if parameter in {p.name for p in effect.parameters} or (parameter == LEVEL and effect.may_follow_level):
            return effect.freed(parameter)
    kind, colon, suffix = name.partition(":")
    if kind in OF_AN_ORDER:
        return OF_AN_ORDER[kind](order(name) if colon else 2)
    number = _parse_count(suffix, MAX_INSTANCES)
    if suffix and number is None:
        raise UsageError(f'expected a number up to {MAX_INSTANCES} after the colon but got "{name}"')
    table = known(extra)
    if name in table:
        return table[name]
    if kind not in table:
        hint = suggest(kind, [*table, *OF_AN_ORDER])
        raise UsageError(f'expected the name of an effect but got "{name}"; {hint}')
    return table[kind].called(name) if number is not None and number > 1 else table[kind]


def order(name: str) -> int:
    """Return the number of sines that a name such as "atm1:2" asks for.

    Raises
    ------
    FrictrackError
        For a name without an order, or with one above `MAX_ORDER`.

    Examples
    --------
    >>> order("atm2:3")
    3

    """
    kind, _, suffix = name.partition(":")
    found = _parse_count(suffix, MAX_ORDER)
    if found is None:
        wanted = f'an order from 1 to {MAX_ORDER} after the colon, as in "{kind}:2"'
        raise UsageError(f'expected {wanted}, but got "{name[:40]}"')
    return found


def _parse_count(text: str, highest: int) -> int | None:
    """A number from 1 to `highest`; None for another text."""
    # int() alone would read digits of other scripts, and thousands of digits slowly
    found = int(text) if re.fullmatch(r"[0-9]{1,4}", text) else 0
    return found if 1 <= found <= highest else None


def laws_in_place_of(effect: Effect) -> list[Effect]:
    """Return the laws that stand in place of one effect alone.

    Laws in place of a part of the base law (an eddy-current brake for viscous friction) are for the user to choose.

    Parameters
    ----------
    effect : Effect
        The effect.

    Returns
    -------
    list of Effect
        Of the library and of those declared in Python.

    Examples
    --------
    >>> [law.name for law in laws_in_place_of(get("presliding"))]
    ['elasto_plastic', 'maxwell_slip']
    >>> laws_in_place_of(get("viscous"))
    []

    """
    return [] if effect.in_base_law else [e for e in known().values() if e.replaces == {effect.kind}]


def catalogue(extra: Iterable[Effect] = ()) -> list[dict[str, Any]]:
    """Return every effect as JSON: what the command `frictrack effects` prints.

    Parameters
    ----------
    extra : iterable of Effect
        Further effects, such as the formulas of a study.

    Returns
    -------
    list of dict
        One entry per effect: name, equation, parameters with units and bounds, and the texts about it.

    """
    texts = ("name", "acts_on", "equation", "what", "looks_like", "mistaken_for", "confirm", "source")
    return [
        {key: getattr(e, key) for key in texts}
        | {"parameters": [_parameter_entry(p) for p in e.parameters], "needs": [NEEDS[need][0] for need in e.needs]}
        for e in (*known(extra).values(), atm2(2))
    ]


def _parameter_entry(p: Parameter) -> dict[str, Any]:
    bounds = [float(b) if abs(b) < float("inf") else None for b in p.bounds]
    return {"name": p.name, "unit": p.unit, "linear": p.linear, "bounds": bounds, "per_run": p.per_run}
