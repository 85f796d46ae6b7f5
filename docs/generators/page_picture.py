"""Draw the picture of the page for the documentation: `python docs/generators/page_picture.py`."""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image

import frictrack as ft
from frictrack.flow import Session, open_study

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from browser import Server, browser

PICTURE = Path(__file__).parents[1] / "_static" / "page.png"
SIZE = {"width": 1280, "height": 800}
PATIENCE_MS = 300_000  # on a busy machine


def main() -> None:
    """Run the sample study, and draw the page with the curve of the best candidate."""
    with tempfile.TemporaryDirectory() as folder:
        study = ft.samples.copy_films(folder)
        Session(open_study(study)).run()
        server = Server(study).start()
        with browser() as chromium:
            page = chromium.new_page(viewport=SIZE)
            page.goto(server.address)
            page.get_by_role("tab", name="Compare").click()
            card = page.locator('[data-candidate="patch"]')
            for _ in range(2):  # again when the column is complete: what is above a card moves it
                page.mouse.move(0, 0)
                card.hover(timeout=PATIENCE_MS)
                card.locator(".ui-errors").filter(has_text="with it").wait_for(timeout=PATIENCE_MS)
                page.wait_for_timeout(5000)  # until it is drawn
            picture = Image.open(io.BytesIO(page.screenshot()))
        picture.convert("RGB").save(PICTURE, optimize=True)
        server.stop()


if __name__ == "__main__":
    main()
