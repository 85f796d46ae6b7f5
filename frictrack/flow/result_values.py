"""Read every value of the results of a study, group by group, so that two copies of the results can be compared.

JSON texts are read as what they hold. Values that have the same name inside a list are one array, whose largest
magnitude is the scale of their differences.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from frictrack import store

LINKS = ("runs", "diagnosis")  # in study.h5: the files of the runs, and the diagnosis of the current model
PARTS = ("models",)  # groups of which every member is a group of its own here


@dataclass(frozen=True)
class Excluded:
    """A value that may differ although the results are the same, and why."""

    names: tuple[str, ...]
    reason: str


EXCLUDED = (
    Excluded(("key", "input_hash", "inputs", "settings", "version"), "hashes of provenance include paths and versions"),
    Excluded(("sha256",), "a checksum covers the provenance too"),
    Excluded(("path",), "a recording may lie in another folder"),
    Excluded(("hash",), "recordings are compared before; one that was read in parts has the hash of its store"),
)  # attributes of groups, by name
_NAMES_EXCLUDED = {name for one in EXCLUDED for name in one.names}

Values = dict[str, list[Any]]
"""Values by name: numbers, texts, bool, None, and arrays; in lists, in order."""


def stored_values(path: Path) -> dict[str, Values]:
    """Read every value of a file of results.

    Parameters
    ----------
    path
        The file, ``study.h5`` or that of a run.

    Returns
    -------
    dict
        By name of the group, the values by name: ``["models/1_tustin"]["summary.errors.rms_displacement_um"]``.

    Raises
    ------
    FrictrackError
        If the file is missing or damaged.

    """
    with store.snapshot(path):  # whatever is wrong in it becomes one sentence
        names = [name for name in store.names(path) if name not in LINKS]
        inner = {name: store.names(path, name) for name in names if name in PARTS}
        groups = [name for name in names if name not in inner]
        groups += [f"{name}/{member}" for name, members in inner.items() for member in members]
        own = {name: store.attributes(path, name) for name in inner}
        read = own | {group: store.read(path, group) for group in groups}
        return {group: _values(content) for group, content in read.items()}


def _values(content: Mapping[str, Any]) -> Values:
    found: Values = {}
    for name, value in content.items():
        if name not in _NAMES_EXCLUDED:
            for where, leaf in _leaves(name, value):
                found.setdefault(where, []).append(leaf)
    return found


def _leaves(where: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield name and value of everything inside a value; texts of JSON are read."""
    value = _decoded(value)
    if isinstance(value, dict):
        for name, part in value.items():
            yield from _leaves(f"{where}.{name}", part)
    elif isinstance(value, list):
        yield f"{where}.length", len(value)
        for part in value:
            yield from _leaves(f"{where}[]", part)
    else:
        yield where, value


def _decoded(value: Any) -> Any:
    """Return what a text of JSON holds; anything else as it is."""
    if isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind in "UOS":
        value = str(value)
    if isinstance(value, str) and value[:1] in ("{", "["):
        try:
            return json.loads(value)
        except (ValueError, RecursionError):
            return value
    return value
