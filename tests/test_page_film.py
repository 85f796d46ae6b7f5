"""Film and plots on the page: runs and their legend, the cursor, selections, candidates, and repair of lost frames.

Screenshots go to `FRICTRACK_ARTEFACTS`, when set.
"""

from __future__ import annotations

import re

import pytest
from browser import CHROMIUM, Open, Server

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium"),
]


# --- runs, legend, film


def test_the_legend_hides_and_isolates_runs(sample: Server, tab: Open) -> None:
    page = tab().open(sample).to("Compare")
    legend = page.page.get_by_role("group", name="Runs", exact=True)
    legend.wait_for()
    buttons = legend.get_by_role("button")
    assert buttons.all_inner_texts() == ["fast", "slow", "to_a_stop", "double_mass"]
    buttons.nth(1).click()
    page.until(lambda: buttons.nth(1).get_attribute("aria-pressed") == "false")
    buttons.nth(2).dblclick()
    page.until(lambda: [b.get_attribute("aria-pressed") for b in buttons.all()] == ["false", "false", "true", "false"])


def test_the_film_follows_the_run_under_the_cursor(sample: Server, tab: Open) -> None:
    page = tab().open(sample).to("Compare")
    page.page.locator(".fp-plot").first.wait_for()
    page.page.get_by_role("group", name="Runs", exact=True).get_by_role("button").nth(1).dblclick()
    box = page.page.locator(".fp-plot").first.bounding_box()
    assert box is not None
    page.page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 0.5 * box["height"])
    page.page.mouse.move(box["x"] + 0.62 * box["width"], box["y"] + 0.5 * box["height"])
    page.page.locator(".fp-label", has_text="slow").wait_for()


def test_a_selection_is_drawn_without_asking_the_server(sample: Server, tab: Open) -> None:
    page = tab().open(sample).to("Compare")
    page.page.locator(".fp-plot").first.wait_for()
    page.page.wait_for_timeout(500)
    asked: list[str] = []
    page.page.on("request", lambda r: asked.append(r.url) if "/api/" in r.url and "/api/frame" not in r.url else None)
    page.drag(0)
    page.sees(re.compile(r"\d+ frames selected"))
    assert asked == []


def test_a_study_of_tables_has_no_film_and_no_fault(tables: Server, tab: Open) -> None:
    page = tab().open(tables)
    page.sees("Recordings")
    for title in ("Compare", "Motion", "Model", "History", "Film"):
        page.to(title).page.wait_for_timeout(300)
    page.picture("3_tables")
    assert page.page.locator(".fp-picture:visible").count() == 0


def test_only_the_best_candidate_has_the_strong_button(sample: Server, tab: Open) -> None:
    page = tab().open(sample).to("Compare")
    page.button(re.compile("^Add ")).wait_for()
    strong = page.page.locator(".ui-candidate .ui-button.primary")
    assert strong.count() == 1
    assert strong.get_attribute("aria-label") == "Add patch"


# --- repair


def test_frames_are_mended_in_three_clicks_and_the_bytes_come_back(sample: Server, tab: Open) -> None:
    before, page = sample.study_text, tab().open(sample)
    page.page.locator(".fp-label", has_text=re.compile(r"frame \d+ of 150")).wait_for()
    page.page.get_by_role("slider", name="Frame", exact=True).press("Home")
    page.click("Choose frames")  # 1: those that are shown
    page.drag_on_film((0.035, 0.12), (0.2, 0.78))  # 2: the target in one of them
    track = page.page.get_by_role("button", name="Track again")
    page.until(lambda: track.get_attribute("aria-disabled") is None)
    page.picture("4_mend")
    track.click()  # 3
    page.page.locator(".ui-spans.mended li").wait_for()
    assert re.search(r'how = "track", target = \[', sample.study_text)
    page.idle()
    page.picture("4_mended")
    assert page.page.locator(".ui-banner.bad").count() == 0
    page.click(re.compile("^Take the repair of frames 0 to 9 back")).hears(re.compile("taken back"))
    assert "repair" not in sample.study_text
    for _ in range(2):
        page.click("Undo").hears("Undone")
        page.page.wait_for_timeout(400)
    page.until(lambda: sample.study_text == before)
