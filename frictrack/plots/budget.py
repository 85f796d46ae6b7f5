"""Where the error of a run's friction force comes from, as bars in newtons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from frictrack.number_format import format_number
from frictrack.plots import style
from frictrack.plots.style import axis, blank, styled

SOURCE: dict[str, Any] = {"color": style.SKY, "edgecolor": style.MEASURED, "lw": 0.6}
TOTAL: dict[str, Any] = {"color": style.MEASURED}
ROOM = 1.18  # of the longest bar, for the number at its end
TINY = 2e-3  # of the longest bar: one that cannot be seen


@styled
def budget(name: str, found: Mapping[str, Any]) -> Figure:
    """One bar per source and one for the total: the error of the mean force at the left, of a frame at the right."""
    rows = found["rows"]
    figure = blank(0.27 * len(rows) + 1.25, _title(name, found))
    left, right = figure.subplots(1, 2, sharey=True)
    for ax, key, label in ((left, "mean_N", "error of the mean force"), (right, "frame_N", "error of a frame, rms")):
        _bars(ax, rows, key)
        ax.set_xlabel(axis(label, "N"))
    left.set_yticks(range(len(rows)), [row["source"] for row in rows])
    left.invert_yaxis()
    return figure


def _title(name: str, found: Mapping[str, Any]) -> str:
    *rows, total = found["rows"]
    most = max(rows, key=lambda row: row["mean_N"] or 0.0)
    error = f"{format_number(total['mean_N'], 2)} N"
    return f"{name}: standard deviation of the mean force {error}; largest source: {most['source']}"


def _bars(ax: Axes, rows: Sequence[Mapping[str, Any]], key: str) -> None:
    longest = max(row[key] or 0.0 for row in rows) or 1.0
    for i, row in enumerate(rows):
        value = row[key]
        ax.barh(i, value or 0.0, height=0.7, **(TOTAL if row["source"] == "total" else SOURCE))
        slant = "italic" if value is None else "normal"
        ax.annotate(
            _bar_label(value, longest), (value or 0.0, i), xytext=(4, 0), textcoords="offset points",
            va="center", fontsize=8.5, style=slant,
        )  # fmt: skip
    ax.set_xlim(0, ROOM * longest)
    ax.tick_params(axis="y", length=0)


def _bar_label(value: float | None, longest: float) -> str:
    """What stands at the end of a bar."""
    if value is None:
        return "not known"
    if value < TINY * longest:
        return "negligible" if value else "none"
    return format_number(value, 2)
