"""Name models, and the axes over which a misfit or a force may repeat: time, place, speed, acceleration, phase."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

TUSTIN = ("coulomb", "stribeck", "viscous")  # the effects that together are the Tustin model
_CAPITALISED = {"tustin": "Tustin", "coulomb": "Coulomb", "stribeck": "Stribeck", "stribeck-model": "Stribeck model"}


def plain_name(group: str) -> str:
    """Convert the name of a stored model to words.

    Parameters
    ----------
    group : str
        Name of the model's group in the results: its number in the history, an underscore, its parts.

    Examples
    --------
    >>> plain_name("2_tustin+texture")
    'Tustin + texture'

    """
    return joined_name(group.split("_", 1)[-1].split("+"))


def joined_name(effects: Sequence[str]) -> str:
    """Convert the effects of a model to words.

    Parameters
    ----------
    effects : sequence of str
        Names of effects or models.

    Examples
    --------
    >>> joined_name(["coulomb", "stribeck", "viscous", "patch"]), joined_name(["coulomb", "drag"])
    ('Tustin + patch', 'Coulomb + drag')

    """
    parts = list(effects)
    if set(TUSTIN) <= set(parts):
        parts = ["tustin", *(part for part in parts if part not in TUSTIN)]
    return " + ".join(_CAPITALISED.get(part, part.upper() if part.startswith("atm") else part) for part in parts)


def numbered_name(group: str) -> str:
    """Convert the name of a stored model to words, with its number in the history.

    Examples
    --------
    >>> numbered_name("2_tustin+texture")
    '2. Tustin + texture'

    """
    return f"{group.split('_', 1)[0]}. {plain_name(group)}"


@dataclass(frozen=True)
class MotionAxis:
    """The texts of one axis.

    Attributes
    ----------
    name : str
        Name in a sentence.
    label : str
        Label of the axis in a figure.
    unit : str
        SI unit.

    """

    name: str
    label: str
    unit: str


AXES = {
    "t": MotionAxis("time since release", "time since release t", "s"),
    "x": MotionAxis("place", "displacement x", "m"),
    "v": MotionAxis("speed", "speed |v|", "m/s"),
    "a": MotionAxis("acceleration", "acceleration along the motion", "m/s^2"),
    "phase": MotionAxis("phase", "phase", "cycles"),
}
