"""Read a crate, find its recordings, compute its results again and compare every number."""

from __future__ import annotations

import json
import os
import re
import shutil
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
import tomlkit
from tomlkit.exceptions import TOMLKitError

from frictrack import flow
from frictrack.base.errors import FrictrackError, UsageError, os_errors_as
from frictrack.base.number_format import first_words
from frictrack.base.remote import is_address, local_path, locate, only_listed
from frictrack.flow.crate import payload
from frictrack.flow.pipeline import hash_path
from frictrack.flow.verification import EXCLUDED, Values, stored_values
from frictrack.flow.workflows import recorded_models, repeat_models
from frictrack.results import to_builtins

MAX_METADATA_BYTES = 200_000_000  # of ro-crate-metadata.json
ABSENT = "ni:"  # how the address of a file begins that the crate does not contain


@dataclass(frozen=True)
class Crate:
    """The description of a crate."""

    study: payload.Part  # the study file
    inputs: tuple[payload.Part, ...]  # inputs, results: what the study was computed from, and what was computed
    results: tuple[payload.Part, ...]
    moved: dict[str, str]  # place in the crate by the path in the study file, of what lies elsewhere
    versions: dict[str, str]  # versions of software and machine that computed the results


def read_crate(folder: Path) -> Crate:
    """Read the description of an unpacked crate."""
    path = _inside(folder, payload.METADATA)
    try:
        if path.stat().st_size > MAX_METADATA_BYTES:
            raise FrictrackError(f"expected at most {MAX_METADATA_BYTES / 1e6:.0f} MB of metadata in {path}")
        return _crate(folder, {one["@id"]: one for one in json.loads(path.read_text(encoding="utf-8"))["@graph"]})
    except FrictrackError:
        raise
    except FileNotFoundError as e:
        raise UsageError(f"expected an RO-Crate but {folder} has no {payload.METADATA}") from e
    except (OSError, json.JSONDecodeError, UnicodeDecodeError, RecursionError) as e:
        raise FrictrackError(f"{path} cannot be read: {e}; fetch the crate again") from e
    except (KeyError, TypeError, ValueError, AttributeError, StopIteration) as e:
        raise FrictrackError(
            f"expected a crate of `frictrack export --to crate` but {path} describes something else ({e!r})"
        ) from e


def has_same_bytes(path: Path, described: payload.Part) -> bool:
    """Return whether a file exists and has the bytes that a crate describes."""
    with os_errors_as(f"cannot read {path}"):
        return path.is_file() and path.stat().st_size == described.size and hash_path(path) == described.sha256


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
    inputs = tuple(_file(folder, one, "input") for one in objects if one["@type"] == "File" and one["@id"] != study)
    results = tuple(_file(folder, entities[name], "result") for name in _ids(action["result"]))
    moved = {one["name"]: payload.safe_place(one["value"]) for one in objects if one.get("propertyID") == payload.MOVED}
    versions = _versions(entities, entities[action["instrument"]["@id"]])
    return Crate(_file(folder, entities[study], "study"), inputs, results, moved, versions)


def _file(folder: Path, entity: Mapping[str, Any], role: str) -> payload.Part:
    is_included = not entity["@id"].startswith(ABSENT)
    place = payload.safe_place(unquote(entity["@id"]) if is_included else entity["localPath"])
    size, sha256 = int(entity["contentSize"]), str(entity["sha256"])
    return payload.Part(_inside(folder, place), place, role, size, sha256, is_included=is_included)


def _versions(entities: Mapping[str, Any], software: Mapping[str, Any]) -> dict[str, str]:
    required = [entities[name] for name in _ids(software["softwareRequirements"])]
    found = {one["name"]: str(one["softwareVersion"]) for one in (software, *required)}
    if software["name"] != payload.FRICTRACK:
        raise ValueError(software["name"])
    machine = (software["operatingSystem"], software["processorRequirements"])
    return found | dict(zip(payload.MACHINE, map(str, machine), strict=True))


def _ids(values: Any) -> list[str]:
    """Return the addresses of one reference or several."""
    references: Iterable[Any] = values if isinstance(values, list) else [values]
    return [one["@id"] for one in references]


def set_up_study(crate: Crate, folder: Path, inputs: Mapping[str, Path]) -> Path:
    """Make a copy of the study in an empty folder; return its study file."""
    study = folder / crate.study.place
    with os_errors_as(f"cannot copy the study into {folder}"):
        study.parent.mkdir(parents=True, exist_ok=True)
        for place, source in inputs.items():
            _link(source, folder / place)
        text = crate.study.source.read_bytes()
        study.write_bytes(_with_places(text, crate.moved) if crate.moved else text)
    return study


def find_inputs(crate: Crate, recordings: Path | None, progress: flow.Progress | None) -> dict[str, Path]:
    """Return the inputs on this machine by their places; every one has the bytes that the crate says."""
    found: dict[str, Path] = {}
    faults: list[str] = []
    candidates = _files_by_name(recordings)
    remote = {text: place for text, place in crate.moved.items() if is_address(text) and not text.startswith("file:")}
    addresses = {PurePosixPath(place).with_suffix(""): text for text, place in remote.items()}
    for one in (crate.study, *crate.inputs):
        name = PurePosixPath(one.place)
        known = [one.source] if one.is_included else candidates.get(name.name, [])
        if progress is not None and not known and (address := addresses.get(name.with_suffix(""))):
            progress(0, 0, f"fetching {address}")
            known = [local_path(locate(address)).with_name(name.name)]
        there = [path for path in known if path.is_file()]
        same = next((path for path in there if has_same_bytes(path, one)), None)
        if same is not None:
            found[one.place] = same.absolute()
        elif there:
            where = "" if one.is_included else f" (found as {there[0]})"
            faults.append(f"{one.place}{where} has other bytes than the crate says")
        else:
            faults.append(f"{one.place} is not in {'the crate' if recordings is None else recordings}")
    if faults:
        advice = "give --recordings FOLDER with the original recordings"
        if addresses and progress is None:
            advice += f", or --allow-addresses to fetch {first_words([*addresses.values()])}"
        raise FrictrackError(f"expected the inputs of the study but {first_words(faults)}; {advice}")
    found.pop(crate.study.place)
    return found


def _files_by_name(folder: Path | None) -> dict[str, list[Path]]:
    if folder is None:
        return {}
    if not folder.is_dir():
        raise UsageError(f"expected a folder of recordings but got {folder}")
    found: dict[str, list[Path]] = {}
    for path in sorted(folder.rglob("*")):
        found.setdefault(path.name, []).append(path)
    return found


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
    for container, key, value in list(payload.texts_in(document)):
        if value in moved:
            container[key] = moved[value]
    return tomlkit.dumps(document).encode()


RELATIVE_TOLERANCE = 1e-9  # of numbers that were computed on another platform


APPROXIMATE = (  # names of numbers of which fewer digits are the same on another platform, how many, and why
    (
        re.compile(r"diagnosis\.(summary\..*limits?\b.*|summary\..*limit_over_friction|figures\..*\.(limit|rise))"),
        1e-2,
        "detection limits come from matrices that are nearly singular; two digits of them are used",
    ),
    (
        re.compile(r"(.*\.)?(sigma|std)(_\w+)?"),
        1e-5,
        "a standard deviation is the root of a difference of nearly equal numbers; two digits are used (GUM 7.2.6)",
    ),
    (re.compile(r"diagnosis\.figures\..*"), 1e-5, "curves of the misfit are differences of nearly equal numbers"),
)  # the first whose pattern is the whole name
CONCLUSIONS = re.compile(
    r"summary\.(model|equation|parameters|errors)\b.*|diagnosis\.summary\.(model|verdict|missing)\b.*|equation"
)  # names of the values that a paper states
MAX_DIFFERENCES = 20  # of one group, that are listed
MAX_TEXT = 200  # characters of a text in a difference


def compare_files(
    stored: Mapping[str, Mapping[str, Values]], computed: Mapping[str, Mapping[str, Values]], *, exact: bool
) -> list[dict[str, Any]]:
    """Compare all groups of all files; return the JSON of each, of which "same_conclusions" is no part of the output.

    Examples
    --------
    >>> stored = {"a.h5": {"track": {"x": [1.0, 2.0]}}}
    >>> computed = {"a.h5": {"track": {"x": [1.0, 2.0 + 1e-10]}}}
    >>> [one["n_differences"] for exact in (True, False) for one in compare_files(stored, computed, exact=exact)]
    [1, 0]

    """
    places = [(file, group) for files in (stored, computed) for file, groups in files.items() for group in groups]
    return [
        _compare_group((file, group), stored.get(file, {}).get(group), computed.get(file, {}).get(group), exact=exact)
        for file, group in dict.fromkeys(places)
    ]


def tolerance_of(name: str) -> float:
    """Return the relative difference that is allowed of a value on another platform.

    Examples
    --------
    >>> tolerance_of("summary.parameters.coulomb.F_c.value"), tolerance_of("summary.parameters.coulomb.F_c.std")
    (1e-09, 1e-05)

    """
    found = (tolerance for pattern, tolerance, _ in APPROXIMATE if pattern.fullmatch(name))
    return next(found, RELATIVE_TOLERANCE)


def _compare_group(place: tuple[str, str], old: Values | None, new: Values | None, *, exact: bool) -> dict[str, Any]:
    where = dict(zip(("file", "group"), place, strict=True))
    numbers, largest, differences = 0, 0.0, list[dict[str, Any]]()
    if old is None or new is None:
        stored, computed = ("missing" if values is None else "there" for values in (old, new))
        differences.append({**where, "value": "", "stored": stored, "computed": computed, "relative": None})
        old = new = {}
    for name in dict.fromkeys([*old, *new]):
        tolerance = 0.0 if exact else tolerance_of(name)
        count, relative, different = _compare_values(old.get(name, ()), new.get(name, ()), tolerance)
        numbers, largest = numbers + count, max(largest, relative)
        if different is not None:
            both = dict(zip(("stored", "computed"), different, strict=True))
            # relative to the largest magnitude of that value; None for a text
            differences.append({**where, "value": name, **both, "relative": relative if count else None})
    found = {
        **where,
        "numbers": numbers,
        "largest_difference": largest,
        "equal": not differences,
        "n_differences": len(differences),
        "differences": differences[:MAX_DIFFERENCES],
        "same_conclusions": not any(not one["value"] or CONCLUSIONS.fullmatch(one["value"]) for one in differences),
    }
    return dict(to_builtins(found))


def _compare_values(
    old: Sequence[Any], new: Sequence[Any], tolerance: float
) -> tuple[int, float, tuple[Any, Any] | None]:
    """Return how many numbers were compared, their largest relative difference, and the values that differ."""
    a, b = _flat(old), _flat(new)
    if a.dtype.kind != "f" or b.dtype.kind != "f" or a.shape != b.shape:
        texts = list(map(str, a)), list(map(str, b))
        return 0, 0.0, None if texts[0] == texts[1] else (_shown(texts[0]), _shown(texts[1]))
    if not len(a):
        return 0, 0.0, None
    with np.errstate(invalid="ignore", over="ignore"):
        apart = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.abs(a - b))
    apart = np.where(np.isnan(apart), np.inf, apart)  # a number in one copy only, or another infinity
    largest = np.max(np.abs(a), initial=0.0, where=np.isfinite(a))
    worst = int(np.argmax(apart))
    relative = float(apart[worst] / largest) if largest else float(np.inf if apart[worst] else 0.0)
    return len(a), relative, (a[worst], b[worst]) if relative > tolerance else None


def _flat(values: Sequence[Any]) -> np.ndarray:
    """Return values in one row: numbers, where an unknown one is NaN; texts if any of them is none."""
    rows = [np.ravel(np.nan if value is None else value) for value in values]
    if any(row.dtype.kind not in "biuf" for row in rows):
        return np.array([str(part) for row in rows for part in row])
    return np.concatenate([np.empty(0), *rows])


def _shown(texts: Sequence[str]) -> str:
    text = ", ".join(texts)
    return text if len(text) <= MAX_TEXT else f"{text[:MAX_TEXT]}..."


STUDY_FILE = "study.h5"
UNPACKED, AGAIN = "crate", "study"  # folders in that of the output


def reproduce_crate(
    path: Path,
    out: Path,
    recordings: Path | None = None,
    progress: flow.Progress = flow.no_progress,
    *,
    allow_addresses: bool = False,
) -> dict[str, Any]:
    """Compute the results of a crate again in a new folder, with its settings and seeds, and compare every number.

    Parameters
    ----------
    path
        The crate: a zip file or a folder.
    out
        The new folder: ``crate`` is the unpacked crate, ``study`` the study that was computed again.
    recordings
        Folder with the recordings that the crate does not contain.
    progress
        Called as ``progress(done, total, what)``.
    allow_addresses
        Fetch recordings that are neither in the crate nor in `recordings` from where the author had them. `progress`
        shows every address before it is opened.

    Returns
    -------
    dict
        JSON of `frictrack reproduce CRATE`: "equal", "numbers", "groups", "versions", ...

    Raises
    ------
    FrictrackError
        If the crate cannot be read, an input is missing or has other bytes, the study file names a file that the crate
        does not list, or the study cannot be computed.

    """
    if not path.exists():
        raise UsageError(f"expected a crate but there is no {path}; check the path")
    if out.exists():
        raise UsageError(f"expected the name of a new folder but {out} exists; choose another one with -o")
    began = time.monotonic()
    try:
        crate = _unpacked(path, out, progress)
        progress(0, 0, "checking the inputs")
        known = find_inputs(crate, recordings, progress if allow_addresses else None)
        with only_listed(known):
            study = flow.open_study(set_up_study(crate, _made(out / AGAIN), known))
    except FrictrackError:
        shutil.rmtree(out, ignore_errors=True)  # so that the command can be given again
        raise
    versions = compare_versions(crate.versions, payload.platform_versions())
    for one in versions:
        progress(0, 0, f"{one['name']}: {one['stored']} in the crate, {one['computed']} here")
    stored = _stored_files(crate)
    with only_listed(known):
        repeat_models(flow.Session(study, progress, author="reproduce"), recorded_models(stored[STUDY_FILE]))
    progress(0, 0, "comparing")
    computed = {file.name: stored_values(file) for file in sorted(study.output.glob("[!.]*.h5"))}
    known_values = {name: stored_values(file) for name, file in stored.items()}
    groups = compare_files(known_values, computed, exact=not versions)
    return _summary(crate, versions, groups) | {
        "crate": str(path),
        "seconds": round(time.monotonic() - began, 1),
        "output": str(study.output),
    }


def _unpacked(path: Path, out: Path, progress: flow.Progress) -> Crate:
    folder = path
    if not path.is_dir():
        progress(0, 0, f"unpacking {path.name}")
        folder = out / UNPACKED
        payload.unpack(path, _made(folder))
    return read_crate(folder)


def compare_versions(stored: Mapping[str, str], present: Mapping[str, str]) -> list[dict[str, str]]:
    """Return the versions that differ between the crate and this machine.

    Examples
    --------
    >>> compare_versions({"numpy": "2.1.0", "scipy": "1.15"}, {"numpy": "2.2.0", "scipy": "1.15"})
    [{'name': 'numpy', 'stored': '2.1.0', 'computed': '2.2.0'}]

    """
    names = dict.fromkeys([*stored, *present])
    pairs = {name: (stored.get(name, "unknown"), present.get(name, "unknown")) for name in names}
    return [{"name": name, "stored": old, "computed": new} for name, (old, new) in pairs.items() if old != new]


def _summary(crate: Crate, versions: list[dict[str, str]], rows: list[dict[str, Any]]) -> dict[str, Any]:
    same = [row.pop("same_conclusions") for row in rows]
    largest = [row["largest_difference"] for row in rows if row["numbers"]]  # None is infinite
    return {
        "equal": all(row["equal"] for row in rows),
        "same_conclusions": all(same),
        "version": crate.versions[payload.FRICTRACK],
        "same_platform": not versions,
        "versions": versions,
        "tolerance": RELATIVE_TOLERANCE if versions else 0.0,
        "numbers": sum(row["numbers"] for row in rows),
        "largest_difference": None if None in largest else max(largest, default=0.0),
        "groups": rows,
        "altered": [one.place for one in crate.results if not has_same_bytes(one.source, one)],
        "excluded": [{"names": list(names), "reason": reason} for names, reason in EXCLUDED.items()],
        "approximate": [
            {"names": pattern.pattern, "tolerance": tolerance, "reason": reason}
            for pattern, tolerance, reason in APPROXIMATE
        ],
    }


def _stored_files(crate: Crate) -> dict[str, Path]:
    """Return the HDF5 files of the crate by name."""
    found = {PurePosixPath(one.place).name: one.source for one in crate.results if one.place.endswith(".h5")}
    if STUDY_FILE not in found:
        raise FrictrackError(f"expected {STUDY_FILE} among the results of the crate but it lists none; export it again")
    return found


def _made(folder: Path) -> Path:
    with os_errors_as(f"cannot create {folder}"):
        folder.mkdir(parents=True)
    return folder
