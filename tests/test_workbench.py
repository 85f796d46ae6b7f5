"""The workbench in a real browser: the loop from film to fallen error, and all that may go wrong on the way.

Screenshots go to `FRICTRACK_ARTEFACTS`, when set.
"""

from __future__ import annotations

import os
import re
import runpy
import shutil
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from browser import CHROMIUM, SLOW, Open, Server

from frictrack.errors import FrictrackError
from frictrack.flow import Session, open_study, replay_script
from frictrack.workbench.compare_tab import CompareTab
from frictrack.workbench.film_tab import stored_upload
from frictrack.workbench.missing_tab import MissingTab
from frictrack.workbench.page_state import PageState
from frictrack.workbench.plots_with_film import OpenFilms

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")
FOCUSED = """() => {
    let a = document.activeElement;
    while (a.shadowRoot) a = a.shadowRoot.activeElement;
    return a.tagName;
}"""
SAMPLES = Path(__file__).parent.parent / "sample_videos"


@contextmanager
def held(study: Path, words: str) -> Iterator[None]:
    """As soon as the work of a study has said these words, its process stands still: no machine is too quick."""
    until = time.monotonic() + SLOW / 1000
    while not (said := [p for p in study.parent.glob("*/.frictrack/jobs/*/progress.jsonl") if words in p.read_text()]):
        assert time.monotonic() < until
        time.sleep(0.02)
    folder = os.fsencode(said[0].parent)
    pid = next(int(p.parent.name) for p in Path("/proc").glob("[0-9]*/cmdline") if folder in p.read_bytes())
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


CHOSEN, GHOST = (213, 94, 0), (187, 187, 187)


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with films and nothing else."""
    folder = tmp_path_factory.mktemp("bench")
    for film in SAMPLES.glob("*.avi"):
        shutil.copy(film, folder)
    return folder


@pytest.fixture(scope="module")
def bench(films: Path) -> Iterator[Server]:
    server = Server(films).start()
    yield server
    server.stop()


@pytest.fixture
def tables(study_file: Path) -> Iterator[Server]:
    server = Server(study_file).start()
    yield server
    server.stop()


def test_from_films_to_a_fallen_error(bench: Server, tab: Open) -> None:
    page = tab().open(bench)
    for film in sorted(SAMPLES.glob("*.avi")):
        if film.stem != "double_mass":  # one mass for all films
            page.page.get_by_label(film.name).check()
    for label, value in {"Mass of the slider": "0.35 kg", "Frames per second": "4000", "Scale": "0.5 mm/px"}.items():
        page.page.get_by_label(label).fill(value)
    page.picture("1_films")
    page.click("Add to the study").hears("study.toml is written")
    page.sees("frame 0 of 150")
    page.click("Run everything").hears("run: done")
    page.sees(re.compile(r"Tustin: reduced chi-squared .*missing"))
    page.picture("2_measured")
    for title in ("2 Motion", "3 Model", "4 Compare"):
        page.to(title).page.wait_for_timeout(700)
        page.picture(title.replace(" ", "_"))
    page.to("5 What is missing?").sees("An effect is missing: patch")
    page.click("Try patch").hears("attempt patch: done")
    page.until(lambda: min(page.ink(GHOST, layer=0), default=0) > 50)
    page.picture("5_tried")
    page.click("Add patch").hears("add patch: done")
    page.click("Find what is missing").hears("diagnose: done")
    page.sees("Undetermined: these runs cannot show whether something is missing")  # drag, at one mass
    page.sees(re.compile("Held-out error falls from"))
    page.picture("6_added")
    page.to("6 History and report").sees("Tustin + patch (current)")
    page.click("Undo").hears("undo: done")
    page.sees("Tustin (current)")
    page.click("Redo").hears("redo: done")
    page.sees("Tustin + patch (current)")
    page.click("Write the report").hears("report: done")
    with page.page.expect_download() as got:
        page.page.get_by_text("Report (HTML)", exact=True).click()
    assert "patch" in Path(got.value.path()).read_text(encoding="utf-8")
    with page.page.expect_download(timeout=SLOW) as got:
        page.page.get_by_text("Report (PDF)", exact=True).click()
    assert Path(got.value.path()).read_bytes().startswith(b"%PDF-")
    page.picture("7_history")


def test_what_is_selected_in_one_plot_shows_in_all_others_and_on_the_film(bench: Server, tab: Open) -> None:
    page = tab().open(bench).to("4 Compare")
    page.until(lambda: page.ink(CHOSEN) == [0] * 5)
    page.drag(1)
    page.page.locator(".ft-status", has_text="frames selected").wait_for()
    page.until(lambda: min(page.ink(CHOSEN)) > 50)
    page.until(lambda: re.search(r"frame [1-9]\d* of", page.page.locator(".ft-label").inner_text()) is not None)
    page.picture("8_brushed")
    page.page.keyboard.press("Escape")
    page.until(lambda: page.ink(CHOSEN) == [0] * 5)


def test_plots_answer_the_keyboard(bench: Server, tab: Open) -> None:
    page = tab().open(bench).to("4 Compare")
    page.until(lambda: page.ink(CHOSEN) == [0] * 5)
    page.page.locator(".ft-plot canvas[tabindex]").first.focus()
    page.page.keyboard.press("PageDown")
    page.page.locator(".ft-status", has_text="frame 25").wait_for()
    for _ in range(3):
        page.page.keyboard.press("Shift+ArrowRight")
    page.page.locator(".ft-status", has_text="4 frames selected").wait_for()
    page.page.keyboard.press("Tab")  # and on to the next plot
    assert page.page.evaluate(FOCUSED) == "CANVAS"


def test_a_target_is_drawn_on_the_film_and_taken_back(bench: Server, tab: Open) -> None:
    page = tab().open(bench)
    page.sees("frame 0 of 150")
    before = bench.study.joinpath("study.toml").read_text(encoding="utf-8")
    page.click("target")
    canvas = page.page.locator(".ft-frame")
    film = canvas.bounding_box()
    assert film is not None

    def ready() -> bool:
        page.page.mouse.move(film["x"] + 19, film["y"] + 9)
        page.page.mouse.move(film["x"] + 20, film["y"] + 10)
        return bool(canvas.evaluate("(c) => c.style.cursor") == "crosshair")

    page.until(ready)
    page.page.mouse.down()
    page.page.mouse.move(film["x"] + 90, film["y"] + 50, steps=4)
    page.page.mouse.up()
    page.hears("edit: done")
    assert re.search(r"target = \[[\d., ]+\]", bench.study.joinpath("study.toml").read_text())
    page.click("Undo").hears("undo: done")
    assert bench.study.joinpath("study.toml").read_text(encoding="utf-8") == before


def test_the_script_of_a_session_repeats_it(
    bench: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The models come back; the diagnosis and the report that it ends with are tested elsewhere."""
    folder = tmp_path / "again"
    shutil.copytree(bench.study, folder)
    study = open_study(folder / "study.toml")
    before = Session(study).models.groups
    (folder / "repeat.py").write_text(replay_script(study), encoding="utf-8")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(Session, "diagnose", lambda session: {"verdict": "a verdict"})
    monkeypatch.setattr(Session, "report", lambda session: "a report")
    runpy.run_path("repeat.py")
    assert capsys.readouterr().out.splitlines() == ["a verdict", "a report"]
    assert [name.split("_", 1)[1] for name in Session(study).models.groups] == [n.split("_", 1)[1] for n in before]


def test_two_tabs_see_the_same_and_do_not_undo_each_other_unseen(tables: Server, tab: Open) -> None:
    one, other = tab().open(tables).to("3 Model"), tab().open(tables).to("6 History and report")
    one.click("Fit").hears(": done")
    other.sees("coulomb + viscous (current)")
    one.page.get_by_label("fixed at").first.fill("2.0")
    one.page.keyboard.press("Enter")
    one.hears("edit: done")
    other.sees("Changed since these results were made: what the model was fitted to.")
    other.page.get_by_role("button", name="Undo", disabled=False).wait_for()
    other.click("Undo").hears("undo: done")
    assert "F_c" not in tables.study.read_text(encoding="utf-8")


def test_work_is_cancelled_and_found_again_after_a_reload(tables: Server, tab: Open) -> None:
    page = tab().open(tables).to("3 Model")
    page.page.get_by_label("Search").select_option("sga")
    page.page.get_by_label("Another model").fill("tustin")
    page.click("Fit")
    with held(tables.study, "sga: misfit"):
        page.sees(re.compile("sga: misfit"))
        page.page.reload()
        page.sees(re.compile("sga: misfit"))
        page.picture("9_search")
        page.click("Cancel")
        page.until(lambda: any(tables.study.parent.glob("*/.frictrack/jobs/*/cancel")))
    page.hears("fit tustin sga all 0: cancelled")
    page.click("Run everything").hears("run: done")


def test_a_formula_of_the_unexplained_is_taken_into_the_law(study_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    toml = '[[effect]]\neffect = "unexplained"\nformula = "F * (x - c)/w"\nunits = {F = "N", c = "m", w = "m"}\n'
    toml += "bounds = {c = [0.0, 0.5], w = [0.01, 0.1]}\n"
    state, asked = PageState(study_file), []
    state.load()
    monkeypatch.setattr(state, "start_job", lambda do, **told: asked.append((do, told)))
    for _ in range(2):
        MissingTab(state, OpenFilms())._add_formula(toml)
        state.load()
    assert asked == [("add", {"effect": "unexplained"}), ("add", {"effect": "unexplained_2"})]
    assert [effect.formula for effect in open_study(study_file).effects] == ["F * (x - c)/w"] * 2


def test_the_comparison_opens_on_the_current_model(study_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session, seen = Session(open_study(study_file)), []
    session.fit()
    session.add("drag")
    state = PageState(study_file)
    state.load()
    compare = CompareTab(state, OpenFilms())
    monkeypatch.setattr(compare.plots_with_film, "draw", lambda *scene: seen.append(compare.model.value))
    compare.refresh()
    assert seen == ["2_coulomb+viscous+drag"]  # once; another one first would leave its axes behind


def test_a_killed_server_loses_nothing(tables: Server, tab: Open) -> None:
    page = tab().open(tables)
    page.click("Run everything")
    page.sees(re.compile("run: .+"))
    tables.stop(signal.SIGKILL)
    tables.start()
    again = tab().open(tables).to("6 History and report")
    again.sees("coulomb + viscous (current)")
    page.faults.clear()  # its server was taken from it


def test_a_broken_film_gets_one_clear_sentence(tmp_path: Path, tab: Open) -> None:
    (tmp_path / "broken.avi").write_bytes((SAMPLES / "fast.avi").read_bytes()[:4000])
    server = Server(tmp_path).start()
    try:
        page = tab().open(server)
        page.page.get_by_label("broken.avi").check()
        for label, value in {"Mass of the slider": "0.35 kg", "Frames per second": "4000", "Scale": "0.5 mm"}.items():
            page.page.get_by_label(label).fill(value)
        page.click("Add to the study").hears("px")  # of the scale
        page.page.get_by_label("Scale").fill("0.5 mm/px")
        page.click("Add to the study").hears("broken.avi")
        assert not (tmp_path / "study.toml").exists()
        page.picture("10_broken")
    finally:
        server.stop()


def test_the_page_asks_for_its_token(study_file: Path, tab: Open) -> None:
    server = Server(study_file, token="sesame").start()
    try:
        page = tab()
        page.page.goto(server.bare_address)
        assert "token" in page.page.content()
        page.page.goto(server.bare_address + "?token=wrong")
        assert "token" in page.page.content()
        page.faults.clear()  # those were refused, as they should be
        page.page.goto(server.address)
        page.sees("1 Film")
        page.page.goto(server.bare_address)  # the cookie is enough now
        page.sees("1 Film")
    finally:
        server.stop()


@pytest.mark.parametrize("name", ["../outside.avi", "..\\outside.avi", "/etc/outside.avi", "a/../../outside.avi"])
def test_an_uploaded_name_cannot_leave_the_folder(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "study"
    folder.mkdir()
    assert stored_upload(folder, name, b"film") == "outside.avi"
    assert [p.name for p in tmp_path.rglob("*.avi")] == ["outside.avi"]
    with pytest.raises(FrictrackError, match="different content"):
        stored_upload(folder, name, b"another")


@pytest.mark.parametrize("name", ["", "..", ".", "...", ".hidden", "a/.."])
def test_an_uploaded_name_that_is_none_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(FrictrackError, match="expected the file name of a recording"):
        stored_upload(tmp_path, name, b"film")
