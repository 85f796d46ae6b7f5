"""What no effect explains, with its band and the formula that fits it; and what moved in step with the residual."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from frictrack.axes import AXES
from frictrack.plots import style
from frictrack.plots.style import axis, blank, styled
from frictrack.records import Array

SIDES = {"L * s": "resisting motion, with the load", "s": "resisting motion", "": "whichever way the mass goes"}
WITNESSES = {"vertical": "vertical motion", "accelerometer": "the accelerometer"}


@styled
def unexplained(found: Mapping[str, Any]) -> Figure:
    """Force that no effect explains, over the axis on which it repeats best, with a band of two deviations."""
    along = AXES[found["axis"]]
    curve = np.asarray(found["curve"], dtype=float)
    figure = blank(3.4, f"What no effect explains repeats best along {along.word}, {SIDES[found.get('factor', '')]}")
    ax = figure.subplots()
    ax.axhline(0, color="#666666", lw=0.7)
    if found.get("band"):
        band = 2 * np.asarray(found["band"], dtype=float)
        ax.fill_between(curve[:, 0], curve[:, 1] - band, curve[:, 1] + band, color=style.VERMILLION, alpha=0.2, lw=0)
    ax.plot(curve[:, 0], curve[:, 1], color=style.VERMILLION, lw=1.8)
    label = axis("phase of the motion", "rad") if found["axis"] == "phase" else axis(along.label, along.unit)
    ax.set(xlabel=label, ylabel="unexplained force / N")
    ax.margins(x=0)
    return figure


@styled
def in_step(evidence: Mapping[str, Any], curve: Mapping[str, Array]) -> Figure:
    """What a law leaves of one run, and what something else that was seen makes of it."""
    who = evidence["name"] or WITNESSES[evidence["kind"]]
    figure = blank(3.0, f"{evidence['shown']}: what the model leaves, and what {who} tells of it")
    ax = figure.subplots()
    factor, unit = style.scaled(np.asarray(curve["left"]), "m")
    ax.axhline(0, color="#666666", lw=0.7)
    ax.plot(curve["t"], factor * curve["left"], color="#777777", lw=1.0, label="left by the model")
    ax.plot(curve["t"], factor * curve["told"], color=style.BLUE, lw=1.6, label=f"told by {who}")
    ax.set(xlabel=axis("time since release t", "s"), ylabel=axis("displacement", unit))
    ax.margins(x=0)
    figure.legend(loc="outside lower left", ncols=2)
    return figure
