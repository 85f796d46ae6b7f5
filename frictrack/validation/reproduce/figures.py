"""Draw the papers' figures from our results; lines also differ in dash and markers in shape, for print in grey."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from frictrack.present.plots import style
from frictrack.records import Array, Run
from frictrack.validation.reproduce.papers_method import SyntheticRecording, time_speed_force

DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1, 1)), (0, (5, 1, 1, 1)), (0, (9, 2)))
COLOURS = (style.VERMILION, style.BLUE, style.GREEN)
CURVE_STYLES: list[dict[str, Any]] = [{"color": c, "linestyle": d} for c, d in zip(COLOURS, DASHES, strict=False)]
MEASURED_STYLE: dict[str, Any] = {"color": "#999999", "linewidth": 1.0}
BAR_FILLS, BAR_HATCHES = (style.VERMILION, "#FFFFFF", style.SKY, "#BBBBBB"), ("", "///", "", "...")
Curve = tuple[str, Array, Array]  # label, x, y


def _place_legend(ax: Axes) -> None:
    """Put the legend above the curves and extend the y axis for it."""
    ax.legend(loc="upper right", ncols=2)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.22 * (high - low))


def _panels(
    title: str, panels: Mapping[str, tuple[Array, Array, Sequence[Curve]]], measured: Mapping[str, Any], **labels: str
) -> Figure:
    """One panel per recording: what was measured in grey, and curves over it."""
    figure = style.new_figure(3.3, title)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, (name, (x, y, curves)) in zip(axes, panels.items(), strict=True):
        ax.plot(x, y, label="measured", **measured)
        for (label, *points), look in zip(curves, CURVE_STYLES, strict=False):
            ax.plot(*points, label=label, **look)
        ax.set(title=name, **labels)
        _place_legend(ax)
    return figure


@style.styled
def traces(title: str, panels: Mapping[str, tuple[Run, Mapping[str, Array]]], *, as_force: bool = False) -> Figure:
    """Acceleration a over time, or the friction force -m a: measured in grey, friction of laws over it."""
    drawn = {}
    for name, (run, modelled) in panels.items():
        (t, _, force), factor = time_speed_force(run), 1.0 if as_force else -1 / (run.mass or 1.0)
        curves = [(label, 1e3 * t, factor * own) for label, own in modelled.items()]
        drawn[name] = 1e3 * t, factor * force, curves
    label = "friction force F / N" if as_force else "acceleration a / (m/s²)"
    return _panels(title, drawn, MEASURED_STYLE, xlabel="time t / ms", ylabel=label)


@style.styled
def forces(title: str, panels: Mapping[str, tuple[Array, Array, Sequence[Curve]]]) -> Figure:
    """Friction force over speed: measured points, and laws as (label, v, F)."""
    dots = style.DOT_STYLE | {"color": "#999999"}
    return _panels(title, panels, dots, xlabel="velocity v / (m/s)", ylabel="friction force F / N")


@style.styled
def motions(title: str, recordings: Mapping[str, Sequence[SyntheticRecording]]) -> Figure:
    """True velocity and acceleration of recordings over time, one column per group."""
    figure = style.new_figure(4.6, title)
    axes = figure.subplots(2, len(recordings), squeeze=False, sharex="col")
    for (above, below), (name, group) in zip(axes.T, recordings.items(), strict=True):
        for recording, look in zip(group, style.RUN_STYLES, strict=False):
            above.plot(1e3 * recording.truth.t, recording.truth.v, label=recording.run.name, **look)
            below.plot(1e3 * recording.truth.t, recording.truth.a, **look)
        above.set(title=name, ylabel="velocity v / (m/s)", ylim=(0, None))
        above.legend(ncols=3, loc="lower left")
        below.set(xlabel="time t / ms", ylabel="acceleration a / (m/s²)")
    return figure


@style.styled
def bars(title: str, label: str, groups: Sequence[str], series: Mapping[str, Sequence[float]]) -> Figure:
    """Errors on a logarithmic axis: one cluster per group, one bar per method."""
    (figure, ax), width, places = style.one_panel(3.6, title), 0.8 / len(series), np.arange(len(groups))
    look: dict[str, Any] = {"edgecolor": "#333333", "linewidth": 0.7}
    for i, (name, values) in enumerate(series.items()):
        x = places + (i - (len(series) - 1) / 2) * width
        ax.bar(x, values, 0.92 * width, label=name, color=BAR_FILLS[i], hatch=BAR_HATCHES[i], **look)
    ax.set_xticks(places, groups)
    ax.set(yscale="log", ylabel=label)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high * (high / low) ** 0.25)
    ax.legend(loc="upper left", ncols=len(series))
    return figure


@style.styled
def humps(title: str, cost: Callable[[Array], Array], place: tuple[float, float]) -> Figure:
    """Fig. 17: the test function, whose sign `cost` turns, with its maximum."""
    (figure, ax), x = style.one_panel(2.9, title), np.linspace(-1, 2, 3001)
    ax.plot(x, -cost(x[:, None]), color=style.BLUE, linewidth=1.2)
    ax.plot(*place, "o", color=style.VERMILION, markersize=6)
    ax.annotate(f"{place[1]:.6f} at x = {place[0]:.6f}", place, (-8, 6), textcoords="offset points", ha="right")
    ax.set(xlabel="x", ylabel="f = x sin(10 π x) + 2", ylim=(0, 4.3))
    return figure


@style.styled
def generations(title: str, runs: Mapping[str, Array], printed: Mapping[str, float]) -> Figure:
    """Figs. 18 and 19: generation of the last improvement of each run, with our mean and the printed one."""
    figure = style.new_figure(3.0, title)
    axes = figure.subplots(1, len(runs), sharey=True)
    for ax, (name, last) in zip(axes, runs.items(), strict=True):
        ax.plot(np.arange(1, len(last) + 1), last, **(style.DOT_STYLE | {"color": style.BLUE, "markersize": 4}))
        ax.axhline(last.mean(), color=style.BLUE, label=f"mean {last.mean():.1f}")
        ax.axhline(printed[name], color=style.VERMILION, linestyle=DASHES[1], label=f"printed {printed[name]:g}")
        ax.set(title=name, xlabel="seed", ylim=(0, None))
        ax.locator_params(axis="x", integer=True)
        _place_legend(ax)
    axes[0].set_ylabel("generations")
    return figure


@style.styled
def lengths(title: str, curves: Mapping[str, Array]) -> Figure:
    """Code length over the generations, Eq. 7 as read and as printed."""
    figure, ax = style.one_panel(2.7, title, width=6.0)
    for (name, bits), look in zip(curves.items(), CURVE_STYLES, strict=False):
        ax.plot(bits, label=f"{name}, mean {bits.mean():.1f}", **look)
    ax.set(xlabel="generation G", ylabel="code length L / bits", ylim=(0, 62))
    ax.legend(loc="upper right")
    return figure


@style.styled
def ends(title: str, finals: Mapping[str, Array], local: float) -> Figure:
    """Cumulative shares of the final errors over the lowest error known, for each setting."""
    figure, ax = style.one_panel(3.2, title, width=7.5)
    for (name, ratio), run, dash in zip(finals.items(), style.RUN_STYLES, DASHES, strict=False):
        share = np.arange(1, len(ratio) + 1) / len(ratio)
        ax.step(np.sort(ratio), share, where="post", label=name, color=run["color"], linestyle=dash)
    ax.axvline(local, color="#666666", linewidth=0.8)
    ax.annotate("local optimum beyond", (local, 0.96), (4, 0), textcoords="offset points", fontsize=9)
    ax.set(xscale="log", xlabel="final error / lowest error known", ylabel="share of runs")
    ax.set(ylim=(0, 1.02), xlim=(0.99, None))
    ax.legend(loc="lower right")
    return figure
