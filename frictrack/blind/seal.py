"""Seal the truth of all studies in one encoded file with checksums, and open it again."""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from dataclasses import asdict
from pathlib import Path

from frictrack.blind.truth import Truth, read_truth
from frictrack.errors import FrictrackError

SEAL_FILE = "seal.json"
SEALED_SUFFIXES = (".csv", ".toml", ".avi")


def seal(folder: Path, truths: dict[str, Truth]) -> None:
    """Write the truth of all studies, encoded so that nobody reads it by accident, with a checksum of each file.

    Parameters
    ----------
    folder
        Folder with one sub-folder per study.
    truths
        Truth by name of the study.

    """
    text = json.dumps({name: asdict(t) for name, t in truths.items()})
    packed = base64.b64encode(zlib.compress(text.encode(), 9)).decode()
    body = {"studies": len(truths), "sealed": packed, "files": file_hashes(folder)}
    (folder / SEAL_FILE).write_text(json.dumps(body, indent=1), encoding="utf-8")


def open_seal(folder: Path) -> dict[str, Truth]:
    """Read the sealed truth and verify the checksums.

    Parameters
    ----------
    folder
        Folder written by `seal`.

    Returns
    -------
    dict
        Truth by name of the study.

    Raises
    ------
    FrictrackError
        If there is no sealed truth (usage), or if a file changed.

    """
    path = folder / SEAL_FILE
    if not path.is_file():
        raise FrictrackError(
            f"expected the folder of `frictrack blind make` but found no {SEAL_FILE} in {folder}", usage=True
        )
    body = json.loads(path.read_text(encoding="utf-8"))
    now = file_hashes(folder)
    changed = [name for name, digest in body["files"].items() if now.get(name) != digest]
    if changed:
        raise FrictrackError(
            f"expected the studies as they were made but {', '.join(changed[:3])} changed since; "
            "make them again in another folder"
        )
    raw = json.loads(zlib.decompress(base64.b64decode(body["sealed"])))
    return {name: read_truth(entry) for name, entry in raw.items()}


def file_hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of each table, film and study file, by path within the folder."""
    files = sorted(p for p in folder.glob("*/*") if p.suffix in SEALED_SUFFIXES)
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
