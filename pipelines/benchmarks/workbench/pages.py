"""Serve the bare page that is timed: five linked plots of many points, and a film.

python pages.py 100000 5090
"""

from __future__ import annotations

import sys
from functools import lru_cache, partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any

import cv2
import numpy as np

from frictrack.workbench.plot_data import PlotData, axis, dots, plot

QUANTITIES = ("t", "x", "v", "F", "phase")
FRAMES, WIDTH, HEIGHT = 4000, 640, 360
RUNS = 4
PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>timed</title>
<link rel="stylesheet" href="/tokens.css"><link rel="stylesheet" href="/plots/plots.css">
<style>body { margin: 0; display: grid; grid-template-columns: 400px 1fr; height: 100vh }
#film { height: 400px } #plots { min-height: 0 }</style>
<div id="film"></div><div id="plots"></div>
<script type="module">
import { FilmView, LinkedView, parsePacked, PlotGrid } from "/plots/index.js";
const frame = async (film, n) => createImageBitmap(await (await fetch(`/frame?n=${n}`)).blob());
const view = new LinkedView({ frame });
const { scene, columns } = parsePacked(await (await fetch("/scene")).arrayBuffer());
view.setScene(scene, columns);
const grid = new PlotGrid(document.querySelector("#plots"), view);
const film = new FilmView(document.querySelector("#film"), view);
const size = { width: WIDTH, height: HEIGHT, fps: 4000 };
film.setFilms(scene.runs.map(({ name, count }) => ({ run: name, frames: count, ...size })));
view.point(0, "key");
Object.assign(window, { view, grid, film, ready: true });
</script></html>"""


def scene(n: int) -> PlotData:
    """A slide with noise, n points in every one of five plots."""
    rng = np.random.default_rng(0)
    t = np.linspace(0, 1000, n)
    v = 5 - 4 * t / 1000
    columns = {"t": t, "x": t * (5 - 2 * t / 1000), "v": v, "F": 8 + v + rng.normal(size=n), "phase": (t / 17) % 1}
    columns |= {"left": np.sin(t / 30) + rng.normal(size=n)}
    layer = dots("left", "measured", "residual", "residual", by_run=True, main=True)
    shown = [plot(f"against {name}", axis(name, name, ""), ("left", "µm"), layer) for name in QUANTITIES]
    count = n // RUNS
    runs = [{"name": f"v{k + 1}", "first": k * count, "count": count, "index": k, "frame": 0} for k in range(RUNS)]
    return PlotData(n, columns, shown, runs)


@lru_cache(64)
def frame(number: int) -> bytes:
    """JPEG of a picture with a block that moves."""
    picture = np.random.default_rng(number % 8).integers(60, 90, (HEIGHT, WIDTH), dtype=np.uint8)
    x = 20 + (WIDTH - 140) * (number % FRAMES) // FRAMES
    picture[150:210, x : x + 90] = 200
    return bytes(cv2.imencode(".jpg", picture)[1])


class Handler(SimpleHTTPRequestHandler):
    """Static files of the workbench, the page, its data and frames."""

    protocol_version = "HTTP/1.1"

    def __init__(self, *args: Any, page: bytes, data: bytes, **more: Any) -> None:
        self.page, self.data = page, data
        super().__init__(*args, directory=str(files("frictrack.workbench").joinpath("static")), **more)

    def do_GET(self) -> None:
        path, _, query = self.path.partition("?n=")
        made = {"/": (self.page, "text/html"), "/scene": (self.data, "application/octet-stream")}
        if path == "/frame":
            self.answer(frame(int(query)), "image/jpeg")
        elif path in made:
            self.answer(*made[path])
        else:
            super().do_GET()

    def answer(self, body: bytes, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *args: Any) -> None:
        """Say nothing."""


if __name__ == "__main__":
    page = PAGE.replace("WIDTH", str(WIDTH)).replace("HEIGHT", str(HEIGHT)).encode()
    made = partial(Handler, page=page, data=scene(int(sys.argv[1])).pack())
    ThreadingHTTPServer(("127.0.0.1", int(sys.argv[2])), made).serve_forever()
