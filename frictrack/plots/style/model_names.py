"""Write the names of stored models as people read them."""

from __future__ import annotations

_CAPITALISED = {
    "tustin": "Tustin",
    "coulomb": "Coulomb",
    "stribeck": "Stribeck",
    "stribeck-model": "Stribeck model",
}


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
    parts = group.split("_", 1)[-1].split("+")
    return " + ".join(_CAPITALISED.get(part, part.upper() if part.startswith("atm") else part) for part in parts)


def numbered_name(group: str) -> str:
    """Convert the name of a stored model to words, with its number in the history.

    Examples
    --------
    >>> numbered_name("2_tustin+texture")
    '2. Tustin + texture'

    """
    return f"{group.split('_', 1)[0]}. {plain_name(group)}"
