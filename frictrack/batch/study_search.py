"""Find the study files that a user names by files, folders or globs."""

from __future__ import annotations

import glob
import re
from collections.abc import Sequence
from pathlib import Path

from frictrack.errors import FrictrackError


def find_studies(patterns: Sequence[str]) -> list[Path]:
    """Find study files, each once, with numbers in names in numerical order (``run_9`` before ``run_10``).

    Parameters
    ----------
    patterns
        Study files, folders (searched with their subfolders) and globs.

    Raises
    ------
    FrictrackError
        (usage) If a pattern matches no study file.

    """
    found: dict[Path, None] = {}
    for pattern in patterns:
        matches = glob.glob(pattern, recursive=True) or [pattern]
        studies = [study for match in matches for study in _studies(Path(match))]
        if not studies:
            raise FrictrackError(f"expected study files in {pattern} but found none", usage=True)
        found |= dict.fromkeys(sorted(studies, key=_natural))
    return list(found)


def _studies(path: Path) -> list[Path]:
    if path.is_dir():
        return list(path.rglob("study.toml"))
    return [path] if path.exists() else []


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a sorting key by which numbers in a path count as numbers."""
    parts = re.split(r"(\d+)", path.as_posix())
    return [(int(part), "") if part.isdecimal() else (0, part) for part in parts]
