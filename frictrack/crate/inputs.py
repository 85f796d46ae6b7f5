"""Set up a copy of a crate's study without its results: its inputs are linked, and their bytes are checked."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from frictrack.crate.reading import Crate, has_same_bytes
from frictrack.errors import FrictrackError
from frictrack.flow import Progress
from frictrack.remote import is_address, local_path, locate

MAX_LISTED = 5  # files that a message names


def set_up_study(crate: Crate, folder: Path, inputs: Mapping[str, Path]) -> Path:
    """Make a copy of the study in an empty folder; return its study file.

    Parameters
    ----------
    crate
        The crate.
    folder
        The new folder.
    inputs
        The files by their places in it, from `find_inputs`.

    Raises
    ------
    FrictrackError
        If it cannot be written.

    """
    study = folder / crate.study.place
    try:
        study.parent.mkdir(parents=True, exist_ok=True)
        for place, source in inputs.items():
            _link(source, folder / place)
        text = crate.path(crate.study).read_bytes()
        study.write_bytes(_with_places(text, crate.moved) if crate.moved else text)
    except OSError as e:
        raise FrictrackError(f"cannot copy the study into {folder}: {e.strerror or e}") from e
    return study


def find_inputs(crate: Crate, recordings: Path | None, progress: Progress | None) -> dict[str, Path]:
    """Return the inputs on this machine by their places; every one has the bytes that the crate says.

    Parameters
    ----------
    crate
        The crate.
    recordings
        Folder with the recordings that the crate does not contain; it is searched with all folders inside.
    progress
        Shows the addresses from which missing recordings are then fetched; None: they are not fetched.

    Raises
    ------
    FrictrackError
        If an input is missing or has other bytes than when the results were computed.

    """
    found: dict[str, Path] = {}
    missing: list[str] = []
    changed: list[str] = []
    candidates = _files_by_name(recordings)
    remote = {text: place for text, place in crate.moved.items() if is_address(text) and not text.startswith("file:")}
    addresses = {PurePosixPath(place).with_suffix(""): text for text, place in remote.items()}
    for one in (crate.study, *crate.inputs):
        name = PurePosixPath(one.place)
        known = [crate.path(one)] if one.is_included else candidates.get(name.name, [])
        if progress is not None and not known and (address := addresses.get(name.with_suffix(""))):
            progress(0, 0, f"fetching {address}")
            known = [local_path(locate(address)).with_name(name.name)]
        there = [path for path in known if path.is_file()]
        same = next((path for path in there if has_same_bytes(path, one)), None)
        if same is not None:
            found[one.place] = same.absolute()
        elif one.is_included or not there:
            (changed if there else missing).append(one.place)
        else:
            changed.append(f"{one.place} (found as {there[0]})")
    faults = []
    if missing:
        where = "in the crate" if recordings is None else f"in {recordings}"
        faults.append(f"{_listed(missing)} {'is' if len(missing) == 1 else 'are'} not {where}")
    if changed:
        faults.append(f"{_listed(changed)} {'has' if len(changed) == 1 else 'have'} other bytes than the crate says")
    if faults:
        advice = "give --recordings FOLDER with the original recordings"
        if addresses and progress is None:
            advice += f", or --allow-addresses to fetch {_listed([*addresses.values()])}"
        raise FrictrackError(f"expected the inputs of the study but {' and '.join(faults)}; {advice}")
    found.pop(crate.study.place)
    return found


def _files_by_name(folder: Path | None) -> dict[str, list[Path]]:
    if folder is None:
        return {}
    if not folder.is_dir():
        raise FrictrackError(f"expected a folder of recordings but got {folder}", usage=True)
    found: dict[str, list[Path]] = {}
    for path in sorted(folder.rglob("*")):
        found.setdefault(path.name, []).append(path)
    return found


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else ""
    return ", ".join(names[:MAX_LISTED]) + more


def _link(source: Path, target: Path) -> None:
    """Link a file to its place in the copy of the study; it is copied where the system has no links."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.symlink(source, target)
    except OSError:
        shutil.copy2(source, target)


def _with_places(text: bytes, moved: Mapping[str, str]) -> bytes:
    """Replace paths in a study file by those in the crate; comments are kept."""
    try:
        document = tomlkit.parse(text.decode())
    except (TOMLKitError, UnicodeDecodeError) as e:
        raise FrictrackError(f"the study file of the crate is not valid TOML: {e}") from e
    for container, key, value in list(_strings(document)):
        if value in moved:
            container[key] = moved[value]
    return tomlkit.dumps(document).encode()


def _strings(value: Any) -> Iterator[tuple[Any, Any, str]]:
    """Yield container, key and value of every text in tables and lists."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in list(items):
        if isinstance(part, str):
            yield value, key, str(part)
        else:
            yield from _strings(part)
