"""Compute the results of a crate again and compare every number."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from frictrack.crate.comparison import APPROXIMATE, RELATIVE_TOLERANCE, GroupComparison, compare_files
from frictrack.crate.inputs import find_inputs, set_up_study
from frictrack.crate.platform_versions import FRICTRACK, platform_versions
from frictrack.crate.reading import Crate, has_same_bytes, read_crate
from frictrack.crate.unpacking import unpack
from frictrack.errors import FrictrackError
from frictrack.flow import (
    EXCLUDED,
    Progress,
    Session,
    no_progress,
    open_study,
    recorded_models,
    repeat_models,
    stored_values,
)
from frictrack.remote import only_listed

STUDY_FILE = "study.h5"
UNPACKED, AGAIN = "crate", "study"  # folders in that of the output


def reproduce_crate(
    path: Path,
    out: Path,
    recordings: Path | None = None,
    progress: Progress = no_progress,
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
    _check_paths(path, out)
    began = time.monotonic()
    try:
        crate = _unpacked(path, out, progress)
        progress(0, 0, "checking the inputs")
        known = find_inputs(crate, recordings, progress if allow_addresses else None)
        with only_listed(known):
            study = open_study(set_up_study(crate, _made(out / AGAIN), known))
    except FrictrackError:
        shutil.rmtree(out, ignore_errors=True)  # so that the command can be given again
        raise
    versions = compare_versions(crate.versions, platform_versions())
    for one in versions:
        progress(0, 0, f"{one['name']}: {one['stored']} in the crate, {one['computed']} here")
    stored = _stored_files(crate)
    with only_listed(known):
        repeat_models(Session(study, progress, author="reproduce"), recorded_models(stored[STUDY_FILE]))
    progress(0, 0, "comparing")
    computed = {file.name: stored_values(file) for file in sorted(study.output.glob("[!.]*.h5"))}
    groups = compare_files({name: stored_values(file) for name, file in stored.items()}, computed, exact=not versions)
    return _summary(crate, versions, groups) | {
        "crate": str(path),
        "seconds": round(time.monotonic() - began, 1),
        "output": str(study.output),
    }


def _unpacked(path: Path, out: Path, progress: Progress) -> Crate:
    folder = path
    if not path.is_dir():
        progress(0, 0, f"unpacking {path.name}")
        folder = out / UNPACKED
        unpack(path, _made(folder))
    return read_crate(folder)


def compare_versions(stored: Mapping[str, str], present: Mapping[str, str]) -> list[dict[str, str]]:
    """Return the versions that differ between the crate and this machine.

    Parameters
    ----------
    stored, present
        Versions by name; see `platform_versions`.

    Examples
    --------
    >>> compare_versions({"numpy": "2.1.0", "scipy": "1.15"}, {"numpy": "2.2.0", "scipy": "1.15"})
    [{'name': 'numpy', 'stored': '2.1.0', 'computed': '2.2.0'}]

    """
    names = dict.fromkeys([*stored, *present])
    pairs = {name: (stored.get(name, "unknown"), present.get(name, "unknown")) for name in names}
    return [{"name": name, "stored": old, "computed": new} for name, (old, new) in pairs.items() if old != new]


def _summary(crate: Crate, versions: list[dict[str, str]], groups: list[GroupComparison]) -> dict[str, Any]:
    rows = [group.to_dict() for group in groups]
    return {
        "equal": all(row["equal"] for row in rows),
        "same_conclusions": all(group.same_conclusions for group in groups),
        "version": crate.versions[FRICTRACK],
        "same_platform": not versions,
        "versions": versions,
        "tolerance": RELATIVE_TOLERANCE if versions else 0.0,
        "numbers": sum(row["numbers"] for row in rows),
        "largest_difference": max((row["largest_difference"] for row in rows if row["numbers"]), default=0.0),
        "groups": rows,
        "altered": [one.place for one in crate.results if not has_same_bytes(crate.path(one), one)],
        "excluded": [{"names": list(one.names), "reason": one.reason} for one in EXCLUDED],
        "approximate": [
            {"names": one.pattern.pattern, "tolerance": one.tolerance, "reason": one.reason} for one in APPROXIMATE
        ],
    }


def _stored_files(crate: Crate) -> dict[str, Path]:
    """Return the HDF5 files of the crate by name."""
    found = {PurePosixPath(one.place).name: crate.path(one) for one in crate.results if one.place.endswith(".h5")}
    if STUDY_FILE not in found:
        raise FrictrackError(f"expected {STUDY_FILE} among the results of the crate but it lists none; export it again")
    return found


def _check_paths(path: Path, out: Path) -> None:
    """Raise FrictrackError (usage) if there is no crate, or if something would be overwritten."""
    if not path.exists():
        raise FrictrackError(f"expected a crate but there is no {path}; check the path", usage=True)
    if out.exists():
        raise FrictrackError(
            f"expected the name of a new folder but {out} exists; choose another one with -o", usage=True
        )


def _made(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True)
    except OSError as e:
        raise FrictrackError(f"cannot create {folder}: {e.strerror or e}") from e
    return folder
