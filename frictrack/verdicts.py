"""What terminal, page and plots say alike: the verdicts, and the axes along which a force may repeat."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

VERDICTS = {
    "complete": "complete: nothing more is seen in these runs",
    "undetermined": "undetermined: these runs cannot show whether something is missing",
    "missing": "an effect is missing",
    "ambiguous": "something is missing, and several effects would explain it equally well",
    "unexplained": "something is missing that no effect of the library explains",
}


def describe_verdict(diagnosis: Mapping[str, Any]) -> str:
    """The verdict of a diagnosis and the effects that it names; where it cannot tell, all that it cannot tell apart."""
    if diagnosis["verdict"] == "undetermined":
        return f"{VERDICTS['undetermined']}: {describe_open_question(diagnosis)}"
    names = indistinguishable_effects(diagnosis) if diagnosis["verdict"] == "ambiguous" else []
    names = [*names, *(name for name in diagnosis["missing"] if name not in names)]
    return ": ".join(filter(None, (VERDICTS[diagnosis["verdict"]], ", ".join(names))))


def indistinguishable_effects(diagnosis: Mapping[str, Any]) -> list[str]:
    """The best effect and those that predict the same data."""
    best = diagnosis["missing"][0] if diagnosis["missing"] else diagnosis["candidates"][0]["effect"]
    found: Mapping[str, Any] = next((c for c in diagnosis["candidates"] if c["effect"] == best), {})
    return [best, *found.get("indistinguishable_from", [])]


def describe_open_question(diagnosis: Mapping[str, Any]) -> str:
    """The first thing that the runs leave open, and what would settle it."""
    gaps = diagnosis.get("undetermined") or [{"what": "the law", "why": "not determined", "settled_by": ""}]
    first, more = gaps[0], len(gaps) - 1
    others = f" (and {more} more)" if more else ""
    advice = f"; to settle it: {first['settled_by']}" if first["settled_by"] else ""
    return f"{first['what']}: {first['why']}{others}{advice}"
