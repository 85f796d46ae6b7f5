"""Describe plots and their layers for the browser: lines, points, bands and spans over common columns.

A colour is the name of a design token: "model" is `--ft-model` of the page.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from frictrack.records import Array

HEADER_BYTES = 4  # the length of the scene, uint32
ALIGNMENT = 4  # bytes of a Float32


@dataclass
class PlotData:
    """Plots over common columns; the rows may come from several runs, one after the other.

    Attributes
    ----------
    rows : int
        Number of rows.
    columns : dict
        Columns by name, (rows,) each; columns of film positions may be longer.
    plots : list of dict
        The plots; see `plot`.
    runs : list of dict
        Name, first row, number of rows, index of the colour, first frame and tracked targets of each run.
    extra : dict
        Further keys of the scene.

    """

    rows: int = 0
    columns: dict[str, Array] = field(default_factory=dict)
    plots: list[dict[str, Any]] = field(default_factory=list)
    runs: list[dict[str, Any]] = field(default_factory=list)
    extra: dict[str, Any] = field(default_factory=dict)

    def layout(self) -> tuple[dict[str, Any], bytes]:
        """Split into a description and numbers.

        Returns
        -------
        scene : dict
            Plots, runs, and offset and length of each column.
        data : bytes
            All columns, one after the other, as little-endian Float32.

        """
        places, parts, at = {}, [], 0
        for key, column in self.columns.items():
            part = np.asarray(column, dtype="<f4")
            places[key], at = [at, len(part)], at + len(part)
            parts.append(part.tobytes())
        scene = {"rows": self.rows, "columns": places, "plots": self.plots, "runs": self.runs, **self.extra}
        return scene, b"".join(parts)

    def pack(self) -> bytes:
        r"""Pack scene and columns for `parsePacked` in the browser.

        Returns
        -------
        bytes
            Length of the scene (uint32), the scene as JSON padded with spaces to four bytes, then the columns.

        Examples
        --------
        >>> PlotData(1, {"t": np.zeros(1)}).pack()[-4:]
        b'\x00\x00\x00\x00'

        """
        scene, data = self.layout()
        text = json.dumps(scene, allow_nan=False, separators=(",", ":")).encode()
        text += b" " * (-len(text) % ALIGNMENT)
        return len(text).to_bytes(HEADER_BYTES, "little") + text + data


def axis(column: str, name: str, unit: str) -> dict[str, str]:
    """Describe an axis.

    Parameters
    ----------
    column : str
        Column of its values; "" for the y axis, whose layers name their columns.
    name : str
        Quantity.
    unit : str
        Unit; "" for none.

    """
    return {"column": column, "name": name, "unit": unit, "label": f"{name} / {_in_label(unit)}" if unit else name}


def _in_label(unit: str) -> str:
    return f"({unit})" if "/" in unit else unit


def plot(
    title: str,
    x: Mapping[str, str],
    y: tuple[str, str],
    *layers: Mapping[str, Any],
    **more: Any,
) -> dict[str, Any]:
    """Describe one plot.

    Parameters
    ----------
    title : str
        Title, which is also its id.
    x : mapping
        The x axis, see `axis`.
    y : tuple of str
        Quantity and unit of the y axis.
    *layers : mapping
        What is drawn, from bottom to top: `line`, `dots`, `band`, `span`.
    **more
        `brush` "x": a selection takes all values of y. `focus`: range of x that sets the range of y. `handles`: spans
        with ends to drag, each with `name` and `span`.

    """
    return {"id": title, "title": title, "x": dict(x), "y": axis("", *y), "layers": list(layers), **more}


def line(y: str, colour: str, name: str, label: str = "", **more: Any) -> dict[str, Any]:
    """Describe a layer: a line through the values of a column, with gaps at NaN.

    Parameters
    ----------
    y : str
        Name of the column.
    colour : str
        Design token.
    name : str
        Name under which the legend hides it, the same in all plots.
    label : str
        Text in the legend; "" for none.
    **more
        `by_run`: in the colours of the runs. `halo`: each run's colour around the line. `dash`, `width`: of the line.
        `loose`: does not set the range of the axes. `candidate`: column of a candidate that is drawn over it.
        `about`: what the legend says of it.

    """
    return {"kind": "line", "y": y, "colour": colour, "name": name, "label": label, **more}


def dots(y: str, colour: str, name: str, label: str = "", **more: Any) -> dict[str, Any]:
    """Describe a layer: a point for every row.

    Parameters
    ----------
    y : str
        Name of the column.
    colour : str
        Design token.
    name : str
        Name under which the legend hides it, the same in all plots.
    label : str
        Text in the legend; "" for none.
    **more
        `by_run`: in the colours of the runs. `main`: its points are selected. `candidate` and `about`: as of `line`.

    """
    return {"kind": "dots", "y": y, "colour": colour, "name": name, "label": label, **more}


def band(low: str, high: str, name: str, label: str = "", colour: str = "band") -> dict[str, Any]:
    """Describe a layer: the area between two columns.

    Parameters
    ----------
    low, high : str
        Names of the columns.
    name : str
        Name under which the legend hides it.
    label : str
        Text in the legend; "" for none.
    colour : str
        Design token.

    """
    return {"kind": "band", "low": low, "high": high, "colour": colour, "name": name, "label": label}


def span(begin: float, end: float, name: str, label: str = "", **more: Any) -> dict[str, Any]:
    """Describe a layer: a shaded span of x.

    Parameters
    ----------
    begin, end : float
        Ends of the span, in the unit of the x axis.
    name : str
        Name under which the legend hides it; also its design token unless `colour` is given.
    label : str
        Text in the legend; "" for none.
    **more
        With `run`, the name of a run, the span is a bar at the bottom in the colour of that run.

    """
    return {"kind": "span", "from": begin, "to": end, "name": name, "label": label, "colour": name, **more}
