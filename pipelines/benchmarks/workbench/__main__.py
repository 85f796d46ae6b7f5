"""Measure the response times of the workbench: selection to highlight, selection to frame, first paint, memory.

    python pipelines/benchmarks/workbench [--points 100000] [--selections 40] [--study STUDY] [--json FILE]

Five plots of so many points each, in Chromium without a graphics card; once with a quiet machine and once while a
process computes on every core. Then 10 000 selections, and what they leave in memory. With a STUDY, the time to the
first paint of its workbench.
"""

from __future__ import annotations

import argparse
import json
import os
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
from playwright.sync_api import Browser, Page, sync_playwright

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from machine import described

PAGES = Path(__file__).with_name("pages.py")
ARGS = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
BUSY = "while True: pass"
QUIET_MS = 600  # after the release of the mouse, until nothing changes any more
# From the release of the mouse to the last change of the other four plots, and to the frame of the film, ms.
WATCH_SCRIPT = """(quiet) => {
    const small = new OffscreenCanvas(40, 26).getContext("2d", {willReadFrequently: true});
    const look = (c) => {
        small.clearRect(0, 0, 40, 26);
        small.drawImage(c, 0, 0, 40, 26);
        return small.getImageData(0, 0, 40, 26).data.reduce((h, v) => (h * 31 + v) | 0, 7);
    };
    const canvases = [...document.querySelectorAll(".fp-plot .fp-marks")], label = document.querySelector(".fp-label");
    const cursor = () => {
        const words = ` \u00b7 ${document.querySelector(".fp-words").textContent}`;
        const found = / \u00b7 ([^\u00b7]*?), frame ([0-9]+)/.exec(words);
        return found ? `${found[1]} \u00b7 frame ${found[2]} ` : "none";
    };
    const started = canvases.map(look), last = [...started], before = cursor();
    window.timed = null;
    addEventListener("pointerup", () => {
        const t0 = performance.now();
        let changed = null, film = null;
        const tick = () => {
            const now = performance.now() - t0, seen = canvases.map(look);
            if (seen.some((h, i) => h !== last[i])) { changed = now; seen.forEach((h, i) => { last[i] = h; }); }
            if (film === null && cursor() !== before && label.textContent.startsWith(cursor())) film = now;
            if (now < quiet) requestAnimationFrame(tick);
            else window.timed = { changed, film, plots: last.filter((h, i) => h !== started[i]).length };
        };
        requestAnimationFrame(tick);
    }, { once: true, capture: true });
}"""
SELECT_SCRIPT = """async (count) => {
    const tops = [...document.querySelectorAll(".fp-plot .fp-top")];
    for (let i = 0; i < count; i++) {
        const top = tops[i % 5], box = top.getBoundingClientRect(), x = box.x + 90 + (i * 37) % (box.width - 200);
        const send = (type, clientX, clientY) =>
            top.dispatchEvent(new PointerEvent(type, { clientX, clientY, pointerId: 1 }));
        top.setPointerCapture = () => {};
        send("pointerdown", x, box.y + 40);
        send("pointermove", x + 60, box.y + box.height - 60);
        send("pointerup", x + 60, box.y + box.height - 60);
        if (i % 10 === 9) await new Promise(requestAnimationFrame);
    }
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


@contextmanager
def busy_cores(count: int) -> Iterator[None]:
    """A process that computes on each of so many cores."""
    processes = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def selections(page: Page, count: int) -> list[dict[str, Any]]:
    """Drag boxes quickly over the first plot, and read when the other plots and the film had changed."""
    box = page.locator(".fp-plot").first.bounding_box()
    assert box is not None
    rng, found = np.random.default_rng(1), []
    for k in range(count + 2):
        x = box["x"] + 80 + rng.uniform(0, 0.4) * (box["width"] - 100)
        page.mouse.move(x, box["y"] + 40)
        page.wait_for_timeout(300)  # the film has followed the mouse
        page.evaluate(WATCH_SCRIPT, QUIET_MS)
        page.mouse.down()
        page.mouse.move(x + rng.uniform(30, 120), box["y"] + box["height"] - 60)
        page.mouse.up()
        page.wait_for_function("window.timed !== null", timeout=60_000)
        if k > 1:  # the first ones warm up
            found.append(page.evaluate("window.timed"))
    return found


def quantiles(values: list[float | None]) -> dict[str, float]:
    known = np.array([v for v in values if v is not None])
    ends = {"p95": float(np.percentile(known, 95)), "largest": float(known.max()), "n": len(known)}
    return {"median": float(np.median(known)), **ends}


def times(name: str, timed: list[dict[str, Any]]) -> dict[str, Any]:
    """Print and return the times of the highlight and of the film, ms."""
    out = {"highlight_ms": quantiles([t["changed"] for t in timed]), "film_ms": quantiles([t["film"] for t in timed])}
    for what, value in out.items():
        figures = "".join(f"{value[key]:9.1f}" for key in ("median", "p95", "largest"))
        print(f"{name:6} {what:13}{figures}", flush=True)
    return out


def heap_mb(page: Page) -> float:
    """Memory of the page after garbage collection, MB."""
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.enable")
    session.send("HeapProfiler.collectGarbage")
    return float(session.send("Runtime.getHeapUsage")["usedSize"]) / 1e6


def plots(browser: Browser, n: int, count: int) -> dict[str, Any]:
    """Highlight and film, ms, quiet and busy; growth of the memory, MB."""
    out: dict[str, Any] = {}
    with served(str(PAGES), str(n), "PORT") as port:
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.goto(f"http://127.0.0.1:{port}/")
        page.wait_for_function("window.ready && document.querySelector('.fp-label').textContent")
        page.wait_for_timeout(1000)
        for name, cores in (("quiet", 0), ("busy", os.cpu_count() or 1)):
            with busy_cores(cores):
                timed = selections(page, count)
            out[name] = times(name, timed)
        page.evaluate(SELECT_SCRIPT, 500)
        before = heap_mb(page)
        page.evaluate(SELECT_SCRIPT, 10_000)
        out["growth_mb"] = heap_mb(page) - before
        print(f"memory after 10 000 selections: {out['growth_mb']:+.1f} MB", flush=True)
        page.close()
    return out


def first_paint(browser: Browser, study: Path, count: int) -> dict[str, Any]:
    """First paint of a study's workbench, and until its plots are drawn, s; highlight and film of its own data, ms."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "study"
        shutil.copytree(study.parent if study.is_file() else study, copy)
        paints, drawn = [], []
        os.environ["FRICTRACK_TOKEN"] = "timed"
        with served("-m", "frictrack", "app", str(copy), "--no-browser", "--port", "PORT") as port:
            for _ in range(6):
                page = browser.new_page(viewport={"width": 1440, "height": 900})
                page.goto(f"http://127.0.0.1:{port}/?token=timed")
                page.locator(".fp-plot").first.wait_for(timeout=60_000)
                paint = "performance.getEntriesByName('first-contentful-paint')[0].startTime"
                paints.append(page.evaluate(paint) / 1e3)
                drawn.append(page.evaluate("performance.now()") / 1e3)
                page.close()
            page = browser.new_page(viewport={"width": 1440, "height": 900}, bypass_csp=True)  # for `wait_for_function`
            page.goto(f"http://127.0.0.1:{port}/?token=timed")
            page.get_by_role("tab", name="Compare").click()
            page.locator(".fp-plot").nth(4).wait_for(timeout=60_000)
            page.wait_for_timeout(2000)
            timed = selections(page, count)
            page.close()
    out = {"first_paint_s": max(paints[1:]), "first_paint_cold_s": paints[0], "plots_drawn_s": max(drawn[1:])}
    print("  ".join(f"{what} {seconds:.2f}" for what, seconds in out.items()), flush=True)
    return out | times("study", timed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--selections", type=int, default=40)
    parser.add_argument("--study", type=Path, help="folder or file of a study with a model; its folder is copied")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    found: dict[str, Any] = {"machine": described("tornado"), "points": args.points}
    print(f"{'':20}{'median':>9}{'p95':>9}{'largest':>9}")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), headless=True, args=ARGS)
        found["plots"] = plots(browser, args.points, args.selections)
        if args.study:
            found["page"] = first_paint(browser, args.study, args.selections)
        browser.close()
    if args.json:
        args.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
