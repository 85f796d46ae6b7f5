"""Run the code of documentation pages, and compare the output with the one that the pages show.

    python docs/generators/run_pages.py [--update] PAGE...

A page is run from top to bottom in a folder that holds only the files that the page offers for download:

- a block with a caption is written to the file of that name;
- the commands of a ``console`` block (lines that begin with ``$``) are run by bash; the lines below a command are its
  expected output;
- a ``python`` block is run in the name space of the page; a ``text`` block below it is its expected output.

``...`` stands for output that is not shown; a command without shown output must succeed. A block with ``:class: slow``
is left out of the quick tests. With ``--update``, outputs that differ are written into the page, and pictures that the
page made replace those of the same name in ``figures`` beside the page (``report.png`` shows ``report.html``).
"""

from __future__ import annotations

import argparse
import doctest
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
WIDTH = "80"  # columns of the terminal
TIMEOUT_S = 300  # of one command
FENCE = re.compile(
    r"^(?P<fence>`{3,}|:{3,})(?P<info>[^\n`]*)\n(?P<body>.*?)^(?P=fence)[ \t]*$", re.MULTILINE | re.DOTALL
)
CAPTION = re.compile(r"^:caption: *(.+)$", re.MULTILINE)
OPTIONS = re.compile(r"\A(?::\w+:[^\n]*\n)+\n?")
DOWNLOAD = re.compile(r"\{download\}`[^`<]*<([^>`]+)>`")
FIGURE = re.compile(r"!\[[^\]]*\]\(figures/([^)]+)\)|\{(?:image|figure)\} figures/(\S+)")
SAME = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
# Runs the Python blocks of one page: reads each as a line of JSON, and answers with what it printed.
INTERPRETER = """
import contextlib, io, json, sys
names = {"__name__": "__main__"}
for number, line in enumerate(sys.stdin, 1):
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(json.loads(line), f"<Python block {number}>", "exec"), names)
    print(json.dumps(printed.getvalue()), flush=True)
"""


@dataclass(frozen=True)
class Block:
    """One fenced block of a page.

    Attributes
    ----------
    language
        Language of the code, such as "python".
    text
        Its lines, without options.
    file
        Name of the file that it is written to; "" for none.
    slow
        Whether the block is marked as slow.
    begin, end
        Where its lines stand in the page.
    follows
        Whether only blank lines separate it from the block before.

    """

    language: str
    text: str
    file: str
    slow: bool
    begin: int
    end: int
    follows: bool


@dataclass(frozen=True)
class Difference:
    """Output that is not the one that the page shows; `begin` and `end` say where the page shows it."""

    command: str
    shown: str
    printed: str
    begin: int
    end: int

    def __str__(self) -> str:
        return f"{self.command}\n--- shown\n{self.shown}--- printed\n{self.printed}"


def blocks(page: str) -> Iterator[Block]:
    """Yield the fenced blocks of a page, also those inside of tabs and boxes."""
    before = 0
    for match in FENCE.finditer(page):
        info, body, begin = match["info"].strip(), match["body"], match.start("body")
        if match["fence"].startswith(":") or (info.startswith("{") and not info.startswith("{code-block}")):
            for inner in blocks(body):
                yield Block(**vars(inner) | {"begin": inner.begin + begin, "end": inner.end + begin})
        else:
            options = OPTIONS.match(body)
            first = options.end() if options else 0
            caption = CAPTION.search(body, 0, first)
            yield Block(
                language=info.removeprefix("{code-block}").strip(),
                text=body[first:],
                file=caption[1].strip() if caption else "",
                slow=":class: slow" in body[:first],
                begin=begin + first,
                end=match.end("body"),
                follows=not page[before : match.start()].strip(),
            )
        before = match.end()


class PageRun:
    """Run the blocks of one page in a folder.

    Parameters
    ----------
    folder
        Folder in which commands and code are run, and files are written.
    quick
        Leave out the blocks that are marked as slow.

    """

    def __init__(self, folder: Path, *, quick: bool = False) -> None:
        self.here, self.quick = folder, quick
        self.environment = _environment(folder.parent / f"{folder.name}_bin")
        self.python: subprocess.Popen[str] | None = None
        self.printed: tuple[str, str] | None = None  # the last Python block, and what it printed

    def differences(self, page: str) -> Iterator[Difference]:
        """Run all blocks; yield the outputs that differ from the page."""
        try:
            for block in blocks(page):
                if not (self.quick and block.slow):
                    yield from self._run(block)
        finally:
            self._close()

    def _run(self, block: Block) -> Iterator[Difference]:
        printed, self.printed = self.printed, None
        if block.file:
            path = self.here / block.file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text, encoding="utf-8")
        elif block.language == "console":
            yield from self._console(block)
        elif block.language == "python":
            self.printed = block.text, self._evaluate(block.text)
        elif block.language == "text" and block.follows and printed and not same(block.text, printed[1]):
            yield Difference(printed[0], block.text, printed[1], block.begin, block.end)

    def _console(self, block: Block) -> Iterator[Difference]:
        lines = block.text.splitlines(keepends=True)
        starts = [i for i, line in enumerate(lines) if line.startswith("$ ")]
        for i, until in zip(starts, [*starts[1:], len(lines)], strict=True):
            first = i + 1
            while lines[first - 1].endswith("\\\n"):
                first += 1
            shown, command = "".join(lines[first:until]), "".join(lines[i:first])[2:]
            printed, failed = self._command(command)
            if not same(shown, printed) if shown.strip() else failed:
                begin = block.begin + len("".join(lines[:first]))
                yield Difference(command, shown, printed, begin, begin + len(shown))

    def _command(self, command: str) -> tuple[str, bool]:
        """Run a command; return its standard output, with the errors if it failed, and whether it failed."""
        if command.startswith("cd "):
            self.here = (self.here / command[3:].strip()).resolve()
            return "", False
        done = subprocess.run(
            ["bash", "-c", command],
            cwd=self.here,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )
        failed = done.returncode != 0
        return done.stdout + (done.stderr if failed else ""), failed

    def _evaluate(self, code: str) -> str:
        """Run a Python block and return what it printed."""
        if self.python is None:
            self.python = subprocess.Popen(
                [sys.executable, "-W", "error::FutureWarning", "-c", INTERPRETER],
                cwd=self.here,
                env=self.environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        assert self.python.stdin is not None
        assert self.python.stdout is not None
        self.python.stdin.write(json.dumps(code) + "\n")
        self.python.stdin.flush()
        answer = self.python.stdout.readline()
        if not answer:
            raise RuntimeError(f"{code}\n{self.python.communicate()[1]}")
        printed: str = json.loads(answer)
        return printed

    def _close(self) -> None:
        if self.python is not None:
            self.python.communicate()


def same(shown: str, printed: str) -> bool:
    """Return whether output is the one shown, where ``...`` stands for anything."""
    starts = {shown.strip(), shown.strip().removeprefix("...\n")}
    expected = {part for start in starts for part in (start, start.removesuffix("\n..."))}
    check = doctest.OutputChecker().check_output
    return any(check(one, printed.strip(), SAME) for one in expected)


def update(path: Path, differences: list[Difference], folder: Path) -> None:
    """Write outputs into a page, and copy the pictures that it made in a folder."""
    page = path.read_text(encoding="utf-8")
    for one in sorted(differences, key=lambda one: -one.begin):
        page = page[: one.begin] + _trimmed(one.printed) + page[one.end :]
    path.write_text(page, encoding="utf-8")
    for match in FIGURE.finditer(page):
        target = path.parent / "figures" / (match[1] or match[2])
        target.parent.mkdir(exist_ok=True)
        for source in folder.rglob(target.name):
            shutil.copy(source, target)
        for source in folder.rglob(f"{target.stem}.html"):
            _take_first_screen(source, target)


def _take_first_screen(page: Path, target: Path) -> None:
    """Write what a screen of 1280 x 800 px shows of an HTML page."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 - only for pictures of pages

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"))
        view = browser.new_page(viewport={"width": 1280, "height": 800})
        view.goto(page.as_uri())
        view.screenshot(path=target)
        browser.close()


def run_page(path: Path, folder: Path, *, quick: bool = False) -> list[Difference]:
    """Run a page in an empty folder and return the outputs that differ from it."""
    page = path.read_text(encoding="utf-8")
    for offered in DOWNLOAD.findall(page):
        shutil.copy(path.parent / offered, folder)
    return list(PageRun(folder, quick=quick).differences(page))


def _trimmed(text: str) -> str:
    """Return text without blanks at the end of lines and blank lines at its ends."""
    return "\n".join(line.rstrip() for line in text.strip("\n").splitlines()) + "\n"


def _environment(folder: Path) -> dict[str, str]:
    """Return the environment of the commands, in which `frictrack` is this working copy."""
    folder.mkdir(exist_ok=True)
    for name, module in {"frictrack": " -m frictrack", "python": ""}.items():
        command = folder / name
        command.write_text(f'#!/bin/sh\nexec "{sys.executable}"{module} "$@"\n', encoding="utf-8")
        command.chmod(0o755)
    return os.environ | {
        "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "COLUMNS": WIDTH,
        "MPLBACKEND": "agg",
        "OMP_NUM_THREADS": "1",
    }


def main() -> None:
    """Run the pages of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="+", type=Path)
    parser.add_argument("--update", action="store_true")
    arguments = parser.parse_args()
    for path in arguments.pages:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) / "page"
            folder.mkdir()
            found = run_page(path, folder)
            if arguments.update:
                update(path, found, folder)
            for one in found:
                sys.stdout.write(f"{path}: {one}\n")


if __name__ == "__main__":
    main()
