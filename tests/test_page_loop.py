"""The loop on the page: from bare films by clicks to the named effect, to a repaired and trusted verdict.

Screenshots go to `FRICTRACK_ARTEFACTS`, when set.
"""

from __future__ import annotations

import json
import os
import re
import runpy
import shutil
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from browser import CHROMIUM, LIMIT_S, Open, Server, Tab

from frictrack.flow import Session, open_study, replay_script

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")
SAMPLES = Path(__file__).parent.parent / "sample_videos"
MAX_ACTIONS = 7  # from bare films to the verdict


class Actions:
    """Does what a user does on a page, and counts it."""

    def __init__(self, page: Tab) -> None:
        self.page, self.count = page, 0

    def click(self, name: str | re.Pattern[str]) -> None:
        self.count += 1
        self.page.click(name)

    def fill(self, label: str, text: str) -> None:
        self.count += 1
        self.page.fill(label, text, enter=False)  # the next click writes it


@contextmanager
def held(study: Path, words: str) -> Iterator[None]:
    """As soon as the work of a study has said these words, its process stands still: no machine is too quick."""
    until = time.monotonic() + LIMIT_S
    while not (said := [p for p in study.parent.glob("*/.frictrack/jobs/*/progress.jsonl") if words in p.read_text()]):
        assert time.monotonic() < until
        time.sleep(0.02)
    folder = os.fsencode(said[0].parent)
    found = (p for p in Path("/proc").glob("[0-9]*/fd/*") if _leads_to(p, folder))
    pid = int(next(found).parts[2])
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def _leads_to(link: Path, folder: bytes) -> bool:
    """Whether a process has a file of this folder open, other than this one."""
    try:
        return link.parts[2] != str(os.getpid()) and folder in os.fsencode(os.readlink(link))
    except OSError:
        return False


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A folder with four films and nothing else; the tests of this file go on with its study."""
    folder = tmp_path_factory.mktemp("loop")
    for film in SAMPLES.glob("*.avi"):
        shutil.copy(film, folder)
    server = Server(folder).start()
    yield server
    server.stop()


def verdict(page: Tab) -> str:
    """Wait for the verdict on the current model."""
    title = page.page.locator(".ui-verdict-title")
    page.page.locator(".ui-verdict:is(.good, .warn, .bad)").wait_for()
    words: str = title.inner_text()
    return words


def test_from_films_to_the_named_effect_and_the_falling_error(films: Server, tab: Open) -> None:
    page = tab()
    page.page.set_viewport_size({"width": 1440, "height": 900})
    act = Actions(page.open(films))
    act.click("Use these 4")
    act.fill("Mass", "0.35 kg")
    act.fill("Frame rate", "4000")
    act.fill("Scale", "0.5 mm/px")
    assert (
        page.page.get_by_label("Mass", exact=True).input_value() == "0.35 kg"
    )  # until the server tells that it is written
    act.click("Per run")
    act.fill("Mass of double_mass", "0.7 kg")
    page.picture("4_ready")
    act.click("Run")
    page.page.locator("#tab-compare[aria-selected=true]").wait_for()
    page.page.locator(".ui-progress").wait_for()
    page.picture("5_running")
    assert "patch" in verdict(page)
    assert act.count <= MAX_ACTIONS
    page.idle()  # what comes after the verdict does not hold the user up
    page.picture("6_verdict")
    films_seen = json.loads(page.page.evaluate("fetch('/api/state').then((r) => r.text())"))
    before = films_seen["models"][-1]["errors"]["reduced_chi2"]

    act.click("Add patch")
    strip = page.page.locator(".ui-strip svg")
    strip.wait_for()
    box, height = strip.bounding_box(), 900
    assert box is not None
    assert box["y"] + box["height"] <= height  # on the screen, without scrolling
    page.page.locator(".ui-brief", has_text="Tustin + patch").wait_for()
    page.idle()
    verdict(page)  # diagnosed again by itself
    state = json.loads(page.page.evaluate("fetch('/api/state').then((r) => r.text())"))
    assert state["model"]["label"].endswith("Tustin + patch")
    assert state["models"][-1]["errors"]["reduced_chi2"] < before / 10
    assert state["diagnosis"] is not None
    page.picture("7_added")


def test_undo_and_redo_walk_between_the_models(films: Server, tab: Open) -> None:
    page = tab().open(films).to("History")
    page.sees("Tustin + patch (current)")
    words = page.button("Undo").get_attribute("title")
    assert words is not None
    assert "add patch" in words
    page.click("Undo").hears("Undone: add patch")
    page.sees(re.compile(r"Tustin \(current\)"))
    page.page.keyboard.press("Control+Shift+z")
    page.hears("Redone: add patch")
    page.sees("Tustin + patch (current)")


def test_a_link_of_nonsense_opens_the_page_and_starts_nothing(films: Server, tab: Open) -> None:
    page = tab()
    page.page.goto(f"{films.address}#tab=no&run=zz&frame=a%40b&select=%40%40&shown=9_no&background=8_no&tried=patch")
    page.page.get_by_role("tab", name="Film", selected=True).wait_for()
    page.to("Compare")
    page.page.locator(".ui-verdict-title").wait_for()
    page.until(lambda: page.page.locator(".fp-plot").count() > 3)
    assert page.page.evaluate("fetch('/api/state').then((r) => r.json()).then((s) => s.job)") is None


@pytest.mark.slow
def test_a_candidate_draws_its_curve_and_prints_its_error(sample: Server, tab: Open) -> None:
    page = tab()
    page.page.set_viewport_size({"width": 1440, "height": 900})
    page.page.add_init_script(
        """const text = CanvasRenderingContext2D.prototype.fillText;
        window.labelled = new Set();
        CanvasRenderingContext2D.prototype.fillText = function (words, ...at) {
            if (words.startsWith("Held-out error")) labelled.add(this.canvas);
            text.call(this, words, ...at);
        };"""
    )
    page.open(sample).to("Compare")
    card = page.page.locator('[data-candidate="patch"]')
    card.wait_for()
    card.hover()
    card.locator(".ui-errors").filter(has_text=re.compile(r"with it\s*[\d.]+")).wait_for()  # after "fitting ..."
    numbers = card.locator(".ui-errors").inner_text()
    assert re.search(r"now\s*[\d.]+", numbers)
    assert re.search(r"with it\s*[\d.]+", numbers)
    large = page.page.locator(".fp-plot.fp-large")
    box = large.bounding_box()
    assert box is not None
    assert box["y"] + box["height"] <= 900  # the plot in which it differs most is on the screen
    page.page.get_by_role("button", name="candidate, with patch").wait_for()  # in the legend
    page.until(lambda: page.page.evaluate("labelled.size") > 0)
    assert page.page.evaluate("labelled.size") == 1  # the label would not fit into the small plots
    page.picture("8_tried")


@pytest.mark.slow
def test_the_report_is_written_and_downloaded(sample: Server, tab: Open) -> None:
    page = tab().open(sample)
    page.to("History")
    page.click(re.compile("^Write the report"))
    page.hears(re.compile("eport: done"))
    with page.page.expect_download() as got:
        page.click("Report (HTML)")
    assert "patch" in Path(got.value.path()).read_text(encoding="utf-8")
    with page.page.expect_download() as got:
        page.click("Python script")
    assert "frictrack" in Path(got.value.path()).read_text(encoding="utf-8")
    page.picture("9_history")


def test_the_script_of_a_session_repeats_it(
    films: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The models come back; the diagnosis and the report that it ends with are tested elsewhere."""
    folder = tmp_path / "again"
    shutil.copytree(films.study, folder)
    study = open_study(folder / "study.toml")
    before = Session(study).models.groups
    (folder / "repeat.py").write_text(replay_script(study), encoding="utf-8")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(Session, "diagnose", lambda session, **more: {"verdict": "a verdict"})
    monkeypatch.setattr(Session, "report", lambda session: "a report")
    runpy.run_path("repeat.py")
    capsys.readouterr()
    again = [name.split("_", 1)[1] for name in Session(study).models.groups]
    assert set(again) == {n.split("_", 1)[1] for n in before}


@pytest.mark.slow
def test_work_is_cancelled_and_found_again_after_a_reload(tables: Server, tab: Open) -> None:
    page = tab().open(tables).to("Model")
    page.page.get_by_label("Search", exact=True).select_option("sga")
    page.fill("Another model", "tustin")
    page.page.get_by_role("tabpanel").get_by_role("button", name="Fit", exact=True).click()
    with held(tables.study, "sga: misfit"):
        page.hears(re.compile("sga: misfit"))
        page.page.reload()
        page.hears(re.compile("sga: misfit"))
        page.click("Cancel")
        page.until(lambda: any(tables.study.parent.glob("*/.frictrack/jobs/*/cancel")))
    page.hears(re.compile("cancelled"))
    page.idle()


def test_a_formula_of_the_unexplained_is_taken_into_the_law(tables: Server, tab: Open) -> None:
    page, asked = tab(), []
    effect = {"effect": "unexplained", "formula": "F * (x - c)/w", "units": {"F": "N", "c": "m", "w": "m"}}
    formula = {"formula": "F (x - c)/w", "words": "12 % of the misfit", "effect": effect, "needs": []}
    diagnosis = {"verdict": "missing", "title": "t", "candidates": [], "formulas": [formula], "unexplained": "A force."}

    def with_formula(route: Any) -> None:
        state = route.fetch().json()
        model = {"group": "1_a", "label": "1. A", "equation": "", "effects": [], "remarks": []}
        route.fulfill(json={**state, "diagnosis": diagnosis, "model": model, "job": None, "version": 10**6})

    def answer(route: Any) -> None:
        asked.append(json.loads(route.request.post_data))
        route.fulfill(json={"revision": 1, "words": "done", "job": None})

    page.page.route("**/api/state", with_formula)
    page.page.route("**/api/do", answer)
    page.page.route("**/api/job", answer)
    page.open(tables).to("Compare").click("Add the formula")
    page.until(lambda: len(asked) == 2)
    assert [(one["do"], one["arguments"]) for one in asked] == [
        ("define", {"effect": effect}),
        ("add_and_diagnose", {"effect": "unexplained"}),
    ]
    page.faults.clear()  # there are no plots of this model


def test_the_end_of_work_is_said_whichever_message_tells_it_first(tables: Server, tab: Open) -> None:
    page = tab().open(tables)
    page.page.locator(".ui-path", has_text="study.toml").wait_for()
    page.page.evaluate(
        """async () => {
            const { receive } = await import("/static/page/live.js");
            const { store } = await import("/static/page/store.js");
            const ended = { id: "9999", do: "report", words: "Write the report", state: "done", warnings: [] };
            receive({ ...store.study, job: null, last_job: ended });
        }"""
    )
    page.hears("Write the report: done.")
