"""Write clauses of the report: sentences in lower case, held-out errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def lower_first(sentence: str) -> str:
    """Turn a sentence into a clause: lower-case first letter, no full stop.

    Examples
    --------
    >>> lower_first("Film a fixed mark.")
    'film a fixed mark'

    """
    return sentence[:1].lower() + sentence[1:].rstrip(".")


def held_out_error(errors: Mapping[str, Any]) -> tuple[float | None, str]:
    """Select the held-out error of a fit and its unit.

    Examples
    --------
    >>> held_out_error({"heldout_rms_um": None, "heldout_rms_N": 0.02})
    (0.02, 'N')

    """
    if errors.get("heldout_rms_um") is not None:
        return errors["heldout_rms_um"], "µm"
    return errors.get("heldout_rms_N"), "N"
