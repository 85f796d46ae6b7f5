"""A bare page with the linked plots, legend and film over synthetic data of known truth, and its server."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from frictrack.workbench.plot_data import PlotData, axis, band, dots, line, plot, span

STATIC = Path(str(files("frictrack.workbench").joinpath("static")))
RUNS = ("v1", "v2", "v3")
FRAMES_BEFORE = 10  # frames of each film before the motion begins
WIDTH, HEIGHT = 320, 120  # of the films, px
TIME = axis("t", "time", "ms")
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Linked plots</title>
<link rel="stylesheet" href="/tokens.css"><link rel="stylesheet" href="/plots/plots.css">
<style>
body { display: grid; grid-template: "legend legend" auto "film plots" 1fr / 34% 1fr; height: 100vh; gap: 8px }
body { margin: 0; background: var(--ft-paper) }
#legend { grid-area: legend } #film { grid-area: film; height: 420px } #plots { grid-area: plots; min-height: 0 }
</style></head>
<body><div id="legend"></div><div id="film"></div><div id="plots"></div>
<script type="module">
import { FilmView, Legend, LinkedView, parsePacked, PlotGrid } from "/plots/index.js";
const film = (run) => ({ run, frames: COUNT + 10, width: 320, height: 120, fps: 1000, version: "1",
  suspect: [{ from: 50, to: 60, words: "poor match" }], repairs: [{ from: 80, to: 90, how: "track" }], shapes: {} });
// A picture whose brightness is the number of the frame; the first pixel tells the run.
async function frame(film, n) {
  window.asked = (window.asked || 0) + 1;
  const pen = new OffscreenCanvas(320, 120).getContext("2d");
  pen.fillStyle = `rgb(${n % 256}, ${Number(film.run.slice(1))}, 60)`;
  pen.fillRect(0, 0, 320, 120);
  pen.fillStyle = "#ddd";
  pen.fillRect((200 * n) / film.frames, 40, 40, 40);
  return createImageBitmap(pen.canvas);
}
const view = new LinkedView({ frame }), told = {};
const names = ["selection", "cursor", "moved", "drawn", "hidden", "range", "layout"];
for (const name of names) view.on(name, (value) => { told[name] = value; });
window.load = async (query) => {
  const { scene, columns } = parsePacked(await (await fetch(`/scene.bin${query}`)).arrayBuffer());
  view.setScene(scene, columns);
};
const params = new URLSearchParams(location.search);
await load(location.search || "?");
const grid = new PlotGrid(document.querySelector("#plots"), view, { large: params.get("large") });
const legend = new Legend(document.querySelector("#legend"), view);
const filmView = new FilmView(document.querySelector("#film"), view);
filmView.setFilms(["v1", "v2", "v3"].map(film));
filmView.setFilm(film("v1"));
Object.assign(window, { view, grid, legend, filmView, told, ready: true });
</script></body></html>"""


def columns(count: int, size: float = 1.0, seed: int = 0) -> dict[str, np.ndarray]:
    """Three runs of `count` frames: a slide that slows down, and a residual with a hump that its size scales."""
    rng, found = np.random.default_rng(seed), []
    for k in range(len(RUNS)):
        t = np.linspace(0, 100, count)
        v = 3 + 0.3 * k - 0.02 * t
        x = 3 * t + 0.15 * k * t - 0.01 * t**2
        force = 1.2 + 0.4 * v
        hump = size * (5 * np.exp(-(((t - 60) / 8) ** 2)) + rng.normal(size=count))
        parts = {"t": t, "x": x, "v": v, "left": hump, "F": force + 0.1 * rng.normal(size=count), "F_model": force}
        parts |= {"noise_low": np.full(count, -2.0 * size), "noise_high": np.full(count, 2.0 * size)}
        found.append({key: value.astype("f4").astype(float) for key, value in parts.items()})
    joined = {key: np.concatenate([part[key] for part in found]) for key in found[0]}
    for name in RUNS:
        frames = np.arange(count + FRAMES_BEFORE)
        joined[f"x:{name}"], joined[f"y:{name}"] = 20 + 200 * frames / len(frames), np.full(len(frames), 60.0)
    return joined


def scene(count: int, size: float = 1.0, seed: int = 0) -> PlotData:
    """Five linked plots of three runs."""
    left = dots("left", "measured", "residual", "residual", by_run=True, main=True, candidate="with")
    noise = band("noise_low", "noise_high", "noise", "noise")
    fails = span(55, 65, "fails", "model fails", run="v2", colour="warn")
    forces = [
        line("F", "measured", "measured", "measured", width=1, by_run=True),
        line("F_model", "model", "model", "model", width=2, halo=True, candidate="F_with"),
    ]
    shown = [
        plot("Residual against time", TIME, ("residual", "µm"), fails, noise, left),
        plot("Residual against place", axis("x", "displacement", "mm"), ("residual", "µm"), noise, left),
        plot("Residual against velocity", axis("v", "velocity", "m/s"), ("residual", "µm"), noise, left),
        plot("Force against time", TIME, ("F", "N"), *forces, brush="x", handles=[{"name": "free", "span": [10, 90]}]),
        plot(
            "Force against velocity",
            axis("v", "velocity", "m/s"),
            ("F", "N"),
            dots("F", "measured", "measured", "measured", by_run=True),
            dots("F_model", "model", "model", "model", candidate="F_with"),
        ),
    ]
    runs = [
        {"name": name, "first": k * count, "count": count, "index": k, "frame": FRAMES_BEFORE}
        | {"tracks": [{"name": "target", "x": f"x:{name}", "y": f"y:{name}", "w": 40, "h": 40}]}
        for k, name in enumerate(RUNS)
    ]
    return PlotData(count * len(RUNS), columns(count, size, seed), shown, runs, {"view": "compare"})


class Handler(SimpleHTTPRequestHandler):
    """Static files of the page, the harness, and scenes."""

    def __init__(self, *args: Any, count: int, **more: Any) -> None:
        self.count = count
        super().__init__(*args, directory=str(STATIC), **more)

    def do_GET(self) -> None:
        path, _, query = self.path.partition("?")
        options = dict(pair.split("=") for pair in query.split("&") if "=" in pair)
        if path == "/":
            self.answer(PAGE.replace("COUNT", str(self.count)).encode(), "text/html")
        elif path == "/scene.bin":
            size, seed = float(options.get("size", 1)), int(options.get("seed", 0))
            self.answer(scene(self.count, size, seed).pack(), "application/octet-stream")
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


@contextmanager
def served(count: int) -> Iterator[str]:
    """Address of the harness with three runs of `count` frames."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, count=count))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
