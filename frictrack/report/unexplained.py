"""What the report says of first evidence and of structure that no effect explains."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure

from frictrack import plots
from frictrack.number_format import format_number
from frictrack.records import Array

Embed = Callable[[Figure], Markup]


def first_evidence(
    diagnosis: Mapping[str, Any], figures: Mapping[str, Mapping[str, Array]], draw: Embed
) -> list[dict[str, Any]]:
    """What moved in step with the residual, first evidence first: words, and a picture where there is a curve."""
    out = []
    for place, one in enumerate(diagnosis.get("evidence") or []):
        curve = figures.get(f"evidence_{place}")
        words = one["words"][:1].upper() + one["words"][1:]
        out.append({"words": words, "picture": draw(plots.correlated_signal(one, curve)) if curve else None})
    return out


def unexplained(diagnosis: Mapping[str, Any], draw: Embed) -> dict[str, Any] | None:
    """The curve, the formulas as rows of a table, and the snippet of the first; None where nothing is unexplained."""
    left = diagnosis.get("unexplained")
    if not left:
        return None
    rows = [
        {
            "formula": f["formula"],
            "beside": f.get("beside", []),
            "share": f"{100 * f['share']:.1f} %",
            "delta_bic": format_number(f["delta_bic"], 4),
            "chi2": format_number(f.get("reduced_chi2", float("nan")), 3),
        }
        for f in left["formulas"]
    ]
    toml = left["formulas"][0].get("toml", "") if rows else ""
    words = left.get("words", "")
    return {
        "picture": draw(plots.unexplained(left)),
        "formulas": rows,
        "toml": toml,
        "title": "A force of one variable" if words else "What no effect explains",
        "words": words[:1].upper() + words[1:],
    }
