"""Change one key or table in the text of a study file; comments, order and spaces are kept."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from frictrack.base.errors import FrictrackError
from frictrack.study.writing import run_tables, toml_item, with_blank_line

ARRAY_TABLES = {"run": "name", "effect": "effect"}  # tables that occur several times -> key that identifies one


def with_key(text: str, table: str, key: str, value: Any, which: str | None = None) -> str:
    """Set or remove one key.

    Parameters
    ----------
    text
        Text of the study file.
    table
        ``"study"``, ``"camera"``, ``"run"`` or ``"effect"``.
    key, value
        The key and its value; None removes the key.
    which
        Name of the run or effect. An effect that does not exist is added.

    Returns
    -------
    str
        The new text.

    Raises
    ------
    FrictrackError
        (usage) If the text is not TOML, or there is no such run.

    Examples
    --------
    >>> lines = ["[study]  # steel on brass", "mass = 0.35"]
    >>> print(with_key(chr(10).join(lines), "study", "mass", 0.7))
    [study]  # steel on brass
    mass = 0.7

    """
    document = _parse(text)
    home = _find_table(document, table, which)
    if value is None:
        home.pop(key, None)
    else:
        home[key] = toml_item(value)
    return tomlkit.dumps(document)


def with_runs(text: str, folder: Path, recordings: list[Path]) -> str:
    """Add a ``[[run]]`` for each recording.

    Parameters
    ----------
    text
        Text of the study file.
    folder
        Folder of the study file, to which paths are relative.
    recordings
        The recordings.

    """
    document = _parse(text)
    runs = document.setdefault("run", tomlkit.aot())
    for run in run_tables(recordings, folder, [_name_of(run, "run") for run in runs]):
        runs.append(with_blank_line(tomlkit.item(run)))
    return tomlkit.dumps(document)


def with_effect(text: str, effect: Mapping[str, Any]) -> str:
    """Add an ``[[effect]]``; it replaces one of the same name.

    Parameters
    ----------
    text
        Text of the study file.
    effect
        Keys of the table, with "effect" for its name.

    """
    document = _parse(text)
    home = _find_table(document, "effect", effect["effect"])
    for key in [key for key in home if key not in effect]:
        del home[key]
    home.update({key: toml_item(value) for key, value in effect.items()})
    return tomlkit.dumps(document)


def without_run(text: str, name: str) -> str:
    """Remove the ``[[run]]`` of a name.

    Raises
    ------
    FrictrackError
        (usage) If there is no such run.

    """
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
    """Return the table that holds a key."""
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
    """Return the name of a table; a run without a name has that of its recording."""
    name = table.get(ARRAY_TABLES[kind])
    return str(name) if name else Path(str(table.get("video") or table.get("table") or "")).stem
