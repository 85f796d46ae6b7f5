"""Read the description of a crate: its study file, inputs, results, and the versions that computed them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from frictrack.crate.metadata import METADATA, MOVED
from frictrack.crate.platform_versions import FRICTRACK, MACHINE
from frictrack.crate.unpacking import safe_place
from frictrack.errors import FrictrackError
from frictrack.flow import hash_path

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
