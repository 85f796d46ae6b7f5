"""Draw the papers' figures from our results; lines also differ in dash and markers in shape, for print in grey."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from frictrack.plots import style
from frictrack.records import Array
from frictrack.reproduce.papers_method import AccelerationSeries
from frictrack.reproduce.recordings import SyntheticRecording

CURVE_STYLES: tuple[dict[str, Any], ...] = (
    {"color": style.VERMILION, "linestyle": "-"},
    {"color": style.BLUE, "linestyle": (0, (5, 1.5))},
    {"color": style.GREEN, "linestyle": (0, (1, 1))},
)
MEASURED_STYLE: dict[str, Any] = {"color": "#999999", "linewidth": 1.0}
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1, 1)), (0, (5, 1, 1, 1)), (0, (9, 2)))
Curve = tuple[str, Array]  # label, values along a series


def _place_legend(ax: Axes) -> None:
    """Put the legend above the curves and extend the y axis for it."""
    ax.legend(loc="upper right", ncols=2)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.22 * (high - low))


@style.styled
def traces(
    title: str, panels: Mapping[str, tuple[AccelerationSeries, Sequence[Curve]]], *, as_force: bool = False
) -> Figure:
    """Acceleration a over time, or the friction force -m a: measured in grey, laws over it, one panel per recording."""
    figure = style.new_figure(3.3, title)
    for ax, (name, (series, curves)) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
    ):
        factor = -series.mass if as_force else 1.0
        ax.plot(1e3 * series.t, factor * series.a, label="measured", **MEASURED_STYLE)
        for (label, a), curve_style in zip(curves, CURVE_STYLES, strict=False):
            ax.plot(1e3 * series.t, factor * a, label=label, **curve_style)
        label = "friction force F / N" if as_force else "acceleration a / (m/s²)"
        ax.set(title=name, xlabel="time t / ms", ylabel=label)
        _place_legend(ax)
    return figure


@style.styled
def motions(title: str, recordings: Mapping[str, Sequence[SyntheticRecording]]) -> Figure:
    """True velocity and acceleration of recordings over time, one column per group."""
    figure = style.new_figure(4.6, title)
    axes = figure.subplots(2, len(recordings), squeeze=False, sharex="col")
    for column, (name, group) in zip(axes.T, recordings.items(), strict=True):
        for recording, curve_style in zip(group, style.RUN_STYLES, strict=False):
            t = 1e3 * recording.truth.t
            column[0].plot(t, recording.truth.v, label=recording.run.name, **curve_style)
            column[1].plot(t, recording.truth.a, **curve_style)
        column[0].set(title=name, ylabel="velocity v / (m/s)", ylim=(0, None))
        column[0].legend(ncols=3, loc="lower left")
        column[1].set(xlabel="time t / ms", ylabel="acceleration a / (m/s²)")
    return figure


@style.styled
def forces(title: str, panels: Mapping[str, tuple[AccelerationSeries, Sequence[tuple[str, Array, Array]]]]) -> Figure:
    """Friction force over speed: measured points, and laws as (label, v, F)."""
    figure = style.new_figure(3.3, title)
    for ax, (name, (series, curves)) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
    ):
        ax.plot(series.v, series.force, label="measured", **(style.DOT_STYLE | {"color": "#999999"}))
        for (label, v, F), curve_style in zip(curves, CURVE_STYLES, strict=False):
            ax.plot(v, F, label=label, **curve_style)
        ax.set(title=name, xlabel="velocity v / (m/s)", ylabel="friction force F / N")
        _place_legend(ax)
    return figure


@style.styled
def bars(title: str, label: str, groups: Sequence[str], series: Mapping[str, Sequence[float]]) -> Figure:
    """Errors on a logarithmic axis: one cluster per group, one bar per method."""
    figure = style.new_figure(3.6, title)
    ax = figure.subplots()
    width = 0.8 / len(series)
    fills = (style.VERMILION, "#FFFFFF", style.SKY, "#BBBBBB", style.BLUE, "#FFFFFF")
    hatches = ("", "///", "", "...", "", "xx")
    for i, (name, values) in enumerate(series.items()):
        place = np.arange(len(groups)) + (i - (len(series) - 1) / 2) * width
        ax.bar(
            place,
            values,
            0.92 * width,
            label=name,
            color=fills[i],
            hatch=hatches[i],
            edgecolor="#333333",
            linewidth=0.7,
        )
    ax.set_xticks(range(len(groups)), groups)
    ax.set(yscale="log", ylabel=label)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high * (high / low) ** 0.25)
    ax.legend(loc="upper left", ncols=len(series))
    return figure


@style.styled
def humps(x: Array, y: Array, place: tuple[float, float]) -> Figure:
    """Fig. 17: the test function with its maximum."""
    figure = style.new_figure(2.9, "Fig. 17  Test function, Eq. 8")
    ax = figure.subplots()
    ax.plot(x, y, color=style.BLUE, linewidth=1.2)
    ax.plot(*place, "o", color=style.VERMILION, markersize=6)
    ax.annotate(f"{place[1]:.6f} at x = {place[0]:.6f}", place, (-8, 6), textcoords="offset points", ha="right")
    ax.set(xlabel="x", ylabel="f = x sin(10 π x) + 2", ylim=(0, 4.3))
    return figure


@style.styled
def generations(runs: Mapping[str, Array], printed: Mapping[str, float]) -> Figure:
    """Figs. 18 and 19: generation of the last improvement of each run, with our mean and the printed one."""
    figure = style.new_figure(3.0, "Figs. 18, 19  Generation of the last improvement")
    axes = figure.subplots(1, len(runs), sharey=True)
    for ax, (name, last) in zip(axes, runs.items(), strict=True):
        ax.plot(np.arange(1, len(last) + 1), last, **(style.DOT_STYLE | {"color": style.BLUE, "markersize": 4}))
        ax.axhline(last.mean(), color=style.BLUE, label=f"mean {last.mean():.1f}")
        ax.axhline(printed[name], color=style.VERMILION, linestyle=(0, (5, 1.5)), label=f"printed {printed[name]:g}")
        ax.set(title=name, xlabel="seed")
        _place_legend(ax)
    axes[0].set_ylabel("generations")
    return figure


@style.styled
def lengths(curves: Mapping[str, Array]) -> Figure:
    """Code length over the generations, Eq. 7 as read and as printed."""
    figure = style.new_figure(2.7, "Eq. 7  Code length", width=6.0)
    ax = figure.subplots()
    for (name, bits), curve_style in zip(curves.items(), CURVE_STYLES, strict=False):
        ax.plot(bits, label=f"{name}, mean {bits.mean():.1f}", **curve_style)
    ax.set(xlabel="generation G", ylabel="code length L / bits", ylim=(0, 62))
    ax.legend(loc="upper right")
    return figure


@style.styled
def ends(title: str, finals: Mapping[str, Array], local: float) -> Figure:
    """Cumulative shares of the final errors over the lowest error known, for each setting."""
    figure = style.new_figure(3.2, title, width=7.5)
    ax = figure.subplots()
    for (name, ratio), curve_style in zip(finals.items(), style.RUN_STYLES, strict=False):
        steps = np.sort(ratio)
        dash = DASHES[list(finals).index(name) % len(DASHES)]
        ax.step(
            steps,
            np.arange(1, len(steps) + 1) / len(steps),
            where="post",
            label=name,
            color=curve_style["color"],
            linestyle=dash,
        )
    ax.axvline(local, color="#666666", linewidth=0.8)
    ax.annotate("local optimum beyond", (local, 0.03), (4, 0), textcoords="offset points", fontsize=9)
    ax.set(
        xscale="log",
        xlabel="final error / lowest error known",
        ylabel="share of runs",
        ylim=(0, 1.02),
        xlim=(0.99, None),
    )
    ax.legend(loc="lower center")
    return figure
