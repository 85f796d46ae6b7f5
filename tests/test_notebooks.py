"""The notebooks run: the demo's on the files of a finished study, those of the papers on what they render."""

from __future__ import annotations

import shutil
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

from frictrack.flow import Session, open_study

NOTEBOOK = Path(__file__).parents[1] / "notebooks" / "demo.ipynb"


def execute(folder: Path, path: Path = NOTEBOOK) -> nbformat.NotebookNode:
    """The notebook with its outputs, run in a folder."""
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(folder)}})
    return client.execute()


@pytest.fixture
def finished(study_file: Path, tmp_path: Path) -> Path:
    """A folder with a small study as `frictrack demo` leaves one: fitted, diagnosed, one effect added."""
    folder = tmp_path / "frictrack_demo"
    folder.mkdir()
    for path in (study_file, *tmp_path.glob("*.csv")):
        shutil.move(path, folder / path.name)
    session = Session(open_study(folder / "study.toml"))
    session.diagnose()
    session.add("drag")
    session.results()
    return tmp_path


def test_notebook_draws_the_demo_from_its_files(finished: Path):
    before = {p: p.read_bytes() for p in finished.rglob("*.h5")}
    notebook = execute(finished)
    outputs = [o for cell in notebook.cells for o in cell.get("outputs", [])]
    figures = [o for o in outputs if "image/svg+xml" in o.get("data", {})]
    assert len(figures) >= 8
    printed = "".join(o["text"] for o in outputs if o.output_type == "stream" and o.name == "stdout")
    assert "drag" in printed
    assert "verdict on Coulomb + viscous + drag" in printed
    assert {p: p.read_bytes() for p in finished.rglob("*.h5")} == before  # read, not made again


def test_notebook_says_which_command_is_missing(tmp_path: Path):
    with pytest.raises(CellExecutionError, match="run `frictrack demo` there first"):
        execute(tmp_path)


PAPERS = {"first_paper": (14, "MGA needs fewer iterations than GA"), "second_paper": (2, "the sine filter improves")}
STORIES = {
    "ten_minutes": (5, "verdict on Tustin + texture: complete"),
    "real_data": (1, "missing: presliding"),
    "own_effect": (3, "verdict on Coulomb + viscous + magnet: complete"),
}


LONG = ("real_data", "first_paper")  # what they show is tested in test_real_data and test_reproduce too


@pytest.mark.parametrize(
    ("name", "figures", "claim"),
    [
        pytest.param(name, *told, marks=[pytest.mark.slow] if name in LONG else [])
        for name, told in (PAPERS | STORIES).items()
    ],
)
def test_notebook_runs_and_is_kept_with_its_outputs(name: str, figures: int, claim: str, tmp_path: Path):
    path = NOTEBOOK.with_name(f"{name}.ipynb")
    for notebook in (nbformat.read(path, as_version=4), execute(tmp_path, path)):
        nbformat.validate(notebook)
        outputs = [o for cell in notebook.cells for o in cell.get("outputs", [])]
        assert sum("image/svg+xml" in o.get("data", {}) for o in outputs) >= figures
        printed = "".join(o["text"] for o in outputs if o.output_type == "stream" and o.name == "stdout")
        assert claim in printed
        if name in PAPERS:
            assert any("text/html" in o.get("data", {}) for o in outputs)
            assert "DOES NOT HOLD" in printed
    assert list(tmp_path.iterdir()) == []


def test_the_demo_is_kept_with_its_outputs():
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    outputs = [o for cell in notebook.cells for o in cell.get("outputs", [])]
    assert sum("image/svg+xml" in o.get("data", {}) for o in outputs) >= 8
    assert any("verdict on Tustin + texture: complete" in o.get("text", "") for o in outputs)
