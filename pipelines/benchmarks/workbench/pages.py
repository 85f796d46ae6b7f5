"""Build the pages that are timed: five linked plots and a film, with frictrack and with Bokeh alone.

python pages.py ours 100000 5090
"""

from __future__ import annotations

import sys

import cv2
import numpy as np
import panel as pn
from bokeh.layouts import gridplot
from bokeh.models import BoxSelectTool, ColumnDataSource, Scatter
from bokeh.plotting import figure

from frictrack.workbench.panel_plots import PanelPlots
from frictrack.workbench.plot_data import PlotData, dots, plot

COLUMN_NAMES = ("t", "x", "v", "F", "phase")
FRAMES, WIDTH, HEIGHT = 4000, 640, 360


def columns(n: int) -> dict[str, np.ndarray]:
    """A slide with noise, n points in every column."""
    rng = np.random.default_rng(0)
    t = np.linspace(0, 1000, n)
    v = 5 - 4 * t / 1000
    found = {"t": t, "x": t * (5 - 2 * t / 1000), "v": v, "F": 8 + v + rng.normal(size=n), "phase": (t / 17) % 1}
    return found | {"left": np.sin(t / 30) + rng.normal(size=n)}


def frame(number: int) -> tuple[int, bytes]:
    """A picture with a block that moves."""
    picture = np.random.default_rng(number % 8).integers(60, 90, (HEIGHT, WIDTH), dtype=np.uint8)
    x = 20 + (WIDTH - 140) * number // FRAMES
    picture[150:210, x : x + 90] = 200
    return number, bytes(cv2.imencode(".jpg", picture)[1])


def ours(n: int) -> pn.Column:
    """Five of our plots and the film."""
    shown = [plot(f"against {name}", (name, name), "left", dots("left")) for name in COLUMN_NAMES]
    scene = PlotData(n, columns(n), shown, [{"name": "run", "first": 0, "count": n, "colour": "#0072b2"}])
    linked = PanelPlots(sizing_mode="stretch_width")
    linked.draw(scene)
    linked.film = {"frames": FRAMES, "width": WIDTH, "height": HEIGHT, "fps": 4000, "label": "run", "first": 0}
    linked.show_frame(frame(0))

    def selected(event: object) -> None:
        middle = linked.selection.get("middle")
        if middle is not None:
            linked.show_frame(frame(middle * FRAMES // n))

    linked.param.watch(selected, "selection")
    return pn.Column(linked, sizing_mode="stretch_width")


def bokeh(n: int) -> pn.Column:
    """Five of Bokeh's with one source: what is selected in one is selected in all."""
    source = ColumnDataSource(columns(n))
    charts = []
    for name in COLUMN_NAMES:
        chart = figure(width=400, height=230, tools="box_select,pan")
        chart.toolbar.active_drag = next(tool for tool in chart.tools if isinstance(tool, BoxSelectTool))
        drawn = chart.scatter(name, "left", source=source, size=2, color="#1a1a1a")
        drawn.selection_glyph = Scatter(size=2, fill_color="#d55e00", line_color="#d55e00")
        charts.append(chart)
    return pn.Column(pn.pane.Bokeh(gridplot(charts, ncols=2, toolbar_location=None)))


if __name__ == "__main__":
    kind, n, port = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    made = {"ours": ours, "bokeh": bokeh}[kind]
    pn.serve(lambda: made(n), port=port, address="127.0.0.1", show=False, websocket_origin=[f"127.0.0.1:{port}"])
