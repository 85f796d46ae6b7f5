"""The report on paper: the page printed to PDF by a browser of this machine, so that both look the same."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from frictrack.errors import FrictrackError
from frictrack.files import atomic_write

BROWSERS = (
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "microsoft-edge", "msedge"),
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Microsoft Edge.app/Contents/MacOS/Microsoft Edge",
    r"C:\Program Files\Google\Chrome\Application\chrome.exe",
    r"C:\Program Files (x86)\Microsoft\Edge\Application\msedge.exe",
)
OFFLINE = ("--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run")
PATIENCE = 120.0  # s that a browser may take; it takes two


def printed(page: Path) -> Path:
    """The PDF beside an HTML page, written whole or not at all.

    Raises `FrictrackError` where no Chromium, Chrome or Edge is installed, or where it fails.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise FrictrackError(
            f"expected Chromium, Chrome or Edge on this machine to print a PDF but found none; open {page} in any "
            "browser and print it from there"
        )
    sheet = page.with_suffix(".pdf")
    with atomic_write(sheet) as part, tempfile.TemporaryDirectory() as profile:
        words = [
            browser,
            "--headless",
            "--disable-gpu",
            *OFFLINE,
            f"--user-data-dir={profile}",
            "--no-pdf-header-footer",
        ]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            words.append("--no-sandbox")  # there is none for root; the page is our own
        words += [f"--print-to-pdf={part}", page.resolve().as_uri()]
        try:
            done = subprocess.run(words, capture_output=True, timeout=PATIENCE, check=False)
        except subprocess.TimeoutExpired as e:
            raise FrictrackError(f"{browser} did not print {page.name} within {PATIENCE:g} s") from e
        if done.returncode or not part.exists() or part.stat().st_size == 0:
            said = done.stderr.decode(errors="replace").strip().splitlines()
            raise FrictrackError(f"{browser} could not print {page.name}: {said[-1] if said else 'it gave no reason'}")
    return sheet
