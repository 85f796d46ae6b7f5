"""Draw the error budget of a run's friction force as bars in newtons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from frictrack.number_format import format_number
from frictrack.plots import style
from frictrack.plots.style import axis_label, new_figure, styled

SOURCE_STYLE: dict[str, Any] = {"color": style.SKY, "edgecolor": style.MEASURED_COLOUR, "lw": 0.6}
TOTAL_STYLE: dict[str, Any] = {"color": style.MEASURED_COLOUR}
LABEL_ROOM = 1.18  # axis over longest bar, so that the number at its end has room
NEGLIGIBLE_SHARE = 2e-3  # of the longest bar: a shorter bar cannot be seen


@styled
def budget(name: str, found: Mapping[str, Any]) -> Figure:
    """Draw one bar per source and one for the total.

    Parameters
    ----------
    name : str
        Name of the run.
    found : mapping
        Error budget of the run. Its `rows`, the total last, have `source` and the standard deviations `mean_N` of the
        mean force (left) and `frame_N` of one frame (right), N; None where a source is not known.

    """
    rows = found["rows"]
    figure = new_figure(0.27 * len(rows) + 1.25, _title(name, found))
    left, right = figure.subplots(1, 2, sharey=True)
    for ax, key, label in ((left, "mean_N", "error of the mean force"), (right, "frame_N", "error of a frame, rms")):
        _bars(ax, rows, key)
        ax.set_xlabel(axis_label(label, "N"))
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
        ax.barh(i, value or 0.0, height=0.7, **(TOTAL_STYLE if row["source"] == "total" else SOURCE_STYLE))
        slant = "italic" if value is None else "normal"
        ax.annotate(
            _bar_label(value, longest), (value or 0.0, i), xytext=(4, 0), textcoords="offset points",
            va="center", fontsize=8.5, style=slant,
        )  # fmt: skip
    ax.set_xlim(0, LABEL_ROOM * longest)
    ax.tick_params(axis="y", length=0)


def _bar_label(value: float | None, longest: float) -> str:
    """The number at the end of a bar."""
    if value is None:
        return "not known"
    if value < NEGLIGIBLE_SHARE * longest:
        return "negligible" if value else "none"
    return format_number(value, 2)
