"""What can be set in each tab, seen before it is set and undone; and that all of it fits on a projector.

Screenshots go to `FRICTRACK_ARTEFACTS`, when set.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import CHROMIUM, Open, Server, Tab

from frictrack.errors import FrictrackError
from frictrack.flow import Session, open_study, preview_motion, read_results
from frictrack.motion import differentiate, low_pass
from frictrack.workbench.compare_tab import CompareTab
from frictrack.workbench.history_tab import HistoryTab
from frictrack.workbench.page_state import PageState
from frictrack.workbench.plots_with_film import OpenFilms

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")
SAMPLES = Path(__file__).parent.parent / "sample_videos"
GHOST = (213, 94, 0)
TABS = ("1 Film", "2 Motion", "3 Model", "4 Compare", "5 What is missing?", "6 History and report")
STUDY = """# the demo's quickest film
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
PRINTER = """#!/bin/sh
while [ ! -e {go} ]; do sleep 0.05; done
for word in "$@"; do case "$word" in --print-to-pdf=*) printf '%%PDF-' > "${{word#--print-to-pdf=}}";; esac; done
"""
WIDER = """() => {
    const out = [], look = (root) => root.querySelectorAll("*").forEach((n) => {
        if (n.shadowRoot) look(n.shadowRoot);
        const box = n.getBoundingClientRect();
        if (box.width && box.right > innerWidth + 1 && !["STYLE", "OPTION"].includes(n.tagName))
            out.push(`${n.tagName}.${n.className}: ${(n.textContent || "").trim().slice(0, 40)}`);
    });
    look(document);
    return out;
}"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A study of one film with a model and a report, and a browser for its PDF that waits for a sign."""
    folder = tmp_path_factory.mktemp("tabs")
    shutil.copy(SAMPLES / "fast.avi", folder)
    study = folder / "study.toml"
    study.write_text(STUDY)
    session = Session(open_study(study))
    session.fit()
    session.measure("friction")
    (study.parent / "study_results" / "report.html").write_text("<html>report</html>")
    printer = folder / "bin" / "chromium"
    printer.parent.mkdir()
    printer.write_text(PRINTER.format(go=folder / "go"))
    printer.chmod(0o755)
    server = Server(study, paths=str(printer.parent)).start()
    yield server
    server.stop()


def said(server: Server) -> str:
    return server.study.read_text(encoding="utf-8")


def undone(page: Tab, server: Server, before: str) -> None:
    page.page.get_by_role("button", name="Undo", disabled=False).click()
    page.until(lambda: said(server) == before)


def test_a_cutoff_is_seen_before_it_is_used(bench: Server, tab: Open) -> None:
    before, page = said(bench), tab().open(bench).to("2 Motion")
    page.until(lambda: len(page.ink(GHOST, layer=0)) == 5)
    assert page.ink(GHOST, layer=0) == [0] * 5
    page.sees("noise that passes")
    page.page.locator(".noUi-handle").focus()
    for _ in range(3):
        page.page.keyboard.press("ArrowRight")
    page.until(lambda: min(page.ink(GHOST, layer=0)[1:3]) > 20)  # velocity and acceleration
    assert page.ink(GHOST, layer=0)[0] == 0
    page.picture("11_previewed")
    assert said(bench) == before
    page.click("Use this cut-off").hears("edit: done")
    assert "cutoff = " in said(bench)
    page.sees("Changed since these results were made: cutoff")
    page.until(lambda: min(page.ink(GHOST, layer=0)[1:3]) > 20)  # it waits there until it is done
    undone(page, bench, before)


@pytest.mark.parametrize("cutoff", [60.0, 300.0, 900.0])
def test_a_preview_is_what_the_study_would_give(bench: Server, cutoff: float) -> None:
    run = read_results(open_study(bench.study)).runs[0]
    would = differentiate(low_pass(run.displacement, cutoff))
    seen = preview_motion(run, cutoff)
    np.testing.assert_allclose(seen, [would.x, would.v, would.a], rtol=1e-9, atol=1e-9)


def test_mass_and_scale_of_one_run_beside_what_was_tracked(bench: Server, tab: Open) -> None:
    before, page = said(bench), tab().open(bench)
    page.page.get_by_alt_text("contact sheet of the tracked target in fast").wait_for()
    mass = page.page.get_by_label("Mass of this run")
    assert mass.get_attribute("placeholder") == "0.35 kg for all runs"
    mass.fill("0.4 mm")
    page.page.keyboard.press("Enter")
    assert "expected" in page.hears("mass")
    assert said(bench) == before
    mass.fill("0.4 kg")
    page.page.keyboard.press("Enter")
    page.hears("edit: done fast mass")
    page.page.get_by_label("Scale of this run").fill("0.6 mm/px")
    page.page.keyboard.press("Enter")
    page.hears("edit: done fast scale")
    assert 'mass = "0.4 kg"\nscale = "0.6 mm/px"' in said(bench)
    page.click("Undo")
    page.until(lambda: "0.6" not in said(bench))
    undone(page, bench, before)


def test_priors_ties_and_values_per_run_are_set_in_the_block(bench: Server, tab: Open) -> None:
    before, page = said(bench), tab().open(bench).to("3 Model")
    page.page.get_by_role("button", name="Priors, ties, values per run").first.press("Enter")
    prior, tie = page.page.get_by_label("F_c: prior"), page.page.get_by_label("F_c: tied to")
    for box, text, why in (
        (prior, "eight", "a prior of F_c"),
        (prior, "8", "mean ± standard deviation"),
        (tie, "F_v", 'expected another parameter for F_c, as in "vibration.frequency"'),
        (tie, "viscous.F_v", "F_c is in N but viscous.F_v is in N s/m"),
        (tie, "vibration.frequency", "add vibration, or take the tie out"),
    ):
        box.fill(text)
        page.page.keyboard.press("Enter")
        page.hears(why)
        assert said(bench) == before
    tie.fill("")
    prior.fill("8 ± 0.1 N")
    page.page.keyboard.press("Tab")
    page.hears("edit: done coulomb prior")
    page.page.keyboard.type("typed on")  # what is set does not interrupt
    page.page.get_by_label("F_c: per run").select_option("own value in every run")
    page.hears("edit: done coulomb per_run")
    table = '\n[[effect]]\neffect = "coulomb"\nprior = {F_c = [8.0, 0.1]}\nper_run = {F_c = true}\n'
    assert said(bench) == before + table
    page.picture("12_settings")
    page.page.get_by_role("button", name="Undo", disabled=False).click()
    page.until(lambda: "per_run" not in said(bench))
    undone(page, bench, before)


def test_a_pdf_is_printed_while_the_page_lives_on(bench: Server, tab: Open) -> None:
    page = tab().open(bench).to("6 History and report")
    with page.page.expect_download() as got:
        page.click("Report (PDF)")
        page.sees("Report (PDF) ...")
        tab().open(bench).to("3 Model").sees("Remove viscous")  # the server has time for others
        page.page.get_by_text("report.pdf is being made").wait_for()
        (bench.study.parent / "go").touch()
    assert Path(got.value.path()).read_bytes() == b"%PDF-"
    page.hears("report.pdf: done")


def test_models_of_the_same_name_are_told_apart(study_file: Path) -> None:
    session = Session(open_study(study_file))
    session.fit()
    session.add("drag")
    session.remove("drag")
    state = PageState(study_file)
    state.load()
    compare, record = CompareTab(state, OpenFilms()), HistoryTab(state)
    compare.refresh()
    record.refresh()
    names = [model.name for model in read_results(open_study(study_file)).models]
    assert [name.split("_", 1)[1] for name in names].count("coulomb+viscous") == 2
    assert list(compare.model.options.values()) == list(record.choice.options.values()) == names
    assert list(compare.background.options.values())[1:] == names


def test_a_report_that_is_not_there_is_not_downloaded(study_file: Path) -> None:
    Session(open_study(study_file)).fit()
    state = PageState(study_file)
    state.load()
    record = HistoryTab(state)
    record.refresh()
    assert all(one.disabled for one in record.reports)
    with pytest.raises(FrictrackError, match="write it first"):
        record._report_pdf()


def test_every_tab_fits_on_a_projector(bench: Server, chromium: Any) -> None:
    view = chromium.new_page(viewport={"width": 1920, "height": 1080}, device_scale_factor=1.5)
    page = Tab(view).open(bench)
    seen = (
        "contact sheet",
        "Free section:",
        "Remove viscous",
        "Residual against",
        "not diagnosed",
        "1. Tustin (current)",
    )
    for title, words in zip(TABS, seen, strict=True):
        page.to(title)
        page.sees(words) if title[0] not in "14" else view.locator("img, .ft-plot").first.wait_for()
        for size in ((1920, 1080), (1024, 768)):
            view.set_viewport_size({"width": size[0], "height": size[1]})
            view.wait_for_timeout(300)
            page.picture(f"13_{size[0]}_{title[0]}")
            assert view.evaluate(WIDER) == []
            assert view.evaluate("document.documentElement.scrollWidth <= innerWidth")
    view.close()
    assert page.faults == []
