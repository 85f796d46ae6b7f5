"""Draw the force that no effect explains, and measured signals that correlate with the residual."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from frictrack.motion_axes import AXES
from frictrack.plots import style
from frictrack.plots.style import axis_label, new_figure, styled
from frictrack.records import Array

SIDES = {"L * s": "resisting motion, with the load", "s": "resisting motion", "": "independent of the direction"}
SIGNAL_NAMES = {"vertical": "vertical motion", "accelerometer": "the accelerometer"}


@styled
def unexplained(found: Mapping[str, Any]) -> Figure:
    """Draw the force that no effect explains over the axis along which it repeats best, with two standard deviations.

    Parameters
    ----------
    found : mapping
        The `unexplained` part of a diagnosis: `axis`, `curve` (n, 2) of axis and force in N, and `band` (n,), the
        standard deviation of the force.

    """
    motion_axis = AXES[found["axis"]]
    curve = np.asarray(found["curve"], dtype=float)
    figure = new_figure(3.4, f"Unexplained force over {motion_axis.name}, {SIDES[found.get('factor', '')]}")
    ax = figure.subplots()
    ax.axhline(0, color="#666666", lw=0.7)
    if found.get("band"):
        band = 2 * np.asarray(found["band"], dtype=float)
        ax.fill_between(curve[:, 0], curve[:, 1] - band, curve[:, 1] + band, color=style.VERMILION, alpha=0.2, lw=0)
    ax.plot(curve[:, 0], curve[:, 1], color=style.VERMILION, lw=1.8)
    label = (
        axis_label("phase of the motion", "rad")
        if found["axis"] == "phase"
        else axis_label(motion_axis.label, motion_axis.unit)
    )
    ax.set(xlabel=label, ylabel="unexplained force / N")
    ax.margins(x=0)
    return figure


@styled
def correlated_signal(evidence: Mapping[str, Any], curve: Mapping[str, Array]) -> Figure:
    """Draw the residual of one run and the part that another measured signal predicts.

    Parameters
    ----------
    evidence : mapping
        One entry of the diagnosis' `evidence`: `shown` (name of the run), `kind` and `name` of the signal.
    curve : mapping
        `t` in s, `left` (residual) and `told` (predicted part) in m, all (n,).

    """
    source = evidence["name"] or SIGNAL_NAMES[evidence["kind"]]
    figure = new_figure(3.0, f"{evidence['shown']}: residual, and the part that {source} predicts")
    ax = figure.subplots()
    factor, unit = style.axis_scale(np.asarray(curve["left"]), "m")
    ax.axhline(0, color="#666666", lw=0.7)
    ax.plot(curve["t"], factor * curve["left"], color="#777777", lw=1.0, label="residual")
    ax.plot(curve["t"], factor * curve["told"], color=style.BLUE, lw=1.6, label=f"predicted by {source}")
    ax.set(xlabel=axis_label("time since release t", "s"), ylabel=axis_label("displacement", unit))
    ax.margins(x=0)
    figure.legend(loc="outside lower left", ncols=2)
    return figure
