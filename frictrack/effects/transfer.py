"""State which parameters of a law belong to the sliding pair, and so carry over to another set-up.

One rule decides, from what an effect says of itself. A parameter carries over if

1. its effect is a force that depends on the speed or on the normal load, not on the place, the mass or the drive,
2. all runs share its value, and
3. it is no phase, amplitude of a wave, depth, frequency, place or moment.
"""

from __future__ import annotations

from frictrack.effects.definition import Effect, Parameter

SETUP_UNITS = ("Hz", "rad")  # frequencies and phases belong to the set-up


def carries_over(effect: Effect, parameter: Parameter) -> bool:
    """Return whether a parameter describes the sliding pair and not the set-up, the course or a single run.

    Parameters
    ----------
    effect, parameter
        The effect, and one of its parameters.

    Examples
    --------
    >>> from frictrack.effects import get
    >>> [carries_over(get(name), get(name).parameters[0]) for name in ("coulomb", "viscous", "patch", "vibration")]
    [True, True, False, False]

    """
    own = not (parameter.per_run or parameter.role or parameter.signed or parameter.unit in SETUP_UNITS)
    return own and _is_of_pair(effect)


def _is_of_pair(effect: Effect) -> bool:
    """Return whether a force depends on the speed or the load alone."""
    if effect.acts_on != "force" or effect.scales_with not in ("load", "nothing"):
        return False
    depends_on = effect.varies_with
    if depends_on is None:
        return effect.scales_with == "load"  # friction with memory
    return "x" not in depends_on and (depends_on == "v" or effect.in_base_law)


def scales_with_load(effect: Effect, parameter: Parameter) -> bool:
    """Return whether the reported value of a parameter is proportional to the normal load.

    Parameters
    ----------
    effect, parameter
        The effect, and one of its parameters.

    Examples
    --------
    >>> from frictrack.effects import get
    >>> [scales_with_load(get("stribeck"), p) for p in get("stribeck").parameters]
    [True, False, False]

    """
    return parameter.loaded or (effect.scales_with == "load" and parameter.name in effect.quoted)
