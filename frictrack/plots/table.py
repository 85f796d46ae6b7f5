"""Draw any record with one row per frame: its columns over time, with their standard deviations as bands."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from frictrack.plots import style
from frictrack.plots.style import axis_label, axis_scale, draw_band, new_figure, styled
from frictrack.records import Array, FrameTable

PANEL_HEIGHT_IN = 1.7


@styled
def table(record: FrameTable) -> Figure:
    """Draw the measured columns of a record over time, one panel each.

    Parameters
    ----------
    record : FrameTable
        A track, displacement, motion or friction force. A column ``x`` has its standard deviation in ``sigma_x``.

    """
    columns = [f for f in fields(record) if _is_drawn(record, f.name, f.metadata)]  # type: ignore[arg-type]
    name = getattr(record, "name", "") or getattr(record, "run", "")
    title = f"{type(record).__name__} of {name}" if name else type(record).__name__
    figure = new_figure(PANEL_HEIGHT_IN * len(columns) + 0.7, title)
    panels = figure.subplots(len(columns), 1, squeeze=False, sharex=True)[:, 0]
    t: Array = record.t  # type: ignore[attr-defined]
    for ax, f in zip(panels, columns, strict=True):
        _draw_column(ax, 1e3 * t, getattr(record, f.name), _sigma_of(record, f.name), (f.name, f.metadata["unit"]))
    panels[-1].set_xlabel(axis_label("time t", "ms"))
    figure.align_ylabels(panels)
    return figure


def _is_drawn(record: Any, name: str, meta: Any) -> bool:
    """Whether a column is a measured number with some known values, not the time or a standard deviation."""
    values = getattr(record, name)
    if not meta.get("column") or values is None or name == "t" or name.startswith("sigma"):
        return False
    return values.dtype.kind == "f" and bool(np.any(np.isfinite(values)))


def _sigma_of(record: Any, name: str) -> Array | None:
    """Standard deviation (n,) of a column: ``sigma_x`` of ``x``, ``sigma_px`` of ``x_px``; None if it has none."""
    named = f"sigma_{name}".replace("sigma_x_px", "sigma_px")
    found: Array | None = getattr(record, named, None)
    return found


def _draw_column(ax: Axes, t: Array, values: Array, sigma: Array | None, written: tuple[str, str]) -> None:
    name, unit = written
    factor, shown = axis_scale(values, unit)
    if sigma is not None:
        draw_band(ax, t, factor * values, factor * sigma, color=style.SKY, alpha=0.55)
    ax.plot(t, factor * values, color=style.BLUE, lw=1.0)
    ax.set_ylabel(axis_label(name, shown))
