"""Draw the error budget of a run's friction force as bars in newtons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from frictrack.base.number_format import format_number, format_range
from frictrack.present.plots import style
from frictrack.present.plots.style import RUN_STYLES, axis_label, new_figure, styled

SOURCE_STYLE: dict[str, Any] = {"color": style.SKY, "edgecolor": style.MEASURED_COLOUR, "lw": 0.6}
TOTAL_STYLE: dict[str, Any] = {"color": style.MEASURED_COLOUR}
MARKERS = ("o", "s", "^")  # of the first six runs, the next six, and so on
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


@styled
def budgets(found: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw the error budgets of several runs: one row per source, one mark per run.

    Parameters
    ----------
    found : mapping
        Error budget by run; see `budget`.

    """
    sources = list(dict.fromkeys(row["source"] for one in found.values() for row in one["rows"]))
    sources.sort(key=lambda source: source == "total")
    figure = new_figure(0.25 * len(sources) + 1.45, budgets_title(found))
    left, right = figure.subplots(1, 2, sharey=True)
    for ax, key, label in ((left, "mean_N", "error of the mean force"), (right, "frame_N", "error of a frame, rms")):
        for k, one in enumerate(found.values()):
            _marks(ax, one["rows"], key, sources, k)
        style.log_axis(ax, "x")
        _say_what_is_absent(ax, found, key, sources)
        ax.grid(axis="y", color="#E4E7EA", lw=0.8)
        ax.set_xlabel(axis_label(label, "N"))
    left.set_yticks(range(len(sources)), sources)
    left.set_ylim(len(sources) - 0.5, -0.5)
    left.tick_params(axis="y", length=0)
    if len(found) <= len(RUN_STYLES):
        handles = [Line2D([], [], label=name, **_mark(k)) for k, name in enumerate(found)]
        style.legend_below(figure, handles)
    return figure


def budgets_title(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Title of `budgets`: the total over the runs, and the source that is the largest in most of them."""
    totals = [one["rows"][-1]["mean_N"] for one in found.values()]
    largest = [max(one["rows"][:-1], key=lambda row: row["mean_N"] or 0.0)["source"] for one in found.values()]
    error = format_range([total for total in totals if total is not None])
    return f"Standard deviation of the mean force {error} N; largest source: {max(set(largest), key=largest.count)}"


def _say_what_is_absent(ax: Axes, found: Mapping[str, Mapping[str, Any]], key: str, sources: Sequence[str]) -> None:
    """Write at the left of a row without marks whether its source is not known or negligible."""
    for place, source in enumerate(sources):
        rows = [row for one in found.values() for row in one["rows"] if row["source"] == source]
        if not any(row[key] for row in rows):
            words = "not known" if any(row[key] is None for row in rows) else "none"
            ax.annotate(
                words, (0.0, place), xycoords=("axes fraction", "data"), xytext=(6, 0),
                textcoords="offset points", va="center", fontsize=8.5, style="italic", color="#666666",
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 2},
            )  # fmt: skip


def _marks(ax: Axes, rows: Sequence[Mapping[str, Any]], key: str, sources: Sequence[str], k: int) -> None:
    """Draw one run; a source that is not known or negligible has no mark."""
    least = NEGLIGIBLE_SHARE * max((row[key] or 0.0 for row in rows), default=0.0)
    known = [(row[key], sources.index(row["source"])) for row in rows if row[key] and row[key] >= least]
    if known:
        ax.plot(*zip(*known, strict=True), **_mark(k))


def _mark(k: int) -> dict[str, Any]:
    """Look of the k-th run: colour and marker."""
    look = RUN_STYLES[k % len(RUN_STYLES)]
    return {"color": look["color"], "marker": MARKERS[k // 6 % len(MARKERS)], "ls": "none", "ms": 6, "alpha": 0.85}


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
