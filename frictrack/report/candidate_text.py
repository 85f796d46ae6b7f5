"""Describe candidate effects: the evidence for them and the change of the held-out error."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from frictrack.number_format import format_change, format_number


def find_candidate(diagnosis: Mapping[str, Any] | None, effect: str) -> Mapping[str, Any] | None:
    """Find a candidate of a diagnosis.

    Parameters
    ----------
    diagnosis : mapping or None
        The JSON of a diagnosis.
    effect : str
        Name of the effect.

    Returns
    -------
    mapping or None
        The candidate; None if it is not there.

    """
    return next((c for c in (diagnosis or {}).get("candidates", []) if c["effect"] == effect), None)


def evidence_text(candidate: Mapping[str, Any]) -> Markup:
    """Describe the evidence for a candidate: p for the whole search and delta BIC."""
    return Markup("p = {} for the whole search, delta BIC {}").format(
        format_number(candidate["p"], 1), format_change(candidate["delta_bic"])
    )


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


def held_out_change(candidate: Mapping[str, Any]) -> str:
    """Describe the held-out error without and with a candidate; "" if nothing was held out.

    Examples
    --------
    >>> held_out_change({"heldout_rms_before_um": 21.2, "heldout_rms_after_um": 10.2})
    '21.2 to 10.2 µm'

    """
    before, after, unit = _held_out_pair(candidate)
    return "" if before is None or after is None else f"{format_number(before)} to {format_number(after)} {unit}"


def held_out_clause(candidate: Mapping[str, Any]) -> str:
    """Describe what a candidate makes of the held-out error, as a clause; "" if nothing was held out.

    Examples
    --------
    >>> held_out_clause({"heldout_rms_before_um": 21.2, "heldout_rms_after_um": 10.2})
    'with it the held-out error falls from 21.2 to 10.2 µm'

    """
    before, after, _ = _held_out_pair(candidate)
    if before is None or after is None:
        return ""
    verb = "falls" if after < before else "does not fall:"
    return f"with it the held-out error {verb} from {held_out_change(candidate)}"


def _held_out_pair(candidate: Mapping[str, Any]) -> tuple[float | None, float | None, str]:
    """Held-out errors without and with a candidate, and their unit."""
    key, unit = ("um", "µm") if candidate.get("heldout_rms_after_um") is not None else ("N", "N")
    return candidate.get(f"heldout_rms_before_{key}"), candidate.get(f"heldout_rms_after_{key}"), unit
