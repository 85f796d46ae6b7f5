"""Write the reference of the JSON that commands print: run them on the sample runs, and list the fields."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
from json_meanings import SHARED, meaning
from page_text import code, plain, table, write_page

import frictrack as ft
from frictrack.cli import main

TABLES, FILM = "study.toml", "film.toml"
# Commands in the order in which they run, with their arguments.
COMMANDS = {
    "track": (FILM,),
    "motion": (TABLES,),
    "friction": (TABLES,),
    "fit": (TABLES,),
    "compare": (TABLES,),
    "diagnose": (TABLES,),
    "add": (TABLES, "patch"),  # before the first report: that of another model is computed whole again
    "report": (TABLES,),
    "export --to crate": (TABLES,),  # takes the report that is there
    "reproduce": ("study_results/study.crate.zip",),
    "export": (TABLES,),
    "export --to prior": (TABLES,),
    "verify": (TABLES,),
    "history": (TABLES,),
    "plan": (TABLES,),
    "effects": (),
}
BY_NAME = {
    "parameters",
    "detection_limits",
    "law",
    "not_planned",
    "at",
    "lost",
    "verdicts",
    "left_out",
}  # objects whose keys are names of the study
TYPES = {"str": "text", "float": "number", "int": "whole number", "bool": "true or false", "NoneType": "null"}

_HEAD = """# JSON

With `--json`, a command prints one JSON object on the standard output and nothing else. Lengths, times and forces are
in SI units where the name has no unit at its end. A value that is unknown is null. The tables list the fields of these
commands as they were printed for the sample runs; `[]` marks a list, `<name>` a key that the study gives.

`run` prints `fit`, `diagnose` and `output`; `demo` prints `diagnose`, `add`, `history` and `report`; `remove` prints
the same as `add`.

"""


def write_json_reference(folder: Path) -> None:
    """Write the page of all JSON into a folder; the commands run again only if the program has changed.

    Parameters
    ----------
    folder
        Folder of the generated pages.

    """
    kept = folder / "json_printed.json"
    mark = program_hash()
    stored = json.loads(kept.read_text()) if kept.exists() else {}
    if stored.get("mark") != mark:
        stored = {"mark": mark, "printed": print_all()}
        write_page(kept, json.dumps(stored))
    write_page(folder / "json.md", json_page(stored["printed"]))


def program_hash() -> str:
    """Return a hash of the source code of frictrack and of the commands that are run."""
    sources = sorted(Path(ft.__file__).parent.rglob("*.py"))
    return hashlib.sha256(repr(COMMANDS).encode() + b"".join(path.read_bytes() for path in sources)).hexdigest()


def print_all() -> dict[str, Any]:
    """Run the commands on the sample runs, and return what each prints."""
    folder = Path(tempfile.mkdtemp())
    try:
        write_studies(folder)
        with contextlib.chdir(folder):
            return {name: _printed(name, arguments) for name, arguments in COMMANDS.items()}
    finally:
        shutil.rmtree(folder)


def write_studies(folder: Path) -> None:
    """Write every second frame of the sample runs as tables and one of them as a film, each with its study file."""
    lines = ['[study]\nname = "sample"\nmass = 0.35\n']
    for run in ft.samples.runs():
        columns = {"t_s": run.displacement.t[::2], "x_m": run.displacement.x[::2]}
        pd.DataFrame(columns).to_csv(folder / f"{run.name}.csv", index=False)
        lines.append(f'[[run]]\ntable = "{run.name}.csv"\nmass = {run.mass}\n')
    (folder / TABLES).write_text("\n".join(lines))
    shutil.copy(ft.samples.films_folder() / "fast.avi", folder)
    camera = '[camera]\nfps = 4000\nscale = "0.5 mm/px"\n'
    (folder / FILM).write_text(f'[study]\nmass = 0.35\n{camera}[[run]]\nvideo = "fast.avi"\n')


def _printed(command: str, arguments: tuple[str, ...]) -> Any:
    """JSON that a command prints."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), open(os.devnull, "w") as nothing, contextlib.redirect_stderr(nothing):
        try:
            main([*command.split(), *arguments, "--json"])
        except SystemExit as end:
            if end.code:
                raise
    return json.loads(out.getvalue())


def json_page(printed: dict[str, Any]) -> str:
    """Return the page as Markdown.

    Parameters
    ----------
    printed
        What each command printed.

    """
    parts = [_HEAD + "## Objects that several commands print\n"]
    parts += [f"### {title}\n\n" + _shared_table(known) for title, known in dict(SHARED.values()).items()]
    parts.append("## Commands\n")
    parts += [_section(command, found) for command, found in printed.items()]
    return "\n".join(parts)


def _shared_table(known: dict[str, str]) -> str:
    return table(["field", "meaning"], [[code(name), plain(text)] for name, text in known.items()])


def _section(command: str, found: Any) -> str:
    rows = [[code(path), " or ".join(sorted(types)), plain(meaning(path))] for path, types in fields_of(found).items()]
    return f"### {command}\n\n" + table(["field", "type", "meaning"], rows)


def fields_of(found: Any) -> dict[str, set[str]]:
    """Return the types of all fields of a JSON object, by path; shared objects are not opened.

    Examples
    --------
    >>> fields_of({"models": [{"name": "a", "errors": {"p": 1}}]})
    {'models[].name': {'text'}, 'models[].errors': {'errors of a fit'}}

    """
    out: dict[str, set[str]] = {}
    for path, kind in _walk(found, ""):
        out.setdefault(path, set()).add(kind)
    return {path: kinds - {"empty"} or {"object"} for path, kinds in out.items()}


def _walk(value: Any, path: str) -> Iterator[tuple[str, str]]:
    name = path.rpartition(".")[2]
    if isinstance(value, dict) and name in SHARED:
        yield path, SHARED[name][0].lower()
    elif isinstance(value, dict):
        yield from _walk_object(value, path)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for one in value:
            yield from _walk(one, f"{path}[]")
    else:
        yield path, "list" if isinstance(value, list) else TYPES[type(value).__name__]


def _walk_object(value: dict[str, Any], path: str) -> Iterator[tuple[str, str]]:
    if not value and path:
        yield path, "empty"
    for key, one in value.items():
        name = "<name>" if path.rpartition(".")[2] in BY_NAME else key
        yield from _walk(one, f"{path}.{name}" if path else name)
