"""What terminal, page and plots say alike: the verdicts, and the axes along which a force may repeat."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

VERDICTS = {
    "complete": "complete: nothing more is seen in these runs",
    "undetermined": "undetermined: these runs cannot show whether something is missing",
    "missing": "an effect is missing",
    "ambiguous": "something is missing, and several effects would explain it equally well",
    "unexplained": "something is missing that no effect of the library explains",
}


@dataclass(frozen=True)
class Along:
    """One axis."""

    word: str  # in a sentence
    label: str  # of a drawn axis, which says it once more in full
    unit: str


AXES = {
    "t": Along("time since release", "time since release t", "s"),
    "x": Along("place", "displacement x", "m"),
    "v": Along("speed", "speed |v|", "m/s"),
    "a": Along("acceleration", "acceleration along the motion", "m/s^2"),
    "phase": Along("phase", "phase", "cycles"),
}


def verdict(diagnosis: Mapping[str, Any]) -> str:
    """The verdict of a diagnosis and the effects that it names; where it cannot tell, all that it cannot tell apart."""
    if diagnosis["verdict"] == "undetermined":
        return f"{VERDICTS['undetermined']}: {open_question(diagnosis)}"
    names = group(diagnosis) if diagnosis["verdict"] == "ambiguous" else []
    names = [*names, *(name for name in diagnosis["missing"] if name not in names)]
    return ": ".join(filter(None, (VERDICTS[diagnosis["verdict"]], ", ".join(names))))


def group(diagnosis: Mapping[str, Any]) -> list[str]:
    """The best effect and those that predict the same data."""
    best = diagnosis["missing"][0] if diagnosis["missing"] else diagnosis["candidates"][0]["effect"]
    found: Mapping[str, Any] = next((c for c in diagnosis["candidates"] if c["effect"] == best), {})
    return [best, *found.get("indistinguishable_from", [])]


def open_question(diagnosis: Mapping[str, Any]) -> str:
    """The first thing that the runs leave open, and what would settle it."""
    gaps = diagnosis.get("undetermined") or [{"what": "the law", "why": "not determined", "settled_by": ""}]
    first, more = gaps[0], len(gaps) - 1
    others = f" (and {more} more)" if more else ""
    advice = f"; to settle it: {first['settled_by']}" if first["settled_by"] else ""
    return f"{first['what']}: {first['why']}{others}{advice}"
