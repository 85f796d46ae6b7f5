"""Explain why a planned run separates two causes: what each cause keeps when a run is made differently."""

from __future__ import annotations

from collections.abc import Sequence

from frictrack.effects import Effect

UNSEPARATED = (
    "No candidate run separates {0}: they change the motion in the same way at every speed, mass and direction"
)


def explain_separation(effects: Sequence[Effect]) -> str:
    """Return what each of the separated effects keeps when a run is made differently, joined by commas.

    Examples
    --------
    >>> from frictrack import effects
    >>> explain_separation([effects.get("drag"), effects.get("spring")])
    'drag is proportional to the square of the speed, a spring pulls by place, in either direction of motion'

    """
    return ", ".join(dict.fromkeys(effect.invariant for effect in effects if effect.invariant))


def settled_by(effects: Sequence[Effect]) -> str:
    """Return what to do instead of a film to separate some effects; "" where none of them says it.

    Examples
    --------
    >>> from frictrack import effects
    >>> settled_by([effects.get("slope"), effects.get("spring")])
    'lay a level on the course, and take the cable off'

    """
    return ", and ".join(effect.settled_by for effect in effects if effect.settled_by)


def describe_unseparated(names: Sequence[str], effects: Sequence[Effect]) -> str:
    """Say that no planned run separates two explanations, and what other measurement would tell of their effects."""
    sentence = UNSEPARATED.format(" and ".join(names))
    measurement = settled_by(effects) or "; ".join(e.confirm.rstrip(".").replace("`", "") for e in effects if e.confirm)
    return f"{sentence}; {measurement}" if measurement else sentence


def describe_separation(groups: Sequence[Sequence[str]]) -> str:
    """Say which causes are separated: "a, b and c apart", or "a from b or c" where some stay together.

    Examples
    --------
    >>> describe_separation([["drag"], ["spring"]])
    'drag and spring apart'
    >>> describe_separation([["lens"], ["drag", "timebase"]])
    'lens from drag or timebase'

    """
    if all(len(group) == 1 for group in groups):
        *most, last = (group[0] for group in groups)
        return f"{', '.join(most)} and {last} apart"
    return " from ".join(" or ".join(group) for group in groups)
