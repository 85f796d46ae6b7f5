"""The code of tutorials and how-to guides runs, and prints what the pages show."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
sys.path.insert(0, str(DOCS / "generators"))

from run_pages import PageRun, blocks, run_page, same  # noqa: E402 - the generators of the documentation are no package

PAGES = sorted(p for folder in ("tutorials", "how-to") for p in (DOCS / folder).glob("*.md"))
WITH_CODE = [p for p in PAGES if any(b.language in ("console", "python") for b in blocks(p.read_text("utf-8")))]
NAMES = [p.stem for p in WITH_CODE]


@pytest.mark.parametrize("page", WITH_CODE, ids=NAMES)
def test_the_blocks_of_a_page_print_what_it_shows(page, tmp_path):
    assert "\n".join(map(str, run_page(page, tmp_path, quick=True))) == ""


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_CODE, ids=NAMES)
def test_the_slow_blocks_of_a_page_print_what_it_shows(page, tmp_path):
    assert "\n".join(map(str, run_page(page, tmp_path))) == ""


@pytest.mark.slow
def test_the_tutorial_on_arrays_has_the_types_that_it_says(tmp_path):
    page = (DOCS / "tutorials" / "arrays.md").read_text("utf-8")
    code = tmp_path / "arrays.py"
    code.write_text("\n".join(block.text for block in blocks(page) if block.language == "python"))
    strict = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", "--config-file=", str(code)]
    done = subprocess.run(
        strict,
        cwd=DOCS.parent,
        env=os.environ | {"MYPYPATH": str(DOCS.parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout


def test_other_output_than_the_one_shown_is_found(tmp_path):
    page = "```console\n$ echo 12\n13\n```\n\n```python\nprint(1)\n```\n\n```text\n2\n```\n"
    found = list(PageRun(tmp_path).differences(page))
    assert [(one.shown, one.printed) for one in found] == [("13\n", "12\n"), ("2\n", "1\n")]
    assert [page[one.begin : one.end] for one in found] == ["13\n", "2\n"]


def test_files_and_folders_of_a_page_stay_together(tmp_path):
    page = "```{code-block} toml\n:caption: sub/a.toml\na = 1\n```\n```console\n$ cd sub\n$ cat a.toml\na = 1\n```\n"
    assert list(PageRun(tmp_path).differences(page)) == []
    assert (tmp_path / "sub" / "a.toml").read_text() == "a = 1\n"


def test_a_failing_python_block_is_an_error(tmp_path):
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        list(PageRun(tmp_path).differences("```python\n1 / 0\n```\n"))


def test_dots_stand_for_output_that_is_not_shown():
    assert same("a\n...\nd", "a\nb\nc\nd\n")
    assert not same("a\n...\ne", "a\nb\nc\nd\n")
