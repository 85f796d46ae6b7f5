"""Draw quantities over a series of studies, one panel each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from frictrack.base.number_format import format_unit
from frictrack.present.plots import style
from frictrack.present.plots.style import BAND_SIGMAS, new_figure, styled
from frictrack.records import Array

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
    low, high = np.quantile(value, [0.0, 1.0])
    reach = max(
        float(np.max(BAND_SIGMAS * np.nan_to_num(std))) if len(at) <= MAX_ERROR_BARS else 0.0, 0.08 * (high - low)
    )
    spread = high - low or abs(high) or 1.0
    reach = min(reach, 2.0 * spread)  # one very uncertain study must not flatten the others
    ax.set_ylim(low - reach, high + reach)


def _stretches(ax: Axes, at: Array, value: Array) -> None:
    """Summarise many points: median, quartiles and extremes of each part of the series."""
    parts = np.array_split(np.arange(len(at)), N_STRETCHES)
    low, lower, middle, upper, high = np.transpose([np.quantile(value[k], [0.0, 0.25, 0.5, 0.75, 1.0]) for k in parts])
    place = np.array([np.mean(at[k]) for k in parts])
    ax.fill_between(place, low, high, color=style.SKY, alpha=0.3, lw=0.0)
    ax.fill_between(place, lower, upper, color=style.SKY, lw=0.0)
    ax.plot(place, middle, color=style.MEASURED_COLOUR, lw=1.2, zorder=2)
