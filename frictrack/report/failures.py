"""Collect what the report shows of a model's failures: figures, spans, and whether the misfit repeats."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure

from frictrack import plots
from frictrack.motion_axes import AXES
from frictrack.number_format import format_change, format_number
from frictrack.plots.style import run_styles
from frictrack.report.tables import TextTable, failing_span_table, make_table
from frictrack.results import ModelResults, Results

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
