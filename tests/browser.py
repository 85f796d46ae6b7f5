"""A tab of a real browser for the tests: every request of every page is logged, and none may leave the machine."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

CHROMIUM = next((p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p), None)
ARGS = [
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
]
INK = """(plots, [r, g, b, k]) => plots.map((plot) => {
    const c = plot.querySelectorAll("canvas")[k], d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
    let n = 0;
    for (let i = 0; i < d.length; i += 4) n += d[i] === r && d[i + 1] === g && d[i + 2] === b;
    return n;
})"""
HERE = re.compile(r"(https?|wss?)://(127\.0\.0\.1|localhost)[:/]|data:|blob:")
TOKEN = "open-sesame"
SLOW = 120_000  # ms that work may take on a busy machine


@dataclass
class Tab:
    """One tab of the browser, and all that it asked for and complained of."""

    page: Any
    faults: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.page.on("request", lambda r: HERE.match(r.url) or self.faults.append(f"asked {r.url}"))
        self.page.on("pageerror", lambda e: self.faults.append(f"error {e}"))
        self.page.on(
            "response", lambda r: r.status < 400 or "favicon" in r.url or self.faults.append(f"{r.status} {r.url}")
        )

    def open(self, server: Any) -> Tab:
        self.page.goto(server.address)
        self.page.get_by_text("1 Film", exact=True).wait_for()
        return self

    def to(self, title: str) -> Tab:
        self.page.get_by_text(title, exact=True).click()
        return self

    def click(self, name: str) -> Tab:
        self.page.get_by_role("button", name=name, exact=True).click()
        return self

    def hears(self, words: str, within: int = SLOW) -> str:
        """Wait until the page says so in its status line."""
        line = self.page.locator(".ft-message", has_text=words)
        line.wait_for(timeout=within)
        return line.inner_text()

    def sees(self, words: str | re.Pattern[str], within: int = SLOW) -> None:
        self.page.get_by_text(words).first.wait_for(timeout=within)

    def drag(self, plot: int, *, shift: bool = False) -> None:
        """Over the middle of a plot."""
        box = self.page.locator(".ft-plot").nth(plot).bounding_box()
        assert box is not None
        x, y, w, h = box["x"] + 74, box["y"] + 24, box["width"] - 84, box["height"] - 60
        if shift:
            self.page.keyboard.down("Shift")
        self.page.mouse.move(x + 0.4 * w, y + 2)
        self.page.mouse.down()
        self.page.mouse.move(x + 0.6 * w, y + h - 2, steps=5)
        self.page.mouse.up()
        if shift:
            self.page.keyboard.up("Shift")

    def until(self, true: Callable[[], bool]) -> None:
        """Wait until something holds."""
        for _ in range(100):
            if true():
                return
            self.page.wait_for_timeout(200)
        assert true()

    def ink(self, colour: tuple[int, int, int], layer: int = 1) -> list[int]:
        """Pixels of a colour in every plot, on top of it (1) or below (0)."""
        found: list[int] = self.page.locator(".ft-plot").evaluate_all(INK, [*colour, layer])
        return found

    def picture(self, name: str) -> None:
        if folder := os.environ.get("FRICTRACK_ARTEFACTS"):
            Path(folder).mkdir(parents=True, exist_ok=True)
            self.page.screenshot(path=Path(folder) / f"{name}.png", full_page=True)


@dataclass
class Server:
    """A workbench that runs in a process of its own."""

    study: Path
    more: tuple[str, ...] = ()
    process: subprocess.Popen[bytes] | None = None
    paths: str = ""  # where it looks for programs before all others
    port: int = 0
    token: str = TOKEN  # a new one where it is empty

    def start(self) -> Server:
        if not self.port:
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                self.port = free.getsockname()[1]
        words = [sys.executable, "-m", "frictrack", "app", str(self.study), "--no-browser", "--port", str(self.port)]
        words += ["--token", self.token] if self.token else []
        self.process = subprocess.Popen(
            [*words, *self.more], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL, env=self.environment
        )
        until = time.monotonic() + 60
        while time.monotonic() < until:
            with socket.socket() as knock:
                if knock.connect_ex(("127.0.0.1", self.port)) == 0:
                    return self
            time.sleep(0.1)
        raise AssertionError("the server did not start")

    def stop(self, how: int = signal.SIGTERM) -> None:
        assert self.process is not None
        self.process.send_signal(how)
        self.process.wait(20)

    @property
    def environment(self) -> dict[str, str]:
        return {**os.environ, "PATH": os.pathsep.join(filter(None, (self.paths, os.environ["PATH"])))}

    @property
    def bare_address(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    @property
    def address(self) -> str:
        return f"{self.bare_address}?token={self.token}"


Open = Callable[[], Tab]


@contextmanager
def browser() -> Iterator[Any]:
    """Chromium."""
    with sync_playwright() as driver:
        one = driver.chromium.launch(executable_path=CHROMIUM, headless=True, args=ARGS)
        yield one
        one.close()
