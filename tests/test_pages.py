"""The code of tutorials and how-to guides runs, and prints what the pages show."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer

import frictrack.cli.study_commands
import frictrack.cli.utility_commands  # noqa: F401 - they put the commands into `app`
from frictrack.cli.common import app
from frictrack.measure.calibration import parse_scale
from frictrack.study.loading import TABLES

DOCS = Path(__file__).resolve().parents[1] / "docs"
sys.path.insert(0, str(DOCS / "generators"))

from run_pages import PageRun, blocks, run_page, same  # noqa: E402 - the generators of the documentation are no package

PAGES = sorted(p for folder in ("tutorials", "how-to") for p in (DOCS / folder).glob("*.md"))
WITH_CODE = [p for p in PAGES if any(b.language in ("console", "python") for b in blocks(p.read_text("utf-8")))]
NAMES = [p.stem for p in WITH_CODE]


@pytest.mark.slow
def test_the_quick_blocks_of_a_page_print_what_it_shows(tmp_path):
    assert "\n".join(map(str, run_page(DOCS / "tutorials" / "arrays.md", tmp_path, quick=True))) == ""


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_CODE, ids=NAMES)
def test_the_blocks_of_a_page_print_what_it_shows(page, tmp_path):
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


def snippets(language: str) -> list[tuple[str, str]]:
    """Blocks that are no files, with the name of their page."""
    return [
        (page.name, block.text)
        for page in sorted(DOCS.glob("*/*.md"))
        for block in blocks(page.read_text("utf-8"))
        if block.language == language and not block.file
    ]


@pytest.mark.parametrize(("page", "text"), snippets("toml"))
def test_every_piece_of_a_study_file_is_understood(page, text, tmp_path):
    raw = tomllib.loads(text)
    for name in re.findall(r'"([\w-]+\.(?:csv|avi|png|yml))"', text):
        (tmp_path / name).touch()
    assert set(raw) <= set(TABLES)
    for table, entries in raw.items():
        for entry in entries if isinstance(entries, list) else [entries]:
            read = TABLES[table].model_validate(entry, context={"folder": tmp_path})
            if getattr(read, "scale", None) is not None:
                parse_scale(read.scale)


def commands() -> set[str]:
    """Return the commands of all pages, whether they are run or not, without their first word."""
    text = "\n".join(text for language in ("sh", "console") for _, text in snippets(language))
    lines = re.findall(r"^(?:\$ )?frictrack (.+?)(?: \|\|.*)?$", text, re.MULTILINE)
    return {part for line in lines for part in line.split(" && frictrack ")}


@pytest.mark.parametrize("line", sorted(commands()))
def test_every_command_and_its_options_exist(line):
    command, words = typer.main.get_command(app), shlex.split(line, comments=True)
    while subcommands := getattr(command, "commands", None):
        command, words = subcommands[words[0]], words[1:]
    known = {option for parameter in command.params for option in parameter.opts}
    assert {word for word in words if word.startswith("-")} <= known


def test_other_output_than_the_one_shown_is_found(tmp_path):
    page = "```console\n$ echo 12\n13\n```\n\n```python\nprint(1)\n```\n\n```text\n2\n```\n"
    found = list(PageRun(tmp_path).differences(page))
    assert [(one.shown, one.printed) for one in found] == [("13\n", "12\n"), ("2\n", "1\n")]
    assert [page[one.begin : one.end] for one in found] == ["13\n", "2\n"]


def test_a_failing_command_is_shown_with_its_error_or_is_a_difference(tmp_path):
    page = "```console\n$ ls a1\nls: ... No such file or directory\n$ ls b2\n```\n"
    (found,) = PageRun(tmp_path).differences(page)
    assert found.command == "ls b2\n"


def test_files_and_folders_of_a_page_stay_together(tmp_path):
    page = "```{code-block} toml\n:caption: sub/a.toml\na = 1\n```\n```console\n$ cd sub\n$ cat a.toml\na = 1\n```\n"
    assert list(PageRun(tmp_path).differences(page)) == []
    assert (tmp_path / "sub" / "a.toml").read_text() == "a = 1\n"


def test_a_failing_python_block_is_an_error(tmp_path):
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        list(PageRun(tmp_path).differences("```python\n1 / 0\n```\n"))


def test_dots_stand_for_output_that_is_not_shown():
    assert same("a\n...\nd", "a\nb\nc\nd\n")
    assert same("...\na\n...\n", "a\n")
    assert not same("a\n...\ne", "a\nb\nc\nd\n")
    assert not same("...\na\n...\n", "b\n")
    assert not same("", "a\n")
