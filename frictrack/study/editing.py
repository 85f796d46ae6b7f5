"""A study file's text with one key changed: comments, order and spaces stay as they are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from frictrack.errors import FrictrackError
from frictrack.study.writing import run_tables, with_blank_line

ARRAY_TABLES = {"run": "name", "effect": "effect"}  # tables that occur several times -> key that identifies one


def with_key(text: str, table: str, key: str, value: Any, which: str | None = None) -> str:
    """The text with `key` of ``[table]``, or of that ``[[table]]`` which is called so, set; None takes it away.

    An ``[[effect]]`` that is not there yet is made. Raises `FrictrackError` where the text is no TOML, or holds no
    such run.
    """
    document = _parse(text)
    home = _find_table(document, table, which)
    if value is None:
        home.pop(key, None)
    else:
        home[key] = _toml_item(value)
    return tomlkit.dumps(document)


def read_key(text: str, table: str, key: str, which: str | None = None) -> Any:
    """What stands under `key` of ``[table]``, or of that ``[[table]]`` which is called so; None where nothing does.

    Raises `FrictrackError` as `edited` does.
    """
    found = _find_table(_parse(text), table, which).get(key)
    return found.unwrap() if hasattr(found, "unwrap") else found


def with_runs(text: str, folder: Path, recordings: list[Path]) -> str:
    """The text with a ``[[run]]`` more for each recording; paths relative to the `folder` of the study file."""
    document = _parse(text)
    runs = document.setdefault("run", tomlkit.aot())
    for run in run_tables(recordings, folder, [_name_of(run, "run") for run in runs]):
        runs.append(with_blank_line(tomlkit.item(run)))
    return tomlkit.dumps(document)


def with_effect(text: str, effect: Mapping[str, Any]) -> str:
    """The text with an ``[[effect]]`` more, in the place of one of that name."""
    document = _parse(text)
    home = _find_table(document, "effect", effect["effect"])
    for key in [key for key in home if key not in effect]:
        del home[key]
    home.update({key: _toml_item(value) for key, value in effect.items()})
    return tomlkit.dumps(document)


def without_run(text: str, name: str) -> str:
    """The text without the ``[[run]]`` of that name; its recording and its results stay where they are."""
    document = _parse(text)
    home = _find_table(document, "run", name)
    document["run"].remove(home)
    return tomlkit.dumps(document)


def _parse(text: str) -> tomlkit.TOMLDocument:
    try:
        return tomlkit.parse(text)
    except TOMLKitError as e:
        raise FrictrackError(f"the study file is not valid TOML: {e}", usage=True) from e


def _find_table(document: tomlkit.TOMLDocument, table: str, which: str | None) -> Any:
    """The table that holds the key."""
    if table not in ARRAY_TABLES:
        return document.setdefault(table, tomlkit.table())
    tables = document.setdefault(table, tomlkit.aot())
    for one in tables:
        if _name_of(one, table) == which:
            return one
    if table == "run":
        known = ", ".join(f'"{_name_of(one, table)}"' for one in tables) or "none"
        raise FrictrackError(f'expected a run of the study file but got "{which}"; it has {known}', usage=True)
    tables.append(with_blank_line(tomlkit.item({ARRAY_TABLES[table]: which})))
    return tables[-1]


def _name_of(table: Mapping[str, Any], kind: str) -> str:
    """The name of a table; that of a run is its recording's where it has none."""
    name = table.get(ARRAY_TABLES[kind])
    return str(name) if name else Path(str(table.get("video") or table.get("table") or "")).stem


def _toml_item(value: Any) -> Any:
    """A dictionary stands in one line, as the other keys do."""
    if not isinstance(value, Mapping):
        return tomlkit.item(value)
    made = tomlkit.inline_table()
    made.update({key: _toml_item(part) for key, part in value.items()})
    return made
