"""Build the tables of errors: model by model, route by route, and where a model fails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from frictrack.number_format import DASH, format_interval, format_number, format_quantity, format_share
from frictrack.plots import plain_name
from frictrack.report.tables.parameters import PER_RUN_NAME
from frictrack.report.tables.text_table import Cell, TextTable, code_cell, make_table
from frictrack.results import ModelResults

MIN_P_SHOWN = 1e-6  # smaller p-values get no digits: the distribution of the noise is not known that far out
ERRORS = (
    ("rms_displacement_um", "displacement, rms", "µm", 1.0),
    ("rms_N", "friction force, rms", "N", 1.0),
    ("noise_N", "noise of the measured force", "N", 1.0),
    ("heldout_rms_um", "held out, rms", "µm", 1.0),
    ("heldout_rms_N", "held out, rms", "N", 1.0),
    ("free_run_rms_um", "free run over the whole record, rms", "µm", 1.0),
    ("free_run_relative", "free run, relative", "%", 100.0),
    ("rms_acceleration", "acceleration, rms", "m/s²", 1.0),
    ("sse_acceleration", "acceleration, sum of squares", "m²/s⁴", 1.0),
    ("relative_force_error", "relative force error", "%", 100.0),
    ("reduced_chi2", "reduced chi²", "", 1.0),
)  # key of a fit's `errors`, its name, unit, factor


def history_table(models: Sequence[ModelResults]) -> TextTable:
    """Table of the models in the order in which they were fitted, with their errors and verdicts.

    Parameters
    ----------
    models : sequence of ModelResults
        All models of the study. Errors that no model has get no column.

    """
    used = [e for e in ERRORS if any(m.summary["errors"].get(e[0]) is not None for m in models)]
    heads = (
        "model",
        *(f"{name} / {_unit_in_brackets(unit)}" if unit else name for _, name, unit, _ in used),
        "verdict",
    )
    rows = []
    for k, m in enumerate(models, 1):
        errors = m.summary["errors"]
        cells = [format_number(None if errors.get(key) is None else f * errors[key]) for key, _, _, f in used]
        name = Markup("{}. {}{}").format(k, plain_name(m.name), " (current)" if m.current else "")
        rows.append((name, *cells, (m.diagnosis or {}).get("verdict", "")))
    return make_table(heads, rows, range(1, len(used) + 1))


def _unit_in_brackets(unit: str) -> str:
    return f"({unit})" if "/" in unit else unit


def route_table(default: ModelResults, papers: ModelResults) -> TextTable:
    """Table of the parameters and errors of the default fit and of the papers' route.

    Parameters
    ----------
    default, papers : ModelResults
        The same model, fitted in both ways.

    """
    theirs = papers.summary["parameters"]
    rows: list[Sequence[Cell]] = [
        (
            code_cell(name),
            format_quantity(p["value"], p.get("std_misfit", p["std"]), p["unit"]),
            _quantity_or_dash(theirs.get(name)),
        )
        for name, p in default.summary["parameters"].items()
        if not PER_RUN_NAME.match(name)
    ]
    for key, name, unit, factor in ERRORS:
        values = [m.summary["errors"].get(key) for m in (default, papers)]
        if any(value is not None for value in values):
            cells = (format_number(None if value is None else factor * value) for value in values)
            rows.append((name, *(f"{cell} {unit}".strip() for cell in cells)))
    heads = ("", *(f"{m.summary['domain']} domain, {m.summary['search']}" for m in (default, papers)))
    return make_table(heads, rows, (1, 2))


def _quantity_or_dash(p: Mapping[str, Any] | None) -> str:
    return DASH if p is None else format_quantity(p["value"], p["std"], p["unit"])


def failing_span_table(spans: Sequence[Mapping[str, Any]]) -> TextTable:
    """Table of the spans in which a model fails.

    Parameters
    ----------
    spans : sequence of mappings
        The `fails_at` of a diagnosis: `run`, the ends of `t` in s, `x` in m and `v` in m/s, `share_of_error`, `p`.

    """
    rows = [
        (
            s["run"],
            format_interval(s.get("t"), 1e3),
            format_interval(s.get("x")),
            format_interval(s.get("v")),
            format_share(s["share_of_error"]),
            _p_value(s.get("p")),
        )
        for s in spans
    ]
    return make_table(("run", "t / ms", "x / m", "v / (m/s)", "share of the misfit", "p"), rows, (1, 2, 3, 4, 5))


def _p_value(p: float | None) -> str:
    return "" if p is None else "< 10⁻⁶" if p < MIN_P_SHOWN else format_number(p, 1)
