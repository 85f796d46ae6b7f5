"""Quantities over a series of studies, one panel each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from frictrack.number_format import format_unit
from frictrack.plots import style
from frictrack.plots.style import SIGMAS, blank, styled
from frictrack.records import Array

ACROSS = 2  # panels beside each other
BARS = 300  # points with an error bar of their own; of more, the bars would be one grey
POINTS = 3000  # drawn one by one; of more, what lies in a stretch of the series together
STRETCHES = 150


@styled
def series(trends: Sequence[Mapping[str, Any]]) -> Figure:
    """Every quantity over the series, with the line of a trend where there is one.

    A trend has `name`, `unit`, `at`, `value`, `std` (n,), `slope`, `p` and `holds`.
    """
    rows = -(-len(trends) // ACROSS)
    figure = blank(2.3 * rows + 0.4, "Over the series")
    panels = figure.subplots(rows, ACROSS, squeeze=False).ravel()
    for ax, trend in zip(panels, trends, strict=False):
        _panel(ax, trend)
    for ax in panels[len(trends) :]:
        ax.set_visible(False)
    return figure


def _panel(ax: Axes, trend: Mapping[str, Any]) -> None:
    at, value, std = (np.asarray(trend[key], dtype=float) for key in ("at", "value", "std"))
    if len(at) <= BARS and np.any(np.isfinite(std)):
        ax.errorbar(at, value, SIGMAS * np.nan_to_num(std), fmt="none", ecolor=style.SKY, elinewidth=1.0, zorder=1)
    if len(at) <= POINTS:
        ax.plot(at, value, "o", ms=3.5 if len(at) <= BARS else 1.5, color=style.MEASURED, zorder=2)
    else:
        _stretches(ax, at, value)
    if trend["holds"]:
        weight = 1.0 / (np.nan_to_num(std) ** 2 + trend["scatter"] ** 2 + 1e-300)
        middle = np.average(value - trend["slope"] * at, weights=weight)
        ends = np.array([at[0], at[-1]])
        ax.plot(ends, middle + trend["slope"] * ends, color=style.MODEL, lw=2.0, zorder=3)
    ax.set_title(trend["name"])
    ax.set_ylabel(format_unit(trend["unit"]) or "relative")
    ax.set_xlabel(trend["along"])
    low, high = np.quantile(value, [0.0, 1.0])
    reach = max(float(np.max(SIGMAS * np.nan_to_num(std))) if len(at) <= BARS else 0.0, 0.08 * (high - low))
    spread = high - low or abs(high) or 1.0
    reach = min(reach, 2.0 * spread)  # one study that says nothing of it must not flatten the others
    ax.set_ylim(low - reach, high + reach)


def _stretches(ax: Axes, at: Array, value: Array) -> None:
    """Many points: the median of each stretch of the series, where half of its points lie, and where all."""
    parts = np.array_split(np.arange(len(at)), STRETCHES)
    low, lower, middle, upper, high = np.transpose([np.quantile(value[k], [0.0, 0.25, 0.5, 0.75, 1.0]) for k in parts])
    place = np.array([np.mean(at[k]) for k in parts])
    ax.fill_between(place, low, high, color=style.SKY, alpha=0.3, lw=0.0)
    ax.fill_between(place, lower, upper, color=style.SKY, lw=0.0)
    ax.plot(place, middle, color=style.MEASURED, lw=1.2, zorder=2)
