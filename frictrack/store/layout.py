"""Records and plain dictionaries as HDF5 groups, readable by h5py, HDFView or MATLAB without us.

A record is a group; its columns are datasets with the attribute `unit`, its numbers and strings are attributes, its
tuples and lists are attributes in JSON, None is an empty attribute, a dictionary is a subgroup. Every group that a
stage wrote carries the attributes of its `Stamp`.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import h5py
import numpy as np

from frictrack.results import plain
from frictrack.store.claims import array_of, members, once
from frictrack.store.sums import SUM
from frictrack.version import __version__

_LONG = 16_000  # characters; HDF5 keeps an attribute below 64 kB
_MANY = 64  # attributes of a group that stay in its header, which is smaller and read in one piece


@dataclass(frozen=True)
class Stamp:
    """Where a group comes from: it is current as long as the same `key` would be made today."""

    key: str = ""  # hash of the stage's name, the version, the settings and the inputs
    input_hash: str = ""  # hash of the inputs together
    inputs: str = "[]"  # JSON: [name, key or hash] of each; ":/track" here, "v3.h5:/track" beside, or a file
    settings: str = "{}"  # JSON: keys of the study file, their values
    version: str = __version__  # of frictrack


@dataclass(frozen=True, eq=False)
class Entry:
    """What goes into one group: a record, or a dictionary of arrays, numbers, strings, records."""

    content: Any
    stamp: Stamp = Stamp()


STAMPED = {f.name for f in fields(Stamp)}


def new_group(parent: h5py.Group, name: str) -> h5py.Group:
    """A group inside another one, groups between them made as well."""
    *between, last = name.split("/")
    for part in between:
        parent = parent[part] if part in parent else new_group(parent, part)
    creation = h5py.h5p.create(h5py.h5p.GROUP_CREATE)
    creation.set_attr_phase_change(_MANY, _MANY // 2)
    return h5py.Group(h5py.h5g.create(parent.id, last.encode(), gcpl=creation))


def put(group: h5py.Group, content: Any) -> None:
    """Write a record or a dictionary into an empty group."""
    if is_dataclass(content):
        for f in fields(content):
            _put_value(group, f.name, getattr(content, f.name), f.metadata.get("unit"))
    else:
        for name, value in content.items():
            _put_value(group, name, value, None)


def _put_value(group: h5py.Group, name: str, value: Any, unit: str | None) -> None:
    if value is None:
        group.attrs[name] = h5py.Empty("f8")
    elif isinstance(value, dict) or is_dataclass(value):
        put(new_group(group, name), value)
    elif isinstance(value, np.ndarray):
        put_array(group, name, value).attrs["unit"] = unit or ""
    elif isinstance(value, str) and len(value) > _LONG:
        put_array(group, name, np.array(value))
    else:
        group.attrs[name] = json.dumps(plain(value)) if isinstance(value, tuple | list) else value
        if unit and isinstance(value, float):
            group.attrs[f"{name}_unit"] = unit


def put_array(group: h5py.Group, name: str, value: np.ndarray[Any, Any]) -> h5py.Dataset:
    """Write an array of numbers or strings; strings all of one length, as HDF5 compresses and checks only those."""
    if value.dtype.kind in "UO":
        coded = np.char.encode(value.astype(np.str_), "utf-8")
        value = coded.astype(h5py.string_dtype("utf-8", max(coded.dtype.itemsize, 1)))
    if value.ndim == 0 or value.size == 0:
        return group.create_dataset(name, data=value)
    return group.create_dataset(name, data=value, compression="gzip", shuffle=True, fletcher32=True)


def take(group: h5py.Group, met: set[int] | None = None) -> dict[str, Any]:
    """Everything in a group as a dictionary, without the stamp; `met` are the groups above and beside it.

    Raises ValueError for what frictrack never writes.
    """
    met = set() if met is None else met
    once(group, met)
    content = {k: _listed(number(v)) for k, v in group.attrs.items() if k not in STAMPED and k != SUM}
    for name, item in members(group):
        content[name] = take(item, met) if isinstance(item, h5py.Group) else array_of(item)
    return content


def record(group: h5py.Group, kind: Any) -> Any:
    """A group as the record type `kind`."""
    values = {}
    inside = dict(members(group))
    for f in fields(kind):
        if f.name in inside:
            item = inside[f.name]
            values[f.name] = take(item) if isinstance(item, h5py.Group) else array_of(item)
        elif f.name in group.attrs:
            raw = number(group.attrs[f.name])
            is_tuple = raw is not None and str(f.type).startswith("tuple")
            values[f.name] = _tuple(json.loads(raw)) if is_tuple else raw
    return kind(**values)


def number(value: Any) -> Any:
    """An attribute as Python has it."""
    if isinstance(value, h5py.Empty):
        return None
    return value.item() if isinstance(value, np.generic) else value


def _listed(value: Any) -> Any:
    """A list again, where the text is one in JSON."""
    if isinstance(value, str) and value.startswith("["):
        with suppress(json.JSONDecodeError):
            return json.loads(value)
    return value


def _tuple(value: Any) -> Any:
    return tuple(_tuple(v) for v in value) if isinstance(value, list) else value
