"""Measure the response times of the workbench: first paint, selection to highlight, selection to frame.

    python pipelines/benchmarks/workbench [--points 100000] [--selections 40] [--study STUDY] [--json FILE]

Five plots of so many points each, in Chromium without a graphics card; the same selections in five charts of Bokeh that
share a source. With a STUDY that has a model: the time to the first paint of its workbench, and from Cancel to the end
of a search.
"""

from __future__ import annotations

import argparse
import json
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Page, sync_playwright

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from machine import described

PAGES = Path(__file__).with_name("pages.py")
ARGS = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
# From the release of the mouse to the last change of the other four plots, and to the film's new label, ms.
WATCH_SCRIPT = """([sources, quiet]) => {
    const all = (root, css, found = []) => {
        found.push(...root.querySelectorAll(css));
        for (const n of root.querySelectorAll("*")) if (n.shadowRoot) all(n.shadowRoot, css, found);
        return found;
    };
    const small = Object.assign(document.createElement("canvas"), {width: 40, height: 26}).getContext("2d",
        {willReadFrequently: true});
    const look = (c) => {
        small.clearRect(0, 0, 40, 26);
        small.drawImage(c, 0, 0, 40, 26);
        return small.getImageData(0, 0, 40, 26).data.reduce((h, v) => (h * 31 + v) | 0, 7);
    };
    const canvases = all(document, sources).filter((c) => c.width > 100);
    const label = () => (all(document, ".ft-label")[0] || {}).textContent;
    const started = canvases.map(look), before = label();
    window.timed = null;
    addEventListener("pointerup", () => {
        const t0 = performance.now(), last = canvases.map(look);
        let changed = null, film = null;
        const tick = () => {
            const now = performance.now() - t0, seen = canvases.map(look);
            if (seen.some((h, i) => h !== last[i])) { changed = now; seen.forEach((h, i) => { last[i] = h; }); }
            if (film === null && label() !== before) film = now;
            if (now < quiet) requestAnimationFrame(tick);
            else window.timed = { changed, film, plots: last.filter((h, i) => h !== started[i]).length };
        };
        requestAnimationFrame(tick);
    }, { once: true, capture: true });
}"""


@contextmanager
def served(*words: str) -> Iterator[int]:
    """A server in a process of its own, until it answers."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, *(word.replace("PORT", str(port)) for word in words)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while True:
            with socket.socket() as knock:
                if knock.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        yield port
    finally:
        process.kill()
        process.wait()


def selections(page: Page, plots: str, canvases: str, count: int, quiet: float) -> list[dict[str, Any]]:
    """Drag boxes over the first plot and read what they took."""
    box = page.locator(plots).first.bounding_box()
    assert box is not None
    rng, found = np.random.default_rng(1), []
    for k in range(count + 2):
        page.evaluate(WATCH_SCRIPT, [canvases, quiet])
        x = box["x"] + 80 + rng.uniform(0, 0.4) * (box["width"] - 100)
        page.mouse.move(x, box["y"] + 40)
        page.mouse.down()
        page.mouse.move(x + rng.uniform(30, 120), box["y"] + box["height"] - 60, steps=5)
        page.mouse.up()
        page.wait_for_function("window.timed !== null", timeout=60_000)
        timed = page.evaluate("window.timed")
        if k > 1:  # the first ones warm up
            found.append(timed)
    return found


def shares(values: list[float | None]) -> dict[str, float]:
    known = np.array([v for v in values if v is not None])
    ends = {"p95": float(np.percentile(known, 95)), "most": float(known.max()), "of": len(known)}
    return {"median": float(np.median(known)), **ends}


def said(kind: str, what: str, value: dict[str, float]) -> str:
    figures = "  ".join(f"{name} {value[name]:7.1f}" for name in ("median", "p95", "most"))
    return f"{kind:6} {what:13} {figures}  ({value['of']})"


def plots(n: int, count: int) -> dict[str, Any]:
    """Highlight and film of ours, highlight of Bokeh's, ms."""
    out: dict[str, Any] = {}
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), headless=True, args=ARGS)
        for kind, where, canvases, quiet, times in (
            ("ours", ".ft-plot", ".ft-plot canvas:nth-of-type(2)", 400, count),
            ("bokeh", ".bk-Canvas", "canvas", 4000, max(count // 8, 3)),
        ):
            with served(str(PAGES), kind, str(n), "PORT") as port:
                page = browser.new_page(viewport={"width": 1280, "height": 900})
                page.goto(f"http://127.0.0.1:{port}/")
                page.locator(where).nth(4).wait_for(timeout=120_000)
                page.wait_for_timeout(4000)
                timed = selections(page, where, canvases, times, quiet)
                out[kind] = {"highlight_ms": shares([t["changed"] for t in timed])}
                if kind == "ours":
                    out[kind]["film_ms"] = shares([t["film"] for t in timed])
                page.close()
        browser.close()
    out["ratio"] = out["bokeh"]["highlight_ms"]["median"] / out["ours"]["highlight_ms"]["median"]
    return out


def app(study: Path) -> dict[str, float]:
    """First paint of a study's workbench, and from Cancel to the end of a search, s."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        copy = Path(folder) / "study"
        shutil.copytree(study, copy)
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), headless=True, args=ARGS)
        with served("-m", "frictrack", "app", str(copy), "--no-browser", "--port", "PORT") as port:
            paints, ends = [], []
            for seed in range(101, 106):  # a search that was not made yet
                page = browser.new_page(viewport={"width": 1280, "height": 900})
                began = time.perf_counter()
                page.goto(f"http://127.0.0.1:{port}/")
                page.get_by_text("1 Film", exact=True).wait_for()
                paints.append(time.perf_counter() - began)
                page.get_by_text("3 Model", exact=True).click()
                page.get_by_label("Search").select_option("sga")
                page.get_by_label("Seed").fill(str(seed))
                page.get_by_label("Seed").press("Tab")
                page.get_by_role("button", name="Fit", exact=True).click()
                page.get_by_text("sga: misfit").first.wait_for(timeout=60_000)
                began = time.perf_counter()
                page.get_by_role("button", name="Cancel", exact=True).click()
                page.locator(".ft-message", has_text="cancelled").wait_for()
                ends.append(time.perf_counter() - began)
                page.close()
        browser.close()
    return {"first_paint_s": max(paints[1:]), "first_paint_cold_s": paints[0], "cancel_s": max(ends)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--selections", type=int, default=40)
    parser.add_argument("--study", type=Path, help="folder of a study with a model, copied before it is used")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found: dict[str, Any] = {"machine": described("panel", "bokeh"), "points": args.points}
    found["plots"] = plots(args.points, args.selections)
    for kind in ("ours", "bokeh"):
        for what, value in found["plots"][kind].items():
            print(said(kind, what, value))
    print(f"Bokeh's charts take {found['plots']['ratio']:.0f} times as long")
    if args.study:
        found["app"] = app(args.study)
        print("  ".join(f"{name} {value:.2f}" for name, value in found["app"].items()))
    if args.json:
        args.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
