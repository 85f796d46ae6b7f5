"""Where a model fails: its figures, its spans, and whether the failure repeats."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure

from frictrack import plots
from frictrack.axes import AXES
from frictrack.number_format import format_change, format_number
from frictrack.plots.style import run_styles
from frictrack.report.tables import TextTable, spans, table
from frictrack.results import ModelResults, Results


@dataclass(frozen=True)
class Failure:
    """One model that fails, and where."""

    headline: str
    fit: str  # how far its misfit is beyond the noise
    residual: Markup
    force: Markup
    words: str
    repeats: TextTable
    spans: TextTable


def failure(model: ModelResults, results: Results, draw: Callable[[Figure], Markup], headline: str) -> Failure:
    """Where one model fails, as its diagnosis says."""
    diagnosis = model.diagnosis or {}
    better = results.current if results.current is not model else None
    found, repeated = diagnosis.get("fails_at", []), diagnosis.get("repeats", [])
    fitted = [row["run"] for row in model.summary["per_run"] if row["role"] == "fit"]
    styles = {name: look for name, look in run_styles(results.runs).items() if name in fitted}
    pictured = (
        plots.missing_force(model.figures, found, styles, repeated) if plots.has_missing_force(model.figures) else None
    )
    return Failure(
        headline=headline,
        fit=_fit(diagnosis),
        residual=draw(plots.failing(model, results.runs, found, better)),
        force=Markup("") if pictured is None else draw(pictured),
        words=diagnosis.get("repeats_words", ""),
        repeats=_repeats(repeated),
        spans=spans(found),
    )


def _fit(diagnosis: Mapping[str, Any]) -> str:
    """The lack of fit in one sentence."""
    chi2, p = diagnosis.get("reduced_chi2"), diagnosis.get("p_lack_of_fit")
    if chi2 is None or p is None:
        return ""
    often = "in none of 999 draws" if p <= 0.001 else f"in {format_number(100 * p, 2)} % of all draws"
    return (
        f"What the model leaves is {format_number(float(chi2) ** 0.5, 3)} times the known noise (reduced chi-squared "
        f"{format_number(chi2, 3)}); noise alone styles as bad {often}."
    )


def _repeats(found: Sequence[Mapping[str, Any]]) -> TextTable:
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
    headings = ("does it repeat with", "misfit that the other runs foretell", "runs", "evidence", "repeats")
    return table(headings, rows, (1, 2, 3))
