"""Describe the verdict of a diagnosis, in the same words on the terminal, the page and the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

VERDICTS = {
    "complete": "complete: no further effect is detectable in these runs",
    "undetermined": "undetermined: these runs cannot show whether something is missing",
    "missing": "an effect is missing",
    "ambiguous": "something is missing; several effects explain it equally well",
    "unexplained": "something is missing that no effect of the library explains",
}

VERDICT_ONLY = (
    "Only the verdict is known so far, and it is final; `frictrack diagnose` computes where the model fails and the "
    "next experiments."
)


def describe_verdict(diagnosis: Mapping[str, Any]) -> str:
    """Describe the verdict of a diagnosis and name the effects.

    Parameters
    ----------
    diagnosis : mapping
        The JSON of a diagnosis: `verdict`, `missing`, `candidates`, and `undetermined` for that verdict.

    Returns
    -------
    str
        One sentence without a full stop.

    Examples
    --------
    >>> describe_verdict({"verdict": "missing", "missing": ["texture"], "candidates": []})
    'an effect is missing: texture'

    """
    if diagnosis["verdict"] == "undetermined":
        return f"{VERDICTS['undetermined']}: {describe_open_question(diagnosis)}"
    names = indistinguishable_effects(diagnosis) if diagnosis["verdict"] == "ambiguous" else []
    names = [*names, *(name for name in diagnosis["missing"] if name not in names)]
    return ": ".join(filter(None, (VERDICTS[diagnosis["verdict"]], ", ".join(names))))


def indistinguishable_effects(diagnosis: Mapping[str, Any]) -> list[str]:
    """Select the best candidate of a diagnosis and the effects that these runs cannot distinguish from it.

    Parameters
    ----------
    diagnosis : mapping
        The JSON of a diagnosis with at least one missing effect or candidate.

    Returns
    -------
    list of str
        Names of the effects, the best first.

    """
    best = diagnosis["missing"][0] if diagnosis["missing"] else diagnosis["candidates"][0]["effect"]
    found: Mapping[str, Any] = next((c for c in diagnosis["candidates"] if c["effect"] == best), {})
    return [best, *found.get("indistinguishable_from", [])]


def describe_open_question(diagnosis: Mapping[str, Any]) -> str:
    """Describe the first question that the runs cannot answer, and what would answer it.

    Parameters
    ----------
    diagnosis : mapping
        The JSON of a diagnosis. Its `undetermined` lists `what`, `why` and `settled_by`.

    """
    gaps = diagnosis.get("undetermined") or [{"what": "the law", "why": "not determined", "settled_by": ""}]
    first, more = gaps[0], len(gaps) - 1
    others = f" (and {more} more)" if more else ""
    advice = f"; to settle it: {first['settled_by']}" if first["settled_by"] else ""
    return f"{first['what']}: {first['why']}{others}{advice}"
