"""Describe the error budget of every run in sentences and as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from frictrack.number_format import format_number, format_unit
from frictrack.report.tables import Cell, TextTable, make_table
from frictrack.results import RunResults

HEADS = ("run", "source", "size", "known from", "mean force / N", "share", "one frame / N", "common to")


def budget_sentences(runs: Sequence[RunResults]) -> list[Markup]:
    """Describe each run's error of the force, its largest source, and what would halve it.

    Returns
    -------
    list of Markup
        One sentence per run that has an error budget.

    """
    return [Markup("<b>{}</b>: {}.").format(run.name, "; ".join(run.budget["says"])) for run in runs if run.budget]


def source_table(runs: Sequence[RunResults]) -> TextTable:
    """Table of all error sources of all runs.

    Standard deviations are those of the mean force and of one frame, N.
    """
    rows: list[Sequence[Cell]] = []
    for run in runs:
        for k, row in enumerate(run.budget.get("rows", ())):
            rows.append((run.name if k == 0 else "", *_cells(row)))
    return make_table(HEADS, rows, (4, 5, 6))


def _cells(row: Mapping[str, Any]) -> tuple[Cell, ...]:
    last = row["source"] == "total"
    size = (
        ""
        if last
        else "not known"
        if row["size"] is None
        else f"{format_number(row['size'], 2)} {format_unit(row['unit'])}"
    )
    share = "" if row["share_mean"] is None or last else f"{100 * row['share_mean']:.0f} %"
    name: Cell = Markup("<b>total</b>") if last else row["source"]
    return (
        name,
        size,
        row["told"],
        format_number(row["mean_N"], 2),
        share,
        format_number(row["frame_N"], 2),
        row["common"],
    )
