"""What is set in the tabs Motion, Model and History: seen before it is written, and undone.

Screenshots go to `FRICTRACK_ARTEFACTS`, when set.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, Open, Serve, Server, Tab

from frictrack.flow import Session, open_study, preview_motion, read_results
from frictrack.measure.motion import differentiate, low_pass

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
PRINTER = """#!/bin/sh
while [ ! -e {go} ]; do sleep 0.05; done
for word in "$@"; do case "$word" in --print-to-pdf=*) printf '%%PDF-' > "${{word#--print-to-pdf=}}";; esac; done
"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A study of one film with a model and a report, and a browser for its PDF that waits for a sign."""
    folder = tmp_path_factory.mktemp("settings")
    shutil.copy(SAMPLES / "fast.avi", folder)
    study = folder / "study.toml"
    study.write_text(STUDY, encoding="utf-8")
    session = Session(open_study(study))
    session.fit()
    session.measure("friction")
    (study.parent / "study_results" / "report.html").write_text("<html>report</html>", encoding="utf-8")
    printer = folder / "bin" / "chromium"
    printer.parent.mkdir()
    printer.write_text(PRINTER.format(go=folder / "go"), encoding="utf-8")
    printer.chmod(0o755)
    server = Server(study, paths=str(printer.parent)).start()
    yield server
    server.stop()


def undone(page: Tab, server: Server, before: str) -> None:
    for _ in range(4):
        if server.study_text == before:
            return
        page.click("Undo").hears("Undone")
        page.page.wait_for_timeout(300)
    page.until(lambda: server.study_text == before)


def test_a_cutoff_is_seen_before_it_is_used(bench: Server, tab: Open) -> None:
    before, page = bench.study_text, tab().open(bench).to("Motion")
    slider = page.page.get_by_label("Cut-off of a plain low-pass")
    slider.wait_for()
    page.sees(re.compile("noise that passes"))
    with page.page.expect_request(re.compile(r"view=motion.*cutoff=")):
        slider.focus()
        for _ in range(3):
            page.page.keyboard.press("ArrowRight")
    page.page.get_by_role("group", name="Curves").get_by_role("button", name=re.compile("Hz")).wait_for()
    page.picture("11_previewed")
    assert bench.study_text == before
    page.click("Use this cut-off").hears("Filter of fast")
    assert "cutoff = " in bench.study_text
    page.hears(re.compile("outdated"))
    undone(page, bench, before)


@pytest.mark.few(1)
@pytest.mark.parametrize("cutoff", [60.0, 300.0, 900.0])
def test_a_preview_is_what_the_study_would_give(bench: Server, cutoff: float) -> None:
    run = read_results(open_study(bench.study)).runs[0]
    would = differentiate(low_pass(run.displacement, cutoff))
    seen = preview_motion(run, cutoff)
    np.testing.assert_allclose(seen, [would.x, would.v, would.a], rtol=1e-9, atol=1e-9)


def test_the_free_section_is_typed_and_detected_again(bench: Server, tab: Open) -> None:
    before, page = bench.study_text, tab().open(bench).to("Motion")
    page.fill("From", "12").hears("Free section of fast: set.")
    assert re.search(r'free = \["12 ms", "[\d.]+ ms"\]', bench.study_text)
    page.click("Detect").hears("Free section of fast: detected again.")
    assert "free" not in bench.study_text
    undone(page, bench, before)


@pytest.mark.slow
def test_what_is_typed_stays_when_the_study_changes_meanwhile(bench: Server, tab: Open) -> None:
    before, page, other = bench.study_text, tab().open(bench).to("Motion"), tab().open(bench)
    page.fill("From", "12", enter=False)
    other.fill("Mass", "0.41 kg")
    page.until(lambda: page.page.get_by_label("Mass", exact=True).input_value() == "0.41 kg")
    assert page.page.get_by_label("From", exact=True).input_value() == "12"
    page.page.get_by_label("From", exact=True).press("Escape")
    assert page.page.get_by_label("From", exact=True).input_value() != "12"
    undone(other, bench, before)


def test_priors_ties_and_values_per_run_are_set_in_the_block(bench: Server, tab: Open) -> None:
    before, page = bench.study_text, tab().open(bench).to("Model")
    page.page.get_by_role("button", name="Settings of coulomb.F_c").press("Enter")
    for label, text, why in (
        ("F_c: prior", "eight", "mean ± standard deviation"),
        ("F_c: prior", "8", "mean ± standard deviation"),
        ("F_c: tied to", "F_v", "expected another parameter for F_c"),
        ("F_c: tied to", "viscous.F_v", "F_c is in N but viscous.F_v is in N s/m"),
        ("F_c: tied to", "vibration.frequency", "add vibration, or take the tie out"),
    ):
        page.fill(label, text).hears(why)
        assert bench.study_text == before
    page.faults.clear()  # the server has refused them with their reasons
    page.page.get_by_label("F_c: tied to", exact=True).press("Escape")
    page.fill("F_c: prior", "8 ± 0.1").hears("coulomb.F_c: prior set.")
    page.page.get_by_label("F_c: per run", exact=True).select_option("each run")
    page.hears("coulomb.F_c: per run set.")
    found = bench.study_text
    assert found.startswith(before.rstrip())
    assert re.search(r'effect = "coulomb"\nprior = \{F_c = \[8(\.0)?, 0\.1\]\}\nper_run = \{F_c = true\}', found)
    page.picture("12_settings")
    undone(page, bench, before)


@pytest.mark.slow
def test_every_setting_of_a_search_has_a_box(bench: Server, tab: Open) -> None:
    page, session = tab().open(bench).to("Model"), Session(open_study(bench.study))
    page.page.get_by_label("Search", exact=True).select_option("mga")
    assert page.page.get_by_label("L const", exact=True).get_attribute("placeholder") == "10"
    for label, text in (("Population", "12"), ("Generations", "3"), ("b", "0.3")):
        page.fill(label, text)
    page.page.get_by_label("As printed", exact=True).select_option("true")
    page.picture("13_search")
    page.click("Fit")
    page.until(lambda: session.models.request(session.models.current_group).search == "mga")
    asked = {"population": 12, "generations": 3, "b": 0.3, "as_printed": True}
    assert session.models.request(session.models.current_group).settings == asked
    page.until(lambda: Session(open_study(bench.study)).models.groups[-1] == session.models.current_group)


def test_a_pdf_is_printed_while_the_page_lives_on(bench: Server, tab: Open) -> None:
    page = tab().open(bench).to("History")
    with page.page.expect_download() as got:
        page.page.get_by_role("button", name="Report (PDF)").click()
        page.click("Download it as it is")  # this report was not written by the program
        page.page.locator('button[aria-busy="true"]', has_text="Report (PDF)").wait_for()
        tab().open(bench).to("Model").sees("viscous")  # the server has time for others
        (bench.study.parent / "go").touch()
    assert Path(got.value.path()).read_bytes() == b"%PDF-"
    page.hears("report.pdf: downloaded.")
    page.faults.clear()  # the server has refused it once, with its reason


@pytest.mark.slow
def test_files_are_downloaded_in_the_format_chosen(bench: Server, tab: Open) -> None:
    page = tab().open(bench).to("History")
    page.page.get_by_role("group", name="Figures as").get_by_role("button", name="PNG").click()
    with page.page.expect_download() as got:
        page.click("Figures")
    assert b".png" in Path(got.value.path()).read_bytes()
    with page.page.expect_download() as got:
        page.click("Tables (CSV)")
    assert Path(got.value.path()).read_bytes().startswith(b"PK")


@pytest.mark.slow
def test_a_report_that_is_not_there_is_not_downloaded(study_file: Path, tab: Open, serve: Serve) -> None:
    Session(open_study(study_file)).fit()
    server = serve(study_file)
    page = tab().open(server).to("History")
    page.sees(re.compile(r"\(current\)"))
    for name in ("Report (HTML)", "Report (PDF)"):
        button = page.page.get_by_role("button", name=name)
        assert button.get_attribute("aria-disabled") == "true"
        assert button.get_attribute("title") == "Write the report first."


@pytest.mark.slow
def test_models_of_the_same_name_are_told_apart(study_file: Path, tab: Open, serve: Serve) -> None:
    session = Session(open_study(study_file))
    session.fit()
    session.add("drag")
    session.remove("drag")
    server = serve(study_file)
    page = tab().open(server).to("History")
    rows = page.page.locator(".ui-models tbody th")
    page.until(lambda: rows.count() == 3)
    names = rows.all_inner_texts()
    assert len(set(names)) == 3
    page.to("Compare")
    options = page.page.get_by_label("Model", exact=True).locator("option").all_inner_texts()
    assert len(set(options)) == 3
    assert page.page.get_by_label("Model", exact=True).input_value() == session.models.current_group
