"""Print an HTML page to PDF with a browser of this machine, so that both look the same."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from frictrack.base.errors import FrictrackError
from frictrack.base.files import atomic_write

BROWSERS = (
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "microsoft-edge", "msedge"),
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Microsoft Edge.app/Contents/MacOS/Microsoft Edge",
    r"C:\Program Files\Google\Chrome\Application\chrome.exe",
    r"C:\Program Files (x86)\Microsoft\Edge\Application\msedge.exe",
)
OFFLINE = ("--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run")
MAX_PRINT_SECONDS = 120.0  # a browser usually takes two seconds


def print_pdf(page: Path) -> Path:
    """Print an HTML page to a PDF file of the same name, completely or not at all.

    Parameters
    ----------
    page : Path
        The HTML file.

    Returns
    -------
    Path
        The PDF file.

    Raises
    ------
    FrictrackError
        If no Chromium, Chrome or Edge is installed, or if it fails.

    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise FrictrackError(
            f"expected Chromium, Chrome or Edge on this machine to print a PDF but found none; open {page} in any "
            "browser and print it from there"
        )
    target = page.with_suffix(".pdf")
    with atomic_write(target) as part, tempfile.TemporaryDirectory() as profile:
        command = [
            browser,
            "--headless",
            "--disable-gpu",
            *OFFLINE,
            f"--user-data-dir={profile}",
            "--no-pdf-header-footer",
        ]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            command.append("--no-sandbox")  # Chromium has no sandbox for root; the page is our own
        command += [f"--print-to-pdf={part}", page.resolve().as_uri()]
        try:
            done = subprocess.run(command, capture_output=True, timeout=MAX_PRINT_SECONDS, check=False)
        except subprocess.TimeoutExpired as e:
            raise FrictrackError(f"{browser} did not print {page.name} within {MAX_PRINT_SECONDS:g} s") from e
        if done.returncode or not part.exists() or part.stat().st_size == 0:
            lines = done.stderr.decode(errors="replace").strip().splitlines()
            raise FrictrackError(
                f"{browser} could not print {page.name}: {lines[-1] if lines else 'it gave no reason'}"
            )
    return target
