"""Notebooks in a real JupyterLab: the linked plots answer there too, and no page of theirs asks anybody outside."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, Open

import frictrack as ft
from frictrack.base.errors import FrictrackError
from frictrack.flow import Session, open_study
from frictrack.workbench.notebook import look

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
FILM = Path(__file__).parents[1] / "sample_videos" / "fast.avi"
SETTINGS = {  # what JupyterLab itself would ask of the network
    "@jupyterlab/apputils-extension:notification": {"checkForUpdates": False, "fetchNews": "false"},
}
in_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")


@pytest.fixture
def study(study_file: Path) -> Path:
    session = Session(open_study(study_file))
    session.fit()
    session.add("drag")
    return study_file


@pytest.mark.slow
def test_the_plots_of_a_study_and_what_is_selected(study: Path) -> None:
    shown = look(study, background="1_coulomb+viscous")
    assert shown.scene["rows"] == 1500
    assert len(shown.data) == 4 * sum(length for _, length in shown.scene["columns"].values())
    assert any(layer["y"] == "other" for layer in shown.scene["plots"][0]["layers"] if "y" in layer)
    shown.rows = np.array([3, 4, 700], "<i4").tobytes()  # as the browser tells it
    assert {name: list(frames) for name, frames in shown.selected.items()} == {"slow": [3, 4], "middle": [200]}
    assert shown.films == []  # these runs are tables
    with pytest.raises(FrictrackError, match=r'expected one of 1_coulomb\+viscous, .* but got "2_tustin"'):
        look(study, model="2_tustin")


def test_a_fit_is_shown_without_a_study_file() -> None:
    runs = ft.samples.runs()[:2]
    fit, other = ft.fit(["coulomb", "viscous"], runs), ft.fit("coulomb", runs)
    shown = look(fit, background=other)
    assert [run["name"] for run in shown.scene["runs"]] == [run.name for run in runs]
    at, length = shown.scene["columns"]["left"]
    left = np.frombuffer(shown.data, "<f4")[at : at + length]
    assert np.nanstd(left) == pytest.approx(1e6 * np.std(np.concatenate([c.residual for c in fit.curves])), rel=0.01)
    with pytest.raises(FrictrackError, match='but got the name "1_coulomb"'):
        look(fit, background="1_coulomb")


def test_frames_of_a_film_are_answered_with_its_picture() -> None:
    runs = ft.samples.runs()[:1]
    shown, sent = look(ft.fit("coulomb", runs), films={runs[0].name: FILM}), []
    shown.send = lambda content, buffers=(): sent.append((content, buffers))  # type: ignore[method-assign]
    shown._send_frame(shown, {"id": 1, "run": runs[0].name, "frame": 3}, [])
    assert sent[0][0] == {"id": 1}
    assert sent[0][1][0][:2] == b"\xff\xd8"  # a JPEG
    assert shown.films[0]["run"] == runs[0].name
    shown._send_frame(shown, {"id": 2, "run": "unknown", "frame": 3}, [])
    assert "unknown" in sent[1][0]["error"]


def test_a_study_without_a_model_is_told(study_file: Path) -> None:
    with pytest.raises(FrictrackError, match=r"expected a study with a model but .* run `frictrack run` on it"):
        look(study_file)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    """JupyterLab over a folder with the project's notebooks."""
    folder = tmp_path_factory.mktemp("lab")
    for path in NOTEBOOKS.glob("*.ipynb"):
        shutil.copy(path, folder)
    settings = tmp_path_factory.mktemp("settings")
    (settings / "overrides.json").write_text(json.dumps(SETTINGS))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [
        *(sys.executable, "-m", "jupyterlab", "--no-browser", "--ip=127.0.0.1", f"--port={port}", "--allow-root"),
        *("--IdentityProvider.token=", f"--ServerApp.root_dir={folder}", f"--LabApp.app_settings_dir={settings}"),
    ]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    address = f"http://127.0.0.1:{port}"
    for _ in range(600):
        try:
            urllib.request.urlopen(f"{address}/api")
            break
        except OSError:
            time.sleep(0.1)
    yield address, folder
    process.terminate()
    process.wait(20)


@pytest.mark.slow
@in_chromium
def test_the_plots_answer_in_jupyterlab(lab: tuple[str, Path], tab: Open, study: Path) -> None:
    import nbformat  # noqa: PLC0415 - three seconds that only the process of this file spends

    address, folder = lab
    films = {"slow": str(FILM), "middle": str(FILM), "fast": str(FILM)}
    cell = nbformat.v4.new_code_cell(
        f"from frictrack.workbench.notebook import look\nlook({str(study)!r}, films={films!r})"
    )
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    nbformat.write(nbformat.v4.new_notebook(cells=[cell], metadata=kernel), folder / "look.ipynb")
    page = tab()
    page.page.goto(f"{address}/lab/tree/look.ipynb?reset")
    page.sees("| Idle")  # the kernel listens
    page.page.locator(".jp-Notebook .jp-CodeCell").first.click()
    page.page.keyboard.press("Shift+Enter")
    page.page.locator(".fp-plot").nth(4).wait_for()
    page.drag(1)
    page.page.locator(".fp-words", has_text="frames selected").wait_for()
    page.page.locator(".fp-label", has_text="frame").wait_for()  # Python has answered with a picture
    page.picture("lab")


@pytest.mark.slow
@in_chromium
@pytest.mark.parametrize("name", sorted(path.name for path in NOTEBOOKS.glob("*.ipynb")))
def test_no_notebook_asks_anybody_outside(lab: tuple[str, Path], tab: Open, name: str) -> None:
    page = tab()  # which fails for any request that leaves the machine
    page.page.goto(f"{lab[0]}/lab/tree/{name}?reset")
    page.page.locator(".jp-Notebook .jp-MarkdownCell").first.wait_for()
    page.page.wait_for_timeout(1000)
