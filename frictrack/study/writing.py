"""Write a study file from recordings, with comments for a new user; change one key or table in the text of one."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from frictrack.base.errors import FrictrackError, UsageError, result_or_none
from frictrack.base.files import replace_text
from frictrack.study.column_names import REQUIRED, guess_columns, is_named_speed
from frictrack.study.loading import ARRAY_TABLES, name_of_table
from frictrack.study.schema import COLUMNS
from frictrack.study.track_formats import FOLDER, FORMATS, PICKLES, find_track_format

# those of which every file is a record; others are opened to see whether they are
SURE_TABLES = (".csv", ".xlsx", ".xls", ".tsv", *(end for one in FORMATS if one.certain for end in one.suffixes))
OTHERS = (end for one in FORMATS for end in one.suffixes if end not in (FOLDER, *PICKLES))
TABLES = tuple(dict.fromkeys((*SURE_TABLES, ".txt", ".log", ".dat", ".xml", *OTHERS)))
FILMS = (".avi", ".mp4", ".mov", ".mkv", ".m4v", ".tif", ".tiff", ".mraw", ".cine")  # .cih(x) only head an .mraw
PICTURES = (".png", ".tif", ".tiff", ".jpg", ".bmp")


@dataclass(frozen=True)
class NewRun:
    """The entry of a run in a new study file."""

    recording: Path  # the film or table
    keys: Mapping[str, Any] = field(default_factory=dict)  # known keys of the ``[[run]]``, such as fps and columns
    comment: str = ""  # what the user is to fill in


def find_recordings(folder: Path) -> list[Path]:
    """List the films, tables and folders of pictures in a folder, by name.

    Raises
    ------
    FrictrackError
        (usage) If there is no such folder; otherwise if it has no recordings.

    """
    if not folder.is_dir():
        raise UsageError(f"expected a folder with recordings but got {folder}")
    found = [p for p in folder.iterdir() if _is_recording(p)]
    if not found:
        known = ", ".join((*FILMS, *TABLES))
        raise FrictrackError(f"expected recordings in {folder} but found none (looked for {known}, picture folders)")
    return sorted(found)


def list_files(folder: Path) -> list[Path]:
    """List what could be a recording in a folder, by name: films, tables, texts and folders of pictures.

    Parameters
    ----------
    folder
        The folder.

    """
    visible = (p for p in folder.iterdir() if not p.name.startswith("."))
    return sorted(p for p in visible if _is_recording(p) or (p.is_file() and is_table(p)))


def is_picture_folder(path: Path) -> bool:
    """Return whether a folder holds several pictures, which are the frames of a film; results of a study are none."""
    pictures = [p for p in path.iterdir() if p.suffix.lower() in PICTURES]
    return len(pictures) > 1 and not path.name.endswith("_results")


def is_table(path: Path) -> bool:
    """Return whether a path is that of a table, by its name, or a folder of tracks that another program wrote."""
    if not path.is_dir():
        return path.suffix.lower() in TABLES
    return not is_picture_folder(path) and find_track_format(path) is not None


def write_study(
    path: Path,
    recordings: Sequence[Path | NewRun],
    keys: Mapping[str, Any] | None = None,
    *,
    commented: bool = False,
    remarks: Mapping[str, str] | None = None,
) -> Path:
    """Write the study file of some recordings.

    Parameters
    ----------
    path
        Path of the new file.
    recordings
        The recordings, or the entries of their runs.
    keys
        Known keys of ``[study]`` and ``[camera]``: mass, model, fps, scale.
    commented
        Write the other keys as comments, with an explanation of each.
    remarks
        Words before the explanation of a key.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    FrictrackError
        (usage) If the file exists.

    """
    refuse_existing(path)
    runs = [one if isinstance(one, NewRun) else NewRun(one) for one in recordings]
    known = {"name": path.resolve().parent.name} | {k: v for k, v in (keys or {}).items() if v is not None}
    head = _template("first_keys").replace("<file>", path.name)
    if runs and all(is_table(one.recording) for one in runs) and not {"fps", "scale"} & {*known, *(remarks or {})}:
        head = head[: head.index("[camera]")].rstrip() + "\n"
    for key, value in known.items():
        line = f"{key} = {tomlkit.item(value).as_string()}".replace("\\", "\\\\")  # for `re.sub`
        head = re.sub(rf"^# {key} = .*", line, head, count=1, flags=re.MULTILINE)
    head = re.sub(r"<(\w+)>", lambda found: (remarks or {}).get(found[1], ""), head)
    tables = tomlkit.aot()
    for new, run in zip(runs, run_tables([new.recording for new in runs], path.parent), strict=True):
        tables.append(table := with_blank_line(tomlkit.item(run)))
        for key, value in new.keys.items():
            table[key] = toml_item(value)
        for line in new.comment.splitlines():
            table.add(tomlkit.comment(line))
    if not commented:
        head = re.sub(r"^#.*\n", "", head, flags=re.MULTILINE).lstrip()
    document = tomlkit.dumps({"run": tables}) if runs else ""
    return replace_text(path, head + document + (_template("optional_keys") if commented else ""))


def _template(name: str) -> str:
    """Return a part of a commented study file."""
    return files("frictrack").joinpath("study", f"{name}.toml").read_text(encoding="utf-8")


def refuse_existing(path: Path) -> None:
    """Raise `FrictrackError` (usage) if there is a study file already."""
    if path.exists():
        use = f"`frictrack run {shlex.quote(str(path))}` uses it"
        raise UsageError(f"{path} is already there; {use}, or move it away")


def toml_item(value: Any) -> Any:
    """Convert a value for a study file; a dictionary becomes an inline table, also inside a list."""
    if isinstance(value, list | tuple) and any(isinstance(part, Mapping) for part in value):
        listed = tomlkit.array()
        listed.extend(toml_item(part) for part in value)
        return listed
    if not isinstance(value, Mapping):
        return tomlkit.item(value)
    inline = tomlkit.inline_table()
    inline.update({key: toml_item(part) for key, part in value.items()})
    return inline


def _is_recording(path: Path) -> bool:
    if path.is_dir():
        return is_picture_folder(path) or is_table(path)
    if path.name.startswith(".") or path.suffix.lower() not in (*FILMS, *TABLES):
        return False
    if path.suffix.lower() in (".tif", ".tiff"):
        return _many_pages(path)
    return path.suffix.lower() in (*FILMS, *SURE_TABLES) or _holds_times_and_positions(path)


def _holds_times_and_positions(path: Path) -> bool:
    """Return whether the headers of a file name times and positions, or it holds tracks of another program."""
    from frictrack.study.table_files import open_table  # noqa: PLC0415 - only for such files

    table = result_or_none(open_table, path)
    if table is None:
        return False
    headers = list(map(str, table.frame.columns))
    known = table.columns.keys() | guess_columns(headers) | {key for key in REQUIRED if COLUMNS[key][0] in headers}
    known |= {"x"} if any(map(is_named_speed, headers)) else set()
    return bool(table.tracks) or known >= set(REQUIRED)


def _many_pages(path: Path) -> bool:
    """Return whether a TIFF has several pages: one page is a picture, for example of a board."""
    import tifffile  # noqa: PLC0415 - a study of tables does without

    try:
        with tifffile.TiffFile(path) as file:
            return len(file.pages) > 1 or bool((file.imagej_metadata or {}).get("images", 1) > 1)
    except (OSError, ValueError, tifffile.TiffFileError):
        return True  # the fault is reported when the file is opened


def run_tables(recordings: Sequence[Path], folder: Path, taken: Sequence[str] = ()) -> list[dict[str, str]]:
    """Return a ``[[run]]`` for every recording, with its path relative to the study's folder."""
    stems = [p.stem.casefold() for p in dict.fromkeys(recordings)] + [name.casefold() for name in taken]
    tables = []
    for i, p in enumerate(recordings):
        name = p.stem if stems.count(p.stem.casefold()) == 1 else p.name
        number = f"_{recordings[: i + 1].count(p)}" if recordings.count(p) > 1 else ""
        path = Path(os.path.relpath(p, folder)).as_posix()
        tables.append({"name": f"{name}{number}", "table" if is_table(p) else "video": path})
    return tables


def with_blank_line(table: Any) -> Any:
    """Return a table with an empty line before it."""
    table.trivia.indent = "\n"
    return table


def with_key(text: str, table: str, key: str, value: Any, which: str | None = None) -> str:
    """Set or remove one key.

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
    for run in run_tables(recordings, folder, [name_of_table(run, "run") for run in runs]):
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
        raise UsageError(f"the study file is not valid TOML: {e}") from e


def _find_table(document: tomlkit.TOMLDocument, table: str, which: str | None) -> Any:
    """Return the table that holds a key."""
    if table not in ARRAY_TABLES:
        return document.setdefault(table, tomlkit.table())
    tables = document.setdefault(table, tomlkit.aot())
    for one in tables:
        if name_of_table(one, table) == which:
            return one
    if table == "run":
        known = ", ".join(f'"{name_of_table(one, table)}"' for one in tables) or "none"
        raise UsageError(f'expected a run of the study file but got "{which}"; it has {known}')
    tables.append(with_blank_line(tomlkit.item({ARRAY_TABLES[table]: which})))
    return tables[-1]
