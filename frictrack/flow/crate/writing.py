"""Write a study with all its results as one research object: an RO-Crate, as a zip file or as a folder."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from frictrack.base.errors import FrictrackError
from frictrack.base.files import atomic_write
from frictrack.flow import Session
from frictrack.flow.crate.metadata import (
    METADATA,
    Authorship,
    Described,
    describe_crate,
    platform_versions,
    read_authorship,
    table_files,
)
from frictrack.flow.crate.payload import Part, Payload, list_payload

SUFFIX = ".crate.zip"
TABLES = "tables"  # folder among the results
COPY_BYTES = 1 << 20  # that are copied at once


@dataclass(frozen=True)
class CrateOptions:
    """What a user asks of a crate.

    Attributes
    ----------
    include_recordings
        Include films of any size.
    authors
        Names, each perhaps with an ORCID.
    licence
        Identifier of SPDX, or an address.

    """

    include_recordings: bool = False
    authors: Sequence[str] = ()
    licence: str | None = None


def write_crate(session: Session, path: Path | None = None, options: CrateOptions | None = None) -> dict[str, Any]:
    """Bring a study up to date and write its crate.

    Parameters
    ----------
    session
        The study.
    path
        The file, which ends in ``.zip``, or a new folder; None for ``<study>.crate.zip`` in the folder of the results.
    options
        What goes in; None for the defaults.

    Returns
    -------
    dict
        JSON of `frictrack export --to crate`.

    Raises
    ------
    FrictrackError
        If the study cannot be computed, a file cannot be read or written, or an author or licence is none.

    """
    options = options or CrateOptions()
    authorship = read_authorship(options.authors, options.licence)
    study = session.study
    target = study.output / f"{study.path.stem}{SUFFIX}" if path is None else path
    _check_target(target)
    session.report(anew=False)
    results = session.results()
    payload = list_payload(session, include_recordings=options.include_recordings)
    with tempfile.TemporaryDirectory() as scratch:
        payload = _with_tables(payload, table_files(results), Path(scratch))
        metadata = describe_crate(
            Described(results, payload, authorship, platform_versions(), _started(session), _ended(session))
        )
        session.progress(0, 0, f"writing {target.name}")
        with _opened(target) as crate:
            for part in payload.parts:
                if part.is_included:
                    crate.add(part)
            crate.add_text(METADATA, json.dumps(metadata, indent=1, ensure_ascii=False, allow_nan=False))
    return _summary(target, payload, authorship)


def _summary(target: Path, payload: Payload, authorship: Authorship) -> dict[str, Any]:
    included = [part for part in payload.parts if part.is_included]
    return {
        "crate": str(target),
        "files": len(included) + 1,
        "bytes": target.stat().st_size if target.is_file() else sum(part.size for part in included),
        "included": [part.place for part in included],
        "by_hash": [{"file": one.place, "bytes": one.size, "sha256": one.sha256} for one in payload.by_hash],
        "not_given": list(authorship.not_given),
        "output": str(target.parent),
    }


def _check_target(target: Path) -> None:
    """Raise FrictrackError (usage) if a folder exists that would be overwritten, before any work."""
    if target.suffix != ".zip" and target.exists():
        raise FrictrackError(
            f"expected the name of a new folder, or of a file that ends in .zip, but {target} exists; "
            "choose another name",
            usage=True,
        )
    if target.is_dir():
        raise FrictrackError(
            f"expected the name of a zip file but {target} is a folder; choose another name", usage=True
        )


def _with_tables(payload: Payload, tables: dict[str, bytes], scratch: Path) -> Payload:
    """Add tables that are made for the crate; they are written into a temporary folder."""
    parts = []
    for name, content in tables.items():
        (scratch / name).write_bytes(content)
        parts.append(Part.read(scratch / name, f"{payload.results}/{TABLES}/{name}", "result"))
    return replace(payload, parts=(*payload.parts, *parts))


def _started(session: Session) -> str | None:
    """Return when the study was changed first."""
    return next((change.time for change in session.commands.changes), None)


def _ended(session: Session) -> str:
    """Return when the models were written last."""
    return datetime.fromtimestamp(session.path.stat().st_mtime, UTC).isoformat(timespec="seconds")


class _Target(Protocol):
    """Where the files of a crate are written."""

    def add(self, part: Part) -> None:
        """Copy a file to its place."""

    def add_text(self, place: str, text: str) -> None:
        """Write a text."""


class _Zip:
    def __init__(self, file: zipfile.ZipFile) -> None:
        self._file = file

    def add(self, part: Part) -> None:
        info = zipfile.ZipInfo.from_file(part.source, part.place, strict_timestamps=False)
        info.compress_type = zipfile.ZIP_STORED if part.is_film else zipfile.ZIP_DEFLATED
        with part.source.open("rb") as source, self._file.open(info, "w", force_zip64=True) as copy:
            shutil.copyfileobj(source, copy, COPY_BYTES)

    def add_text(self, place: str, text: str) -> None:
        self._file.writestr(place, text, zipfile.ZIP_DEFLATED)


class _Folder:
    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def add(self, part: Part) -> None:
        path = self._folder / part.place
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(part.source, path)

    def add_text(self, place: str, text: str) -> None:
        (self._folder / place).write_text(text, encoding="utf-8")


@contextmanager
def _opened(target: Path) -> Iterator[_Target]:
    """Open a crate for writing; it gets its name when it is complete."""
    if target.suffix == ".zip":
        with atomic_write(target) as part, zipfile.ZipFile(part, "w") as file:
            yield _Zip(file)
        return
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{target.name}_", dir=target.parent) as scratch:
            folder = Path(scratch) / target.name
            folder.mkdir()
            yield _Folder(folder)
            os.replace(folder, target)
    except OSError as e:
        raise FrictrackError(f"cannot write {target}: {e.strerror or e}") from e
