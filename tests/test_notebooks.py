"""The notebooks: the demo's runs on the files of a finished study; what the others use exists; `slow` runs them all."""

from __future__ import annotations

import ast
import hashlib
import importlib
import json
import re
import shutil
from inspect import signature
from pathlib import Path
from typing import Any

import pytest

from frictrack.flow import Session, open_study

NOTEBOOK = Path(__file__).parents[1] / "notebooks" / "demo.ipynb"


def execute(folder: Path, path: Path = NOTEBOOK) -> Any:
    """Run a notebook in a kernel of its own, in a folder; returns it with its outputs."""
    import nbformat  # noqa: PLC0415 - three seconds that only the process of this file spends
    from nbclient import NotebookClient  # noqa: PLC0415

    """The notebook with its outputs, run in a folder."""
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(folder)}})
    return client.execute()


def code_of(path: Path) -> str:
    """The code of a notebook's cells, one after the other."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "code")


def kept(path: Path) -> Any:
    """A notebook as it is kept, found valid."""
    import nbformat  # noqa: PLC0415

    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    return notebook


def names_used(tree: ast.Module) -> dict[str, Any]:
    """What a notebook imports from frictrack, by the name that it has there."""
    found: dict[str, Any] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            named = {a.asname or a.name: a.name for a in node.names if a.name.startswith("frictrack")}
            found |= {name: importlib.import_module(module) for name, module in named.items()}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("frictrack"):
            module = importlib.import_module(node.module or "")
            for a in node.names:  # a name of the module, or a module in it
                own = getattr(module, a.name, None)
                found[a.asname or a.name] = own or importlib.import_module(f"{node.module}.{a.name}")
    return found


def callee(node: ast.expr, names: dict[str, Any]) -> Any:
    """The object of frictrack that an expression names; None for another one. `session` is a Session everywhere."""
    if isinstance(node, ast.Name):
        return names.get(node.id)
    owner = callee(node.value, names) if isinstance(node, ast.Attribute) else None
    return None if owner is None else getattr(owner, node.attr)  # an AttributeError where it has gone


@pytest.mark.parametrize("path", sorted(NOTEBOOK.parent.glob("*.ipynb")), ids=lambda path: path.stem)
def test_all_that_a_notebook_uses_exists_and_is_called_as_it_takes(path: Path, measured_tables: Path):
    tree = ast.parse(code_of(path))
    names = names_used(tree)
    assert names
    if "Session" in names:
        names["session"] = Session(open_study(measured_tables / "study.toml"))
    checked = 0
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            callee(node, names)
        if isinstance(node, ast.Call) and callable(called := callee(node.func, names)):
            plain = [a for a in node.args if not isinstance(a, ast.Starred)]
            bind = signature(called).bind if len(plain) == len(node.args) else signature(called).bind_partial
            bind(*plain, **{k.arg: k.value for k in node.keywords if k.arg})
            checked += 1
    assert checked


@pytest.fixture
def finished(study_file: Path, tmp_path: Path, few_evaluations: None) -> Path:
    """A folder with a small study as `frictrack demo` leaves one: fitted, diagnosed, one effect added."""
    folder = tmp_path / "frictrack_demo"
    folder.mkdir()
    for path in (study_file, study_file.with_name("study_results"), *tmp_path.glob("*.csv")):
        shutil.move(path, folder / path.name)
    session = Session(open_study(folder / "study.toml"))
    session.diagnose()
    session.add("drag")
    session.results()
    return tmp_path


@pytest.mark.slow
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


def test_notebook_says_which_command_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Exception, match="run `frictrack demo` there first"):
        exec(code_of(NOTEBOOK), {})


PAPERS = {"first_paper": (14, "MGA needs fewer iterations than GA"), "second_paper": (2, "the sine filter improves")}
STORIES = {
    "ten_minutes": (5, "verdict on Tustin + patch: complete"),
    "real_data": (1, "maxwell_slip       p 0.001"),
    "own_effect": (3, "verdict on Coulomb + viscous + magnet: complete"),
}


def outputs_of(notebook: Any) -> list[Any]:
    """All outputs of a notebook's cells."""
    return [o for cell in notebook.cells for o in cell.get("outputs", [])]


def assert_tells(notebook: Any, name: str, figures: int, claim: str) -> None:
    """The notebook shows at least so many figures and prints the claim; those of the papers say what does not hold."""
    outputs = outputs_of(notebook)
    assert sum(bool({"image/svg+xml", "image/png"} & {*o.get("data", {})}) for o in outputs) >= figures
    printed = "".join(o["text"] for o in outputs if o.output_type == "stream" and o.name == "stdout")
    assert claim in printed
    if name in PAPERS:
        assert any("text/html" in o.get("data", {}) for o in outputs)
        assert "DOES NOT HOLD" in printed


@pytest.mark.slow
@pytest.mark.parametrize(("name", "figures", "claim"), [(n, *what) for n, what in (PAPERS | STORIES).items()])
def test_a_notebook_is_kept_with_its_outputs(name: str, figures: int, claim: str):
    assert_tells(kept(NOTEBOOK.with_name(f"{name}.ipynb")), name, figures, claim)


@pytest.mark.parametrize("path", sorted(NOTEBOOK.parent.glob("*.ipynb")), ids=lambda path: path.stem)
def test_the_outputs_are_those_of_the_code(path: Path):
    notebook = kept(path)
    code = "\0".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    made_of = notebook.metadata.get("code_hash")
    hint = f"run `python pipelines/run_notebooks.py {path.stem}` and commit the notebook"
    assert made_of == hashlib.sha256(code.encode()).hexdigest(), f"{path.name} has outputs of other code; {hint}"
    counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1)), hint  # run once from the first cell to the last


def numbers_and_words(notebook: Any) -> list[tuple[list[str], list[float]]]:
    """What each cell printed: its words, and its numbers, without those of claims about processor time."""
    printed = ["".join(o["text"] for o in cell.get("outputs", []) if o.output_type == "stream" and o.name == "stdout")
               for cell in notebook.cells]  # fmt: skip
    timed = re.compile(r"(\btime\n  printed:.*\n)  here:.*")  # differs from run to run
    printed = [timed.sub(r"\1", text) for text in printed]
    number = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
    return [(number.sub("#", text).split(), [float(one) for one in number.findall(text)]) for text in printed]


@pytest.mark.slow
def test_the_second_paper_runs_with_little_effort(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    code = code_of(NOTEBOOK.with_name("second_paper.ipynb"))
    quick = code.replace("seeds=20, identified=2, generations=500", "seeds=4, identified=1, generations=24")
    assert quick != code
    exec(quick, {})
    printed = capsys.readouterr().out
    assert printed.count("<IPython.core.display.SVG object>") >= 2
    assert PAPERS["second_paper"][1] in printed


@pytest.mark.slow
@pytest.mark.parametrize(("name", "figures", "claim"), [(n, *what) for n, what in (PAPERS | STORIES).items()])
def test_a_notebook_runs(name: str, figures: int, claim: str, tmp_path: Path):
    path = NOTEBOOK.with_name(f"{name}.ipynb")
    now, stored = execute(tmp_path, path), kept(path)
    assert_tells(now, name, figures, claim)
    assert list(tmp_path.iterdir()) == []
    for (words, numbers), (old_words, old_numbers) in zip(*map(numbers_and_words, (now, stored)), strict=True):
        hint = f"{name} prints something else than it did; run `python pipelines/run_notebooks.py {name}`"
        assert words == old_words, hint
        assert numbers == pytest.approx(old_numbers, rel=0.05, abs=0.05), hint


def test_the_demo_is_kept_with_its_outputs():
    outputs = outputs_of(kept(NOTEBOOK))
    assert sum("image/svg+xml" in o.get("data", {}) for o in outputs) >= 8
    assert any("verdict on Tustin + patch: complete" in o.get("text", "") for o in outputs)
