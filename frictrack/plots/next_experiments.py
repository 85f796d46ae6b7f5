"""Draw the evidence that each proposed experiment is expected to give."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from frictrack.plots import style
from frictrack.plots.style import new_figure, styled

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
        points = [
            (max(s["expected_if_true"][name], MIN_SHOWN_BIC), r)
            for r, s in enumerate(steps)
            if name in s["expected_if_true"]
        ]
        look = style.RUN_STYLES[k % len(style.RUN_STYLES)]["color"]
        x, y = zip(*points, strict=True)
        ax.plot(x, y, linestyle="none", marker=MARKERS[k % len(MARKERS)], color=look, ms=8, label=f"if {name} is true")
    ax.axvline(MIN_DELTA_BIC, color=style.MEASURED_COLOUR, lw=1.0, linestyle="--")
    ax.annotate(
        "distinguished", (MIN_DELTA_BIC, -0.62), xytext=(4, 0), textcoords="offset points", fontsize=9, va="center"
    )
    ax.set_xscale("log")
    ax.set_ylim(len(steps) - 0.5, -0.85)
    ax.set_yticks(range(len(steps)), [f"{k}. {step['key']}" for k, step in enumerate(steps, 1)])
    ax.tick_params(axis="y", length=0)
    ax.set_xlabel("expected difference of BIC from the nearest of the others")
    figure.legend(loc="outside right upper")
    return figure
