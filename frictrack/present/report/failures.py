"""Collect what the report shows of a model's failures: figures, spans, and whether the misfit repeats."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure

from frictrack.base.number_format import format_change, format_number
from frictrack.present import plots
from frictrack.present.plots.style import run_styles
from frictrack.present.report.tables import TextTable, failing_span_table, make_table
from frictrack.records import Array
from frictrack.results import ModelResults, Results
from frictrack.results.motion_axes import AXES
from frictrack.results.verdicts import describe_formula, describe_unnamed, force_without_effect

MAX_SPANS_SHOWN = 12  # the others are folded


def failure(model: ModelResults, results: Results, draw: Callable[[Figure], Markup], headline: str) -> dict[str, Any]:
    """Collect where one model fails, for the template: what the misfit is, figures, repeatability and spans.

    Parameters
    ----------
    model : ModelResults
        A model with a diagnosis.
    results : Results
        The study.
    draw : callable
        Converts a figure to SVG.
    headline : str
        Heading of the section.

    """
    diagnosis = model.diagnosis or {}
    better = results.current if results.current is not model else None
    found, repeated = diagnosis.get("fails_at", []), diagnosis.get("repeats", [])
    fitted = [row["run"] for row in model.summary["per_run"] if row["role"] == "fit"]
    styles = {name: style for name, style in run_styles(results.runs).items() if name in fitted}
    force_figure = (
        plots.missing_force(model.figures, found, styles, repeated) if plots.has_missing_force(model.figures) else None
    )
    return dict(
        headline=headline,
        lack_of_fit=_lack_of_fit(diagnosis),
        residual=draw(plots.failing(model, results.runs, found, better)),
        force=Markup("") if force_figure is None else draw(force_figure),
        repeatability=diagnosis.get("repeats_words", ""),
        repeats=_repeatability_table(repeated),
        spans=failing_span_table(found[:MAX_SPANS_SHOWN]),
        more_spans=failing_span_table(found[MAX_SPANS_SHOWN:]),
    )


def _lack_of_fit(diagnosis: Mapping[str, Any]) -> str:
    """Describe the lack of fit in one sentence; "" if it is not known."""
    chi2, p = diagnosis.get("reduced_chi2"), diagnosis.get("p_lack_of_fit")
    if chi2 is None or p is None:
        return ""
    often = "in none of 999 draws" if p <= 0.001 else f"in {format_number(100 * p, 2)} % of the draws"
    return (
        f"The residual is {format_number(float(chi2) ** 0.5, 3)} times the noise (reduced chi-squared "
        f"{format_number(chi2, 3)}). Noise alone gives such a residual {often}."
    )


def _repeatability_table(found: Sequence[Mapping[str, Any]]) -> TextTable:
    rows = [
        (
            AXES[r["axis"]].name + (f" ({format_number(r['frequency'], 3)} Hz)" if r.get("frequency") else ""),
            f"{100 * r['share']:.0f} %",
            f"{r['runs']} of {r['of']}",
            format_change(r["evidence"]),
            "yes" if r["holds"] else "no",
        )
        for r in found
    ]
    headings = ("over", "misfit that the other runs predict", "runs", "evidence", "repeats")
    return make_table(headings, rows, (1, 2, 3))


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
