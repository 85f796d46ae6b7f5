"""The page in a real browser: films first, numbers as they are read, and nothing on it that is not true.

Screenshots go to `FRICTRACK_ARTEFACTS`, when set.
"""

from __future__ import annotations

import json
import re
import shutil
import signal
import tomllib
from pathlib import Path
from typing import Any

import pytest
from browser import CHROMIUM, Open, Serve, Server, Tab

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")
SAMPLES = Path(__file__).parent.parent / "sample_videos"
STUDY = """# the quickest film of the samples
[study]
name = "one film"
mass = "0.35 kg"
model = "tustin"

[camera]
fps = 4000
scale = "0.5 mm/px"

[[run]]
name = "fast"
video = "fast.avi"
"""
TARGET = re.compile(r"target = \[[\d., ]+\]")


@pytest.fixture
def film(tmp_path: Path, serve: Serve) -> Server:
    """A folder with one film and nothing else."""
    shutil.copy(SAMPLES / "fast.avi", tmp_path)
    return serve(tmp_path, log=tmp_path / "server.log")


@pytest.fixture
def untracked(tmp_path: Path, serve: Serve) -> Server:
    """A complete study of one film before any work."""
    shutil.copy(SAMPLES / "fast.avi", tmp_path)
    study = tmp_path / "study.toml"
    study.write_text(STUDY, encoding="utf-8")
    return serve(study, log=tmp_path / "server.log")


def film_shown(page: Tab) -> None:
    page.page.locator(".fp-label", has_text=re.compile(r"frame \d+ of 150")).wait_for()


# --- films first


def test_films_play_and_a_ruler_is_drawn_before_any_number_is_typed(film: Server, tab: Open) -> None:
    page = tab().open(film)
    page.click("Use this recording")
    film_shown(page)
    page.picture("1_film_first")
    page.click("Play")
    page.until(lambda: "frame 0 of" not in page.page.locator(".fp-label").inner_text())
    page.click("Pause")
    page.click("Draw a ruler on the film (R)")
    page.drag_on_film((0.2, 0.4), (0.6, 0.4))
    page.fill("This line is", "100 mm").hears("Scale: the ruler that you drew.")
    assert re.search(r'length = "100 mm"', film.study_text)
    assert "mass" not in film.study_text.split("[[run]]")[0].replace("# mass", "")
    assert page.page.locator(".ui-banner.bad").count() == 0


def test_run_says_what_is_missing(film: Server, tab: Open) -> None:
    page = tab().open(film)
    page.click("Run").hears("Choose recordings or open the sample study first.")
    page.click("Use this recording")
    film_shown(page)
    page.click("Run")
    page.page.locator(".ui-message.warn").wait_for()
    focused = page.page.evaluate("document.activeElement.closest('.ui-field')?.dataset.name")
    assert focused in ("mass", "fps", "scale")


def test_numbers_are_read_back_while_they_are_typed(untracked: Server, tab: Open) -> None:
    before, page = untracked.study_text, tab().open(untracked)
    echo = page.page.locator('.ui-field[data-name="mass"] .ui-echo')
    page.until(lambda: "0.35" in echo.inner_text())
    page.fill("Mass", "350 g", enter=False)
    page.until(lambda: re.sub(r"\s", " ", echo.inner_text()) in ("0.35 kg", "0.350 kg"))
    assert untracked.study_text == before  # nothing is written while typing
    page.fill("Mass", "350", enter=False)
    page.page.locator('.ui-field[data-name="mass"] .ui-field-words:is(.warn, .bad)', has_text="350 g").wait_for()
    page.fill("Scale", "0.5", enter=False)
    page.page.locator('.ui-field[data-name="scale"] .ui-field-words:is(.warn, .bad)').wait_for()
    for name in ("Scale", "Mass"):
        page.page.get_by_label(name, exact=True).press("Escape")
    page.fill("Frame rate", "0", enter=False)
    page.page.locator('.ui-field[data-name="fps"] .ui-field-words.bad').wait_for()
    page.page.get_by_label("Frame rate", exact=True).press("Enter")
    page.page.wait_for_timeout(300)
    assert "fps = 4000" in untracked.study_text
    for name in ("Mass", "Frame rate", "Scale"):
        assert page.page.get_by_label(name, exact=True).is_visible()


@pytest.mark.slow
def test_numbers_of_one_run_are_its_own(untracked: Server, tab: Open) -> None:
    before, page = untracked.study_text, tab().open(untracked)
    page.click("Per run")
    page.fill("Mass of fast", "0.4 mm", enter=False)
    page.page.locator('.ui-per-run .ui-field[data-name="mass"] .ui-field-words.bad').wait_for()
    page.fill("Mass of fast", "0.4 kg").hears("Mass of fast: 0.4 kg.")
    page.fill("Scale of fast", "0.6 mm/px").hears("Scale of fast: 0.6 mm/px.")
    assert 'mass = "0.4 kg"\nscale = "0.6 mm/px"' in untracked.study_text
    page.page.keyboard.press("Tab")
    page.page.locator("body").click(position={"x": 5, "y": 5})
    page.page.keyboard.press("Control+z")
    page.until(lambda: "0.6" not in untracked.study_text)
    page.click("Undo")
    page.until(lambda: untracked.study_text == before)


AT_ONCE = """(box, text) => {  // typed and entered before the page can draw
  Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(box, text);
  box.dispatchEvent(new Event("input", { bubbles: true }));
  box.dispatchEvent(new KeyboardEvent("keydown", { key: "Enter", bubbles: true }));
}"""


@pytest.mark.slow
def test_a_right_text_entered_before_the_page_draws_is_written(untracked: Server, tab: Open) -> None:
    """The mark at the box still says what is wrong with the text before it."""
    page = tab().open(untracked)
    page.click("Per run")
    page.fill("Mass of fast", "0.4 mm", enter=False)
    page.page.locator('.ui-per-run .ui-field[data-name="mass"] .ui-field-words.bad').wait_for()
    page.page.get_by_label("Mass of fast", exact=True).evaluate(AT_ONCE, "0.4 kg")
    page.hears("Mass of fast: 0.4 kg.")
    assert 'mass = "0.4 kg"' in untracked.study_text


@pytest.mark.slow
def test_a_click_marks_the_target_in_one_frame_and_goes_to_the_next(untracked: Server, tab: Open) -> None:
    page = tab().open(untracked)
    film_shown(page)
    page.page.get_by_role("button", name="Repair", exact=True).click()
    for k in range(2):
        page.page.locator(".fp-label", has_text=f"frame {k} of 150").wait_for()
        page.drag_on_film((0.1 + 0.01 * k, 0.4), (0.1 + 0.01 * k, 0.4))
        page.hears(f"frame {k}: marked.")
    page.page.locator(".fp-label", has_text="frame 2 of 150").wait_for()
    repairs = tomllib.loads(untracked.study_text)["run"][0]["repair"]
    assert [(one["from"], one["to"], one["how"]) for one in repairs] == [(0, 0, "track"), (1, 1, "track")]
    (x, y, w, h), moved = repairs[0]["target"], repairs[1]["target"]
    assert (w, h) == (20, 20)
    assert (x + 10, y + 10) == pytest.approx((51.2, 28.8), abs=1.0)  # of 512 x 72 px
    assert moved[0] - x == pytest.approx(5.1, abs=1.0)


def test_a_quick_drag_draws_with_the_tool_just_chosen(untracked: Server, tab: Open) -> None:
    before, page = untracked.study_text, tab().open(untracked)
    film_shown(page)
    page.click("Target")
    page.drag_on_film((0.08, 0.2), (0.28, 0.8))
    page.hears("Target set in fast.")
    assert TARGET.search(untracked.study_text)
    page.click("Undo")
    page.until(lambda: untracked.study_text == before)


def test_the_sample_study_is_one_click_away(tmp_path: Path, tab: Open, serve: Serve) -> None:
    server = serve(tmp_path)
    page = tab().open(server)
    page.click("Open the sample study")
    film_shown(page)
    page.until(lambda: "unready" not in (page.button("Run").get_attribute("class") or ""))


def test_films_are_dropped_on_the_page(tmp_path: Path, tab: Open, serve: Serve) -> None:
    server = serve(tmp_path)
    page = tab().open(server)
    chooser = page.page.locator("input[type=file]").first
    assert {".avi", ".mraw", ".cihx", ".csv", ".tdms", ".mat"} <= set(str(chooser.get_attribute("accept")).split(","))
    chooser.set_input_files(SAMPLES / "fast.avi")
    film_shown(page)
    assert (tmp_path / "fast.avi").read_bytes() == (SAMPLES / "fast.avi").read_bytes()


@pytest.mark.slow
def test_a_broken_film_gets_one_clear_sentence(tmp_path: Path, tab: Open, serve: Serve) -> None:
    (tmp_path / "broken.avi").write_bytes((SAMPLES / "fast.avi").read_bytes()[:4000])
    server = serve(tmp_path)
    page = tab().open(server)
    page.sees("broken.avi")
    if page.button("Use this recording").is_visible():
        page.click("Use this recording")
        page.page.locator(".ui-banner, .fp-label, .ui-message", has_text="broken.avi").first.wait_for()
    else:
        assert page.page.get_by_label("broken.avi").is_disabled()
    page.picture("1_broken")
    page.faults.clear()  # the film was refused, as it should be


# --- always true


@pytest.mark.slow
def test_a_dead_server_is_said_and_a_new_one_found(untracked: Server, tab: Open) -> None:
    page = tab().open(untracked)
    film_shown(page)
    untracked.stop(signal.SIGKILL)
    page.hears("The server does not answer. Start `frictrack app` again; the page reconnects by itself.")
    page.picture("2_no_server")
    untracked.start()
    page.page.locator(".ui-banner", has_text="does not answer").wait_for(state="detached")
    page.fill("Mass", "0.36 kg").hears("Mass: 0.36 kg.")
    page.faults.clear()  # its server was taken from it


@pytest.mark.slow
def test_files_that_vanish_are_said_once(untracked: Server, tab: Open) -> None:
    page = tab().open(untracked)
    film_shown(page)
    film = untracked.study.parent / "fast.avi"
    film.rename(film.with_suffix(".gone"))
    page.hears("fast.avi")
    film.with_suffix(".gone").rename(film)
    page.page.locator(".ui-banner", has_text="fast.avi").wait_for(state="detached")
    untracked.study.unlink()
    page.hears("study.toml")
    page.page.wait_for_timeout(1500)
    assert untracked.log is not None
    assert "Traceback" not in untracked.log.read_text(encoding="utf-8")
    page.faults.clear()


@pytest.mark.slow
def test_two_pages_see_the_same_and_do_not_undo_each_other_unseen(tables: Server, tab: Open) -> None:
    one, other = tab().open(tables).to("Model"), tab().open(tables).to("History")
    one.click("Fit")
    one.hears(": done.")
    other.sees(re.compile(r"oulomb \+ viscous \(current\)"))
    one.page.get_by_role("button", name="Settings of coulomb.F_c").click()
    one.fill("F_c: fixed at", "2.0").hears("coulomb.F_c: fix set.")
    other.hears(re.compile("outdated"))
    other.click("Undo").hears("Undone")
    one.page.locator(".ui-banner", has_text="outdated").wait_for(state="detached")
    assert "F_c" not in tables.study_text


@pytest.mark.slow
def test_a_change_made_elsewhere_is_not_overwritten_unseen(untracked: Server, tab: Open) -> None:
    page = tab().open(untracked)
    film_shown(page)
    refused: list[int] = []

    def as_seen_before(route: Any) -> None:
        """Send the revision of an earlier state, as a page does that has not heard of the newest one."""
        told = json.loads(route.request.post_data)
        route.continue_(post_data=json.dumps({**told, "seen": told["seen"] + 7}))

    page.page.route("**/api/do", as_seen_before)
    page.page.on("response", lambda r: r.status == 409 and refused.append(r.status))
    page.fill("Mass", "0.5 kg")
    page.page.locator(".ui-banner.bad").wait_for()
    assert refused == [409]
    assert "0.5 kg" not in untracked.study_text
    page.faults.clear()


@pytest.mark.slow
def test_an_outdated_report_is_not_downloaded_unseen(sample: Server, tab: Open) -> None:
    before, page = sample.study_text, tab().open(sample)
    page.fill("Mass", "0.36 kg").hears("Mass: 0.36 kg.")
    page.hears(re.compile("outdated"))
    page.until(lambda: "outdated" in (page.button("Report").get_attribute("class") or ""))
    page.click("Report")
    page.page.get_by_role("dialog", name="This report is outdated").wait_for()
    page.picture("2_outdated")
    with page.page.expect_download() as got:
        page.click("Download it as it is")
    assert "<html" in Path(got.value.path()).read_text(encoding="utf-8")
    page.faults.clear()  # the server has refused it once, with its reason
    page.click("Undo")
    page.until(lambda: sample.study_text == before)
    page.page.locator(".ui-banner", has_text="outdated").wait_for(state="detached")


@pytest.mark.slow
def test_outdated_results_are_grey_and_can_be_updated(sample: Server, tab: Open) -> None:
    before, page = sample.study_text, tab().open(sample).to("Compare")
    page.page.locator(".fp-plot").first.wait_for()
    assert page.page.locator(".ui-work.stale").count() == 0
    page.fill("Mass", "0.36 kg")
    page.page.locator(".ui-work.stale").wait_for()
    page.page.locator(".ui-banner").get_by_role("button", name="Update").first.wait_for()
    page.click("Undo")
    page.until(lambda: sample.study_text == before)
    page.page.locator(".ui-work.stale").wait_for(state="detached")


@pytest.mark.slow
def test_a_message_never_covers_the_view(sample: Server, tab: Open) -> None:
    page = tab().open(sample).to("Compare")
    page.page.locator(".fp-plot").first.wait_for()
    boxes = [page.page.locator(where).bounding_box() for where in (".ui-view", ".ui-status", ".ui-banners")]
    assert all(boxes)
    view, status, banners = (box for box in boxes if box)
    assert view["y"] + view["height"] <= status["y"] + 1
    assert banners["y"] + banners["height"] <= view["y"] + 1


def test_the_page_asks_for_its_token(study_file: Path, tab: Open, serve: Serve) -> None:
    server = serve(study_file, token="sesame")
    page = tab()
    page.page.goto(server.bare_address)
    assert "token" in page.page.content()
    page.page.goto(server.bare_address + "?token=wrong")
    assert "token" in page.page.content()
    page.faults.clear()  # those were refused, as they should be
    page.page.goto(server.address)
    page.sees("History")
    page.page.goto(server.bare_address)  # the cookie is enough now
    page.sees("History")


# --- quick


@pytest.mark.slow
def test_the_page_paints_before_its_data_arrive(untracked: Server, tab: Open) -> None:
    page = tab()
    page.page.route("**/api/state", lambda route: None)  # never answered
    page.page.goto(untracked.address, wait_until="commit")
    page.page.get_by_role("tab", name="Film").wait_for()
    for title in ("Film", "Compare", "Motion", "Model", "History"):  # nothing is said of what is not known yet
        page.to(title)
        assert page.page.locator("#view").inner_text().strip() in ("", "Reading the study ...")


@pytest.mark.slow
def test_a_click_shows_at_once_that_it_is_under_way(untracked: Server, tab: Open) -> None:
    page = tab().open(untracked)
    film_shown(page)
    page.page.route("**/api/job", lambda route: None)  # never answered
    page.click("Run")
    page.page.locator(".ui-progress").wait_for()
    assert page.page.get_by_role("tab", name="Compare").get_attribute("aria-selected") == "true"


@pytest.mark.slow
def test_the_film_is_large(untracked: Server, tab: Open) -> None:
    page = tab().open(untracked)
    film_shown(page)
    page.page.set_viewport_size({"width": 1440, "height": 900})
    box = page.page.locator(".fp-picture").bounding_box()
    assert box is not None
    assert box["width"] > 780
    assert box["width"] / box["height"] < 8  # a film of 512 x 72 px has no margin above and below
