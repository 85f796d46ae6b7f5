"""The pipelines run as they stand."""

from __future__ import annotations

import ast
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parents[1] / "pipelines"
SCRIPTS = sorted([*HERE.glob("*.py"), *HERE.glob("cluster/*.py")])


def run(name: str, *words: str | Path) -> str:
    """What a pipeline prints."""
    done = subprocess.run([sys.executable, HERE / name, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_films_to_a_law_and_what_it_lacks() -> None:
    said = run("one_film.py")
    assert "missing: patch missing" in said
    before, after = map(float, re.findall(r"held out ([\d.]+) um, with patch ([\d.]+) um", said)[0])
    assert after < 0.3 * before


@pytest.mark.usefixtures("few_evaluations")
def test_searches_side_by_side(
    study_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["searches.py", str(study_file), "--model", "coulomb,viscous", "--searches", "varpro,ga"]
    monkeypatch.setattr(sys, "argv", words)
    runpy.run_path(str(HERE / "searches.py"), run_name="__main__")
    said = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in said] == ["search", "varpro", "ga"]
    assert float(said[1].split()[1]) == pytest.approx(1.2, rel=0.05)
    assert min(float(line.split()[4]) for line in said[1:]) == 0.0  # the best one is over the best by nothing


@pytest.mark.slow
def test_a_campaign_of_a_broken_study(tmp_path: Path) -> None:
    """The processes of a batch import the script that asked for them; it must not begin again in each."""
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "study.toml").write_text("[study]\nmas = 1\n")
    said = run("campaign.py", tmp_path / "broken", "--output", tmp_path / "all", "--workers", "1")
    assert said.count("failed: ") == 1
    assert (tmp_path / "all.html").exists()


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_every_script_says_how_it_is_called(script: Path) -> None:
    doc = ast.get_docstring(ast.parse(script.read_text(encoding="utf-8")))
    assert doc
    assert f"python pipelines/{script.relative_to(HERE).as_posix()}" in doc
    assert script.name in (HERE / "README.md").read_text(encoding="utf-8")
