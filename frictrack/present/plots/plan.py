"""Draw plans of runs (the evidence between pairs of effects, the next experiments) and series of studies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure

from frictrack.base.number_format import format_unit
from frictrack.present.plots import style
from frictrack.present.plots.style import BAND_SIGMAS, new_figure, styled
from frictrack.records import Array

UNSEEN = -1.0  # value of a pair of which one effect is not detectable
SEPARATION_LEVELS = (-2.0, 0.0, 1.0, 10.0, 100.0, 1e3, 1e12)
# browns: not separated; greens: separated
SEPARATION_COLOURS = ("#e3e5e7", "#8c2d04", "#fe9929", "#d9f0d3", "#7fbf7b", "#1b7837")
SEPARATION_LABELS = ("not detectable", "below 1", "1 to 10", "10 to 100", "100 to 1000", "above 1000")


@styled
def pair_separation(plan: Mapping[str, Any]) -> Figure:
    """Draw the expected difference of chi-squared between any two effects with all planned runs.

    Parameters
    ----------
    plan : mapping
        The JSON of a plan.

    """
    names = plan["evidence"]["effects"]
    table = np.array([[np.nan if e is None else e for e in row] for row in plan["evidence"]["table"]])
    hidden = np.isin(names, [one["effect"] for one in plan["unseen"]])
    table[hidden | hidden[:, None]] = UNSEEN
    table[np.triu_indices(len(names))] = np.nan
    figure = new_figure(0.29 * len(names) + 2.2, "Expected evidence between any two effects with these runs")
    ax = figure.subplots()
    picture = ax.imshow(
        table[1:, :-1],
        cmap=ListedColormap(list(SEPARATION_COLOURS)),
        norm=BoundaryNorm(SEPARATION_LEVELS, len(SEPARATION_COLOURS)),
    )
    ax.set_xticks(range(len(names) - 1), names[:-1], rotation=55, ha="right", rotation_mode="anchor")
    ax.set_yticks(range(len(names) - 1), names[1:])
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    _draw_cell_borders(ax, len(names) - 1)
    bar = figure.colorbar(picture, ax=ax, shrink=0.5, ticks=[], pad=0.02)
    bar.outline.set_visible(False)
    for k, words in enumerate(SEPARATION_LABELS):
        bar.ax.text(1.4, (k + 0.5) / len(SEPARATION_LABELS), words, transform=bar.ax.transAxes, va="center", fontsize=9)
    bar.ax.set_title("expected chi²", fontsize=9, fontweight="normal", loc="left")
    return figure


def _draw_cell_borders(ax: Axes, n: int) -> None:
    """White lines between the cells."""
    ax.set_xticks(np.arange(n + 1) - 0.5, minor=True)
    ax.set_yticks(np.arange(n + 1) - 0.5, minor=True)
    ax.grid(which="minor", color="white", lw=1.5)
    ax.tick_params(which="minor", length=0)


MIN_DELTA_BIC = 10.0  # expected difference of BIC from which two effects are distinguished
MARKERS = ("o", "s", "^", "D", "v", "P")
MIN_SHOWN_BIC = 2.0  # where the axis begins


@styled
def next_experiments(steps: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw one row per experiment and one marker per effect: the evidence for that effect if it is the true one.

    Parameters
    ----------
    steps : sequence of mappings
        Proposed experiments, best first: `key`, and `expected_if_true`, the expected difference of BIC by effect.

    """
    figure = new_figure(0.36 * len(steps) + 1.5, f"Best next: {steps[0]['key']}")
    ax = figure.subplots()
    names = list(dict.fromkeys(name for step in steps for name in step["expected_if_true"]))
    for row, step in enumerate(steps):
        ends = [max(e, MIN_SHOWN_BIC) for e in step["expected_if_true"].values()]
        ax.plot([min(ends), max(ends)], [row, row], color="#999999", lw=1.0, zorder=1)
    for k, name in enumerate(names):
        rows = [row for row, step in enumerate(steps) if name in step["expected_if_true"]]
        evidence = [max(steps[row]["expected_if_true"][name], MIN_SHOWN_BIC) for row in rows]
        color, marker = style.RUN_STYLES[k % len(style.RUN_STYLES)]["color"], MARKERS[k % len(MARKERS)]
        ax.plot(evidence, rows, ls="none", marker=marker, color=color, ms=8, label=f"if {name} is true")
    ax.axvline(MIN_DELTA_BIC, color=style.MEASURED_COLOUR, lw=1.0, linestyle="--")
    style.note(ax, "distinguished", (MIN_DELTA_BIC, -0.62), (4, 0), va="center")
    ax.set_xscale("log")
    style.name_rows(ax, [f"{k}. {step['key']}" for k, step in enumerate(steps, 1)], top=-0.85)
    ax.set_xlabel("expected difference of BIC from the nearest of the others")
    figure.legend(loc="outside right upper")
    return figure


PANEL_COLUMNS = 2
MAX_ERROR_BARS = 300  # points; the bars of more points would overlap to a grey area
MAX_POINTS = 3000  # points drawn one by one; more points are summarised by quantiles
N_STRETCHES = 150  # equal parts of the series, each with its own quantiles


@styled
def trends(found: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw every quantity over the series, with a line where its trend is significant.

    Parameters
    ----------
    found : sequence of mappings
        Each has `name` and `unit` of the quantity, `along` (label of the x axis), `at`, `value` and `std` (n,),
        `slope` per unit of `at`, `scatter` between studies, `p`, and `holds` where the trend is significant.

    """
    rows = -(-len(found) // PANEL_COLUMNS)
    figure = new_figure(2.3 * rows + 0.4, "Over the series")
    panels = figure.subplots(rows, PANEL_COLUMNS, squeeze=False).ravel()
    for ax, trend in zip(panels, found, strict=False):
        _panel(ax, trend)
    for ax in panels[len(found) :]:
        ax.set_visible(False)
    return figure


def _panel(ax: Axes, trend: Mapping[str, Any]) -> None:
    at, value, std = (np.asarray(trend[key], dtype=float) for key in ("at", "value", "std"))
    if len(at) <= MAX_ERROR_BARS and np.any(np.isfinite(std)):
        ax.errorbar(at, value, BAND_SIGMAS * np.nan_to_num(std), fmt="none", ecolor=style.SKY, elinewidth=1.0, zorder=1)
    if len(at) <= MAX_POINTS:
        ax.plot(at, value, "o", ms=3.5 if len(at) <= MAX_ERROR_BARS else 1.5, color=style.MEASURED_COLOUR, zorder=2)
    else:
        _stretches(ax, at, value)
    if trend["holds"]:
        weight = 1.0 / (np.nan_to_num(std) ** 2 + trend["scatter"] ** 2 + 1e-300)
        middle = np.average(value - trend["slope"] * at, weights=weight)
        ends = np.array([at[0], at[-1]])
        ax.plot(ends, middle + trend["slope"] * ends, color=style.MODEL_COLOUR, lw=2.0, zorder=3)
    ax.set_title(trend["name"])
    ax.set_ylabel(format_unit(trend["unit"]) or "relative")
    ax.set_xlabel(trend["along"])
    low, high = value.min(), value.max()
    bars = BAND_SIGMAS * np.nan_to_num(std).max() if len(at) <= MAX_ERROR_BARS else 0.0
    spread = high - low or abs(high) or 1.0
    reach = min(max(bars, 0.08 * (high - low)), 2.0 * spread)  # one very uncertain study must not flatten the others
    ax.set_ylim(low - reach, high + reach)


def _stretches(ax: Axes, at: Array, value: Array) -> None:
    """Summarise many points: median, quartiles and extremes of each part of the series."""
    parts = np.array_split(np.arange(len(at)), N_STRETCHES)
    low, lower, middle, upper, high = np.transpose([np.quantile(value[k], [0.0, 0.25, 0.5, 0.75, 1.0]) for k in parts])
    place = np.array([np.mean(at[k]) for k in parts])
    ax.fill_between(place, low, high, color=style.SKY, alpha=0.3, lw=0.0)
    ax.fill_between(place, lower, upper, color=style.SKY, lw=0.0)
    ax.plot(place, middle, color=style.MEASURED_COLOUR, lw=1.2, zorder=2)
