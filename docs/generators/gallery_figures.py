"""Draw what a model leaves that lacks one effect: residual and missing force over time, position and velocity."""

from __future__ import annotations

import numpy as np
from gallery_fit import Failure
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from frictrack.present.plots.style import DOT_STYLE, RUN_STYLES, axis_label, axis_scale, new_figure, styled
from frictrack.records import Array

AXIS_LABELS = {"t": "time / s", "x": "position / m", "v": "velocity / (m/s)"}
UNITS = {"residual": "m", "F": "N"}
NAMES = {"residual": "residual", "F": "missing force"}
USUAL_PERCENT = 98.0  # of the samples, which the force axis shows with a quarter of room
WIDTH_IN = 9.0  # of a figure: narrower than a page, so that its texts are large enough
MARGIN = 0.08  # of the range of an axis


@styled
def failure_figure(failure: Failure) -> Figure:
    """Draw six panels: the residual displacement above, the missing force below, over t, x and v.

    Parameters
    ----------
    failure
        The fit without the effect.

    """
    figure = new_figure(
        5.0, f"What a fit of {' + '.join(failure.example.law)} leaves where {failure.effect} acts", width=WIDTH_IN
    )
    panels = figure.subplots(2, 3, sharey="row", sharex="col")
    for row, quantity in zip(panels, UNITS, strict=True):
        for ax, axis in zip(row, AXIS_LABELS, strict=True):
            _draw(ax, failure, quantity, axis)
        row[0].set_ylabel(axis_label(NAMES[quantity], _scale(failure, quantity)[1]))
        row[0].set_ylim(*_limits(failure, quantity))
    for ax, label in zip(panels[1], AXIS_LABELS.values(), strict=True):
        ax.set_xlabel(label)
        ax.locator_params(axis="x", nbins=7)  # long numbers keep apart
    figure.align_ylabels(panels[:, 0])
    handles = [Line2D([], [], label=made.run.name, **RUN_STYLES[k]) for k, made in enumerate(failure.runs)]
    figure.legend(handles=handles, loc="outside lower left", ncols=6)
    return figure


@styled
def thumbnail(failure: Failure) -> Figure:
    """Draw the missing force over the axis on which the effect shows best.

    Parameters
    ----------
    failure
        The fit without the effect.

    """
    quantity, axis = failure.example.shows_in, failure.example.axis
    figure = Figure(figsize=(3.2, 1.8), layout="constrained")
    ax = figure.subplots()
    _draw(ax, failure, quantity, axis)
    ax.set_ylim(*_limits(failure, quantity))
    ax.set_xlabel(AXIS_LABELS[axis])
    ax.set_ylabel(axis_label({"residual": "residual", "F": "force"}[quantity], _scale(failure, quantity)[1]))
    ax.locator_params(nbins=4)
    return figure


def _all(failure: Failure, quantity: str) -> Array:
    values = np.concatenate([getattr(part, quantity) for part in failure.leftovers])
    return np.asarray(values[np.isfinite(values)])


def _usual(failure: Failure, quantity: str) -> tuple[float, float]:
    """Range that shows all but rare values far outside; an event is rare, and is what is to be seen."""
    values = _all(failure, quantity)
    if failure.example.is_event:
        return float(values.min()), float(values.max())
    room = (100.0 - USUAL_PERCENT) / 2
    low, high = np.percentile(values, [room, 100.0 - room])
    return float(max(values.min(), low - (high - low) / 4)), float(min(values.max(), high + (high - low) / 4))


def _scale(failure: Failure, quantity: str) -> tuple[float, str]:
    return axis_scale(np.array(_usual(failure, quantity)), UNITS[quantity])


def _limits(failure: Failure, quantity: str) -> tuple[float, float]:
    factor, (low, high) = _scale(failure, quantity)[0], _usual(failure, quantity)
    room = MARGIN * (high - low)
    return factor * (min(low, 0.0) - room), factor * (max(high, 0.0) + room)


def _draw(ax: Axes, failure: Failure, quantity: str, axis: str) -> None:
    factor, _ = _scale(failure, quantity)
    for part, style in zip(failure.leftovers, RUN_STYLES, strict=False):
        values = factor * getattr(part, quantity)
        cut = quantity == "residual" and part.segments > 1
        look = style | (DOT_STYLE if cut or _is_scattered(values) else {"lw": 1.2})
        ax.plot(getattr(part, axis), values, **look)
    ax.axhline(0, color="#666666", lw=0.7, zorder=1)


def _is_scattered(values: Array) -> bool:
    """Whether neighbours differ as much as any two values do; a line through them would be a smear."""
    return bool(np.nanstd(np.diff(values)) > np.nanstd(values)) if len(values) > 2 else False
