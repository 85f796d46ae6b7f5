"""Collect what the report shows of correlated signals and of force that no effect explains."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure

from frictrack import plots
from frictrack.number_format import format_number
from frictrack.records import Array
from frictrack.verdicts import describe_formula, describe_unnamed, force_without_effect

Embed = Callable[[Figure], Markup]


def correlated_signals(
    diagnosis: Mapping[str, Any], figures: Mapping[str, Mapping[str, Array]], draw: Embed
) -> list[dict[str, Any]]:
    """Describe the measured signals that correlate with the residual.

    Parameters
    ----------
    diagnosis : mapping
        The JSON of a diagnosis; its `evidence` lists the signals.
    figures : mapping
        Stored curves of the diagnosis.
    draw : callable
        Converts a figure to SVG.

    Returns
    -------
    list of dict
        `words` and `picture` of each signal; the picture is None if its curve is not stored.

    """
    out = []
    for k, one in enumerate(diagnosis.get("evidence") or []):
        curve = figures.get(f"evidence_{k}")
        words = one["words"][:1].upper() + one["words"][1:]
        out.append({"words": words, "picture": draw(plots.correlated_signal(one, curve)) if curve else None})
    return out


def unexplained_force(diagnosis: Mapping[str, Any], draw: Embed) -> dict[str, Any] | None:
    """Collect the force that no effect explains.

    Returns
    -------
    dict or None
        `picture`, `title`, `words`, `formulas` (rows of a table), `toml` of the first formula, and `none`: how likely
        another form is. None if nothing is unexplained.

    """
    left = force_without_effect(diagnosis)
    if not left:
        return None
    rows = [
        {
            "formula": f["formula"],
            "certainty": ". ".join(one[:1].upper() + one[1:] for one in describe_formula(f)),
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
        "title": "A force of one variable" if words else "Unexplained force",
        "words": words[:1].upper() + words[1:],
        "none": describe_unnamed(left),
    }
