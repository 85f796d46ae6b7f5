"""A click on the page is never lost, however soon after an edit it comes and however slow the server is."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import CHROMIUM, Open, Server, Tab

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")
FILM = Path(__file__).parent.parent / "sample_videos" / "slow.avi"
SLOW_SOCKET = """const Socket = WebSocket;
window.WebSocket = class extends Socket {
    set onmessage(f) { super.onmessage = (e) => setTimeout(() => f(e), 6000); }
};"""


@pytest.fixture
def film(tmp_path: Path) -> Iterator[Server]:
    """A folder with one film and nothing else."""
    shutil.copy(FILM, tmp_path)
    server = Server(tmp_path).start()
    yield server
    server.stop()


def commands(page: Tab, address: str) -> list[dict[str, Any]]:
    """Collect what the page asks of an address."""
    asked: list[dict[str, Any]] = []
    page.page.on("request", lambda r: asked.append(json.loads(r.post_data)) if r.url.endswith(address) else None)
    return asked


def typed(page: Tab, film: Server) -> Tab:
    """Open the page, use the film, and type what is needed; the last box has the focus still."""
    page.open(film).click("Use this recording")
    for label, text in (("Mass", "0.35 kg"), ("Frame rate", "4000"), ("Scale", "0.5 mm/px")):
        page.fill(label, text, enter=False)
    return page


def refuse(route: Any) -> None:
    route.fulfill(status=400, json={"error": "expected another number"})


def test_run_runs_although_the_server_is_slow_to_tell_of_what_was_typed(film: Server, tab: Open) -> None:
    page = tab()
    page.page.add_init_script(SLOW_SOCKET)
    jobs = commands(page, "/api/job")
    typed(page, film).click("Run")
    page.until(lambda: bool(jobs))
    assert jobs[0]["do"] == "run"
    page.page.locator("#tab-compare[aria-selected=true]").wait_for()


def test_undo_takes_back_what_was_typed_just_before(film: Server, tab: Open) -> None:
    page = tab().open(film).click("Use this recording")
    page.page.locator("button[title='Nothing to undo']").wait_for()
    page.fill("Mass", "0.35 kg", enter=False)
    page.button("Undo").click(force=True)  # it says still that there is nothing to undo
    page.hears("Undone: set the mass")


def test_a_button_stays_under_a_mouse_button_that_is_down(film: Server, tab: Open) -> None:
    page = tab()
    jobs = commands(typed(page, film), "/api/job")
    page.until(lambda: "fps = 4000" in film.study_text and 'mass = "0.35 kg"' in film.study_text)
    page.page.wait_for_timeout(1500)  # the film is shown, and nothing moves any more
    page.page.route("**/api/do", refuse)
    page.button("Track every film").hover()
    page.page.mouse.down()  # the scale is sent; a banner with the refusal moves the button down
    page.page.wait_for_timeout(500)
    page.page.mouse.up()
    page.until(lambda: bool(jobs))
    assert jobs[0]["do"] == "measure"
    page.faults.clear()


def test_run_runs_nothing_if_what_was_typed_is_refused(film: Server, tab: Open) -> None:
    page = typed(tab(), film)
    page.page.get_by_label("Scale").press("Enter")
    page.until(lambda: "0.5 mm/px" in film.study_text)
    jobs = commands(page, "/api/job")
    page.page.route("**/api/do", refuse)
    page.fill("Mass", "0.36 kg", enter=False)
    page.click("Run").hears("expected another number")
    page.page.wait_for_timeout(1000)
    assert not jobs
    page.faults.clear()
