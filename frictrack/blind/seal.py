"""The seal: truths of all studies in one file that nobody reads by accident, and that tells when data were changed."""

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
    """Close the truths of the studies in `folder`, by their names, with a hash of every file that was handed out."""
    text = json.dumps({name: asdict(t) for name, t in truths.items()})
    packed = base64.b64encode(zlib.compress(text.encode(), 9)).decode()
    body = {"studies": len(truths), "sealed": packed, "files": file_hashes(folder)}
    (folder / SEAL_FILE).write_text(json.dumps(body, indent=1), encoding="utf-8")


def open_seal(folder: Path) -> dict[str, Truth]:
    """Open the seal: truths by the names of their studies.

    Raises FrictrackError where there is none, or where a file was changed since it was closed.
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
    """SHA-256 of every table, film and study file, by its path within the folder."""
    files = sorted(p for p in folder.glob("*/*") if p.suffix in SEALED_SUFFIXES)
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
