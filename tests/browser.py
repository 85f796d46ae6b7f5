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
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from playwright.sync_api import Error, sync_playwright

CHROMIUM = next((p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p), None)
ARGS = [
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
]
HERE = re.compile(r"(https?|wss?)://(127\.0\.0\.1|localhost)[:/]|data:|blob:")
TOKEN = "open-sesame"
LIMIT_S = 120.0  # that anything may take on a busy machine


@dataclass
class Tab:
    """One tab of the browser, and all that it asked for and complained of."""

    page: Any
    faults: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.page.set_default_timeout(1000 * LIMIT_S)
        self.page.on("request", lambda r: HERE.match(r.url) or self.faults.append(f"asked {r.url}"))
        self.page.on("pageerror", lambda e: self.faults.append(f"error {e}"))
        self.page.on(
            "response", lambda r: r.status < 400 or "favicon" in r.url or self.faults.append(f"{r.status} {r.url}")
        )

    def open(self, server: Any) -> Tab:
        self.page.goto(server.address)
        self.page.get_by_role("tab", name="Film").wait_for()
        return self

    def to(self, title: str) -> Tab:
        self.page.get_by_role("tab", name=title, exact=True).click()
        return self

    def button(self, name: str | re.Pattern[str]) -> Any:
        """The button of this name."""
        return self.page.get_by_role("button", name=name, exact=isinstance(name, str)).first

    def click(self, name: str | re.Pattern[str]) -> Tab:
        self.button(name).click()
        return self

    def fill(self, label: str, text: str, *, enter: bool = True) -> Tab:
        """Type into the box of this label, and write it with Enter."""
        box = self.page.get_by_label(label, exact=True)
        box.fill(text)
        if enter:
            box.press("Enter")
        return self

    def hears(self, words: str | re.Pattern[str]) -> str:
        """Wait until the page says so in its status bar or in a banner."""
        line = self.page.locator(".ui-message, .ui-banner", has_text=words).first
        line.wait_for()
        said: str = line.inner_text()
        return said

    def sees(self, words: str | re.Pattern[str]) -> None:
        self.page.get_by_text(words).locator("visible=true").first.wait_for()

    def idle(self) -> None:
        """Wait until the page has no work that holds the user up."""
        self.page.locator(".ui-progress").wait_for(state="detached")

    def drag_on_film(self, begin: tuple[float, float], end: tuple[float, float]) -> None:
        """Over the picture of the film, from and to shares of its width and height."""
        box = self.page.locator(".fp-picture").bounding_box()
        assert box is not None
        points = [(box["x"] + u * box["width"], box["y"] + v * box["height"]) for u, v in (begin, end)]
        self.page.mouse.move(*points[0])
        self.page.mouse.down()
        self.page.mouse.move(*points[1], steps=5)
        self.page.mouse.up()

    def drag(self, plot: int, *, key: str = "") -> None:
        """Over the middle of a plot, with a key held down."""
        box = self.page.locator(".fp-plot").nth(plot).bounding_box()
        assert box is not None
        x, y, w, h = box["x"] + 74, box["y"] + 24, box["width"] - 84, box["height"] - 60
        if key:
            self.page.keyboard.down(key)
        self.page.mouse.move(x + 0.4 * w, y + 2)
        self.page.mouse.down()
        self.page.mouse.move(x + 0.6 * w, y + h - 2, steps=5)
        self.page.mouse.up()
        if key:
            self.page.keyboard.up(key)

    def until(self, true: Callable[[], bool]) -> None:
        """Wait until something holds; an element that is drawn anew just now does not hold yet."""
        for _ in range(int(LIMIT_S / 0.2)):
            with suppress(Error):
                if true():
                    return
            self.page.wait_for_timeout(200)
        assert true()

    def picture(self, name: str) -> None:
        if folder := os.environ.get("FRICTRACK_ARTEFACTS"):
            Path(folder).mkdir(parents=True, exist_ok=True)
            self.page.screenshot(path=Path(folder) / f"{name}.png", full_page=True)


@dataclass
class Server:
    """The server of the page in a process of its own."""

    study: Path
    more: tuple[str, ...] = ()
    process: subprocess.Popen[bytes] | None = None
    paths: str = ""  # where it looks for programs before all others
    port: int = 0
    token: str = TOKEN  # a new one where it is empty
    log: Path | None = None  # what it writes to the terminal

    def start(self) -> Server:
        if not self.port:
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                self.port = free.getsockname()[1]
        words = [sys.executable, "-m", "frictrack", "app", str(self.study), "--no-browser", "--port", str(self.port)]
        with (self.log or Path(os.devnull)).open("ab") as out:
            self.process = subprocess.Popen([*words, *self.more], stderr=out, stdout=out, env=self.environment)
        until = time.monotonic() + LIMIT_S
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
        return {
            **os.environ,
            "FRICTRACK_TOKEN": self.token,
            "PATH": os.pathsep.join(filter(None, (self.paths, os.environ["PATH"]))),
        }

    @property
    def study_text(self) -> str:
        """The study file as it is now; empty before it is written."""
        file = self.study if self.study.is_file() else self.study / "study.toml"
        return file.read_text(encoding="utf-8") if file.exists() else ""

    @property
    def bare_address(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    @property
    def address(self) -> str:
        return f"{self.bare_address}?token={self.token}"


Open = Callable[[], Tab]
Serve = Callable[..., Server]  # takes a study file or folder, and the options of Server


@contextmanager
def browser() -> Iterator[Any]:
    """Chromium."""
    with sync_playwright() as driver:
        one = driver.chromium.launch(executable_path=CHROMIUM, headless=True, args=ARGS)
        yield one
        one.close()
