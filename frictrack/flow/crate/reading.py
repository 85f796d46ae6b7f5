"""Read the description of a crate: its study file, inputs, results, and the versions that computed them."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import tomlkit
from tomlkit.exceptions import TOMLKitError

from frictrack.base.errors import FrictrackError
from frictrack.base.remote import is_address, local_path, locate
from frictrack.flow import Progress, hash_path
from frictrack.flow.crate.metadata import FRICTRACK, MACHINE, METADATA, MOVED
from frictrack.flow.crate.payload import safe_place

MAX_METADATA_BYTES = 200_000_000  # of ro-crate-metadata.json
ABSENT = "ni:"  # how the address of a file begins that the crate does not contain


@dataclass(frozen=True)
class CrateFile:
    """A file that a crate describes.

    Attributes
    ----------
    place
        Its path in the crate.
    size, sha256
        Its bytes, and their SHA-256.
    is_included
        Whether the crate contains it.

    """

    place: str
    size: int
    sha256: str
    is_included: bool


@dataclass(frozen=True)
class Crate:
    """The description of a crate.

    Attributes
    ----------
    folder
        The unpacked crate.
    study
        The study file.
    inputs, results
        What the study was computed from, and what was computed.
    moved
        Place in the crate by the path in the study file, of what lies elsewhere.
    versions
        Versions of software and machine that computed the results.

    """

    folder: Path
    study: CrateFile
    inputs: tuple[CrateFile, ...]
    results: tuple[CrateFile, ...]
    moved: dict[str, str]
    versions: dict[str, str]

    def path(self, file: CrateFile) -> Path:
        """Return the path of a file in the crate, which need not exist.

        Raises
        ------
        FrictrackError
            If a link there leads out of the crate.

        """
        return _inside(self.folder, file.place)


def read_crate(folder: Path) -> Crate:
    """Read the description of an unpacked crate.

    Parameters
    ----------
    folder
        The crate.

    Raises
    ------
    FrictrackError
        If the folder is no crate, another program wrote it, or it describes files outside the folder.

    """
    path = _inside(folder, METADATA)
    try:
        if path.stat().st_size > MAX_METADATA_BYTES:
            raise FrictrackError(f"expected at most {MAX_METADATA_BYTES / 1e6:.0f} MB of metadata in {path}")
        raw = json.loads(path.read_text(encoding="utf-8"))
    except FrictrackError:
        raise
    except FileNotFoundError as e:
        raise FrictrackError(f"expected an RO-Crate but {folder} has no {METADATA}", usage=True) from e
    except (OSError, ValueError, RecursionError) as e:
        raise FrictrackError(f"{path} cannot be read: {e}; fetch the crate again") from e
    try:
        return _crate(folder, {one["@id"]: one for one in raw["@graph"]})
    except FrictrackError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, StopIteration) as e:
        raise FrictrackError(
            f"expected a crate of `frictrack export --to crate` but {path} describes something else ({e!r})"
        ) from e


def has_same_bytes(path: Path, described: CrateFile) -> bool:
    """Return whether a file exists and has the bytes that a crate describes.

    Parameters
    ----------
    path
        The file.
    described
        Its description.

    Raises
    ------
    FrictrackError
        If it cannot be read.

    """
    try:
        return path.is_file() and path.stat().st_size == described.size and hash_path(path) == described.sha256
    except OSError as e:
        raise FrictrackError(f"cannot read {path}: {e.strerror or e}") from e


def _inside(folder: Path, place: str) -> Path:
    path = folder / place
    try:
        if path.resolve().is_relative_to(folder.resolve()):
            return path
    except (OSError, RuntimeError):  # links in a circle
        pass
    raise FrictrackError(f"expected {place} inside {folder} but it is a link out of it; do not trust this crate")


def _crate(folder: Path, entities: Mapping[str, Any]) -> Crate:
    root = entities["./"]
    action = entities[_ids(root["mentions"])[0]]
    study = root["mainEntity"]["@id"]
    objects = [entities[name] for name in _ids(action["object"])]
    files = [one for one in objects if one["@type"] == "File" and one["@id"] != study]
    moved = {one["name"]: safe_place(one["value"]) for one in objects if one.get("propertyID") == MOVED}
    return Crate(
        folder,
        _file(entities[study]),
        tuple(_file(one) for one in files),
        tuple(_file(entities[name]) for name in _ids(action["result"])),
        moved,
        _versions(entities, entities[action["instrument"]["@id"]]),
    )


def _file(entity: Mapping[str, Any]) -> CrateFile:
    is_included = not entity["@id"].startswith(ABSENT)
    place = unquote(entity["@id"]) if is_included else entity["localPath"]
    return CrateFile(safe_place(place), int(entity["contentSize"]), str(entity["sha256"]), is_included)


def _versions(entities: Mapping[str, Any], software: Mapping[str, Any]) -> dict[str, str]:
    required = [entities[name] for name in _ids(software["softwareRequirements"])]
    found = {one["name"]: str(one["softwareVersion"]) for one in (software, *required)}
    if software["name"] != FRICTRACK:
        raise ValueError(software["name"])
    machine = (software["operatingSystem"], software["processorRequirements"])
    return found | dict(zip(MACHINE, map(str, machine), strict=True))


def _ids(values: Any) -> list[str]:
    """Return the addresses of one reference or several."""
    references: Iterable[Any] = values if isinstance(values, list) else [values]
    return [one["@id"] for one in references]


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
