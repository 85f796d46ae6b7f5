"""The report in a browser: the first screen answers, sections open where a link leads and on paper."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from test_plots import candidate, diagnosis, results

from frictrack.present import report

pytest.importorskip("playwright.sync_api")
from playwright.sync_api import sync_playwright

CHROMIUM = shutil.which("chromium")
WIDTH, HEIGHT = 1280, 800
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")


def with_verdict(found: dict[str, Any]) -> Any:
    r = results(runs=4)
    m = replace(r.models[0], diagnosis=found, current=True)
    return replace(r, models=(m,), diagnosis=found, figures=m.figures)


def studies() -> dict[str, Any]:
    """One study of each verdict."""
    gap = {"what": "stribeck.F_s", "why": "the slowest speed is 2 m/s", "settled_by": "Film a run that stops."}
    best = candidate("vibration", 0.001, 300.0, ["camera_shake"])
    left = {"axis": "x", "curve": [[0.0, 1.0], [0.1, -1.0]], "formulas": []}
    return {
        "added": results(film=True, runs=4),
        "complete": with_verdict(diagnosis("complete")),
        "undetermined": with_verdict(diagnosis("undetermined", undetermined=[gap])),
        "missing": with_verdict(diagnosis("missing", [candidate("texture", 0.001, 812.0)], ["texture"])),
        "ambiguous": with_verdict(diagnosis("ambiguous", [best], ["vibration"])),
        "unexplained": with_verdict(diagnosis("unexplained", [candidate("lens", 0.4, -3.0)], unexplained=left)),
        "forty": results(runs=40),
        "measured": replace(results(), models=(), diagnosis=None, figures={}),
    }


@pytest.fixture(scope="module")
def page() -> Iterator[Any]:
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        browser.close()


def opened(page: Any, study: Any, folder: Path, fragment: str = "") -> Any:
    page.goto("about:blank")
    path = folder / "report.html"
    path.write_text(report.render(study), encoding="utf-8")
    page.goto(path.as_uri() + fragment)
    return page


def height(page: Any) -> int:
    return int(page.evaluate("document.documentElement.scrollHeight"))


@pytest.mark.few(1)
@pytest.mark.parametrize("name", studies())
def test_the_first_screen_holds_verdict_figure_parameters_and_next_step(page, name, tmp_path):
    opened(page, studies()[name], tmp_path)
    box = page.locator(".answers").bounding_box()
    assert box["y"] + box["height"] < HEIGHT
    assert page.locator("header figure svg").bounding_box()["y"] > page.locator("h1").bounding_box()["y"]
    assert re.search(r"frictrack (plan|add|fit) study.toml", page.locator(".answers").inner_text())
    assert height(page) < 3 * HEIGHT
    assert page.evaluate("document.documentElement.scrollWidth") <= WIDTH


def test_links_lead_into_folded_sections_and_all_open_at_once(page, tmp_path):
    opened(page, studies()["added"], tmp_path, "#limits")
    assert page.locator("#limits").is_visible()
    assert not page.locator("#where").is_visible()
    page.locator("nav a[href='#where']").click()
    page.locator("#where").wait_for(state="visible", timeout=2000)
    page.locator("#all").click()
    assert all(page.evaluate("[...document.querySelectorAll('details.section')].map((d) => d.open)"))
    page.locator("#all").click()
    assert not page.locator("#where").is_visible()


SMALLEST_TEXT = """() => Math.min(...[...document.querySelectorAll("details figure svg")].flatMap((svg) => {
  const scale = svg.getBoundingClientRect().width / svg.viewBox.baseVal.width;
  return [...svg.querySelectorAll("text")].map((text) => scale * parseFloat(getComputedStyle(text).fontSize));
}))"""


@pytest.mark.slow
def test_texts_of_figures_can_be_read_in_a_narrow_window(page: Any, tmp_path: Path) -> None:
    page.set_viewport_size({"width": 800, "height": HEIGHT})
    opened(page, studies()["added"], tmp_path).locator("#all").click()
    assert 9.9 < page.evaluate(SMALLEST_TEXT) < 20  # px; 7.7 if the figures are made as narrow as the page
    assert page.evaluate("document.documentElement.scrollWidth") <= 800
    page.set_viewport_size({"width": WIDTH, "height": HEIGHT})


@pytest.mark.slow
def test_forty_runs_make_a_page_hardly_longer_than_four(page, tmp_path):
    heights = []
    for name in ("added", "forty"):
        opened(page, studies()[name], tmp_path).locator("#all").click()
        heights.append(height(page))
    assert heights[1] < 1.5 * heights[0] + 40 * 100  # tables have a row per run


@pytest.mark.slow
def test_paper_shows_the_sections(page, tmp_path):
    opened(page, studies()["added"], tmp_path)
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert page.locator("#history").is_visible()


def test_the_report_is_dark_where_the_system_is_and_light_on_paper(page: Any, tmp_path: Path) -> None:
    page.emulate_media(color_scheme="dark")
    opened(page, studies()["complete"], tmp_path)
    ground = "getComputedStyle(document.body).backgroundColor"
    assert page.evaluate(ground) == "rgb(15, 18, 22)"
    assert page.evaluate("getComputedStyle(document.querySelector('figure svg')).filter").startswith("invert")
    page.emulate_media(color_scheme="dark", media="print")
    assert page.evaluate(ground) == "rgb(255, 255, 255)"
    page.emulate_media(color_scheme="light", media="screen")
