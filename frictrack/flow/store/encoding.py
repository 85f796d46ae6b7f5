"""Encode records and dictionaries as HDF5 groups that h5py, HDFView or MATLAB read without frictrack.

A record becomes a group. Its columns are datasets with the attributes `unit` and, for viewers, `units`; its numbers and
strings are attributes; its tuples and lists are attributes in JSON; None is an empty attribute; a dictionary is a
subgroup. Every group that a stage wrote has the attributes of its `Provenance`, and marks for viewers.

The marks follow the NeXus standard, so that a viewer (silx, h5web, NeXpy) draws the right curve at a double click: a
group with one row per frame is an NXdata whose `signal` names the column that is drawn and `axes` that of the time, and
`default` leads from the root to the curve that tells most. Nothing of them is read back.

Files of earlier schemas are read as they are: they had checksums in their groups, or texts of any length.

References
----------
NeXus manual, classes NXdata and NXroot, https://manual.nexusformat.org.

"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np

from frictrack.base import __version__
from frictrack.results import to_builtins

NX_CLASS = "NX_class"
ATTRIBUTES = frozenset({NX_CLASS, "default", "signal", "axes", "auxiliary_signals"})  # of a group that is marked
UNITS = "units"  # of a dataset
AXIS = "t"
# Of a run, the first one that is there is drawn. Not the friction force: outside of the free section, as during a push,
# it is no friction, and so large that nothing else is seen.
STAGES = ("displacement", "track")


def mark_data(group: h5py.Group, kind: Any) -> None:
    """Mark a group that holds a record with one row per frame as NXdata."""
    signals = [name for name in getattr(kind, "signals", ()) if isinstance(group.get(name), h5py.Dataset)]
    if AXIS not in group or not signals:
        return
    group.attrs.update({NX_CLASS: "NXdata", "signal": signals[0], "axes": _names(AXIS)})
    others = [name for name in signals[1:] if group[name].attrs[UNITS] == group[signals[0]].attrs[UNITS]]
    if others:  # they are drawn in one plot
        group.attrs["auxiliary_signals"] = _names(*others)


def mark_default(file: h5py.File) -> None:
    """Let `default` lead from the root of a file to a curve: the displacement of a run, or that of the current model.

    No link is followed: it might lead into another file.
    """
    file.attrs[NX_CLASS] = "NXroot"
    file.attrs.pop("default", None)
    inside: h5py.Group = file
    for name, kind in _path_to_curve(file):
        inside.attrs["default"] = name
        inside = inside[name]
        inside.attrs[NX_CLASS] = kind


def without_marks(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of a group without those of NeXus."""
    is_marked = NX_CLASS in attributes
    return {name: value for name, value in attributes.items() if not (is_marked and name in ATTRIBUTES)}


def _path_to_curve(file: h5py.File) -> list[tuple[str, str]]:
    """Return the names of the groups that lead to the curve, each with its class; empty if there is no curve."""
    own = _subgroups(file)
    stage = next((name for name in STAGES if name in own and _is_data(own[name])), None)
    if stage is not None:
        return [(stage, "NXdata")]
    models = _subgroups(own.get("models"))
    model = next((name for name in reversed(models) if _is_current(models[name])), "")
    curves = _subgroups(_subgroups(models.get(model)).get("curves"))
    curve = next((name for name, group in curves.items() if _is_data(group)), "")
    kinds = ("NXentry", "NXsubentry", "NXcollection", "NXdata")
    return list(zip(("models", model, "curves", curve), kinds, strict=True)) if curve else []


def _subgroups(group: h5py.Group | None) -> dict[str, h5py.Group]:
    """Return the groups inside a group by name, without links."""
    inside = () if group is None else members(group)
    return {name: item for name, item in inside if isinstance(item, h5py.Group)}


def _is_current(model: h5py.Group) -> bool:
    current = model.attrs.get("current")
    return isinstance(current, np.bool_) and bool(current)


def _is_data(group: h5py.Group) -> bool:
    return str(group.attrs.get(NX_CLASS)) == "NXdata"


def _names(*names: str) -> Any:
    """Return names as NeXus lists them: an array of texts; their length is fixed, so that they lie in the attribute."""
    return np.array([name.encode() for name in names], dtype=h5py.string_dtype("utf-8", max(map(len, names))))


_MAX_ATTRIBUTE_CHARACTERS = 16_000  # characters; HDF5 keeps an attribute below 64 kB
_MAX_COMPRESSION = 1100  # times that deflate can shrink an array (1032 at most, with overhead)
_ALWAYS_ALLOWED_BYTES = 1 << 20  # any array may be this large
FORMER_CHECKSUM = "sha256"  # attribute of groups and datasets in schema 2
_MAX_COMPACT_ATTRIBUTES = 64  # attributes of a group that stay in its header, which is smaller and read in one piece


@dataclass(frozen=True)
class Provenance:
    """What a group was made from. It is current as long as the same `key` would be made today."""

    key: str = ""  # hash of the stage's name, the version, the settings and the inputs
    input_hash: str = ""  # hash of the inputs together
    inputs: str = "[]"  # JSON: [name, key or hash]; ":/track" (this file), "v3.h5:/track" (another file), or a path
    settings: str = "{}"  # JSON: keys of the study file, their values
    version: str = __version__  # of frictrack


@dataclass(frozen=True, eq=False)
class GroupContent:
    """The content of one group: a record, or a dictionary of arrays, numbers, strings and records."""

    content: Any
    provenance: Provenance = Provenance()


PROVENANCE_KEYS = {f.name for f in fields(Provenance)}


def new_group(parent: h5py.Group, name: str) -> h5py.Group:
    """Create a group inside another one, and the groups between them."""
    *between, last = name.split("/")
    for part in between:
        parent = parent[part] if part in parent else new_group(parent, part)
    creation = h5py.h5p.create(h5py.h5p.GROUP_CREATE)
    creation.set_obj_track_times(False)  # else the same content makes other bytes a second later
    creation.set_attr_phase_change(_MAX_COMPACT_ATTRIBUTES, _MAX_COMPACT_ATTRIBUTES // 2)
    return h5py.Group(h5py.h5g.create(parent.id, last.encode(), gcpl=creation))


def members(group: h5py.Group) -> Iterator[tuple[str, h5py.Group | h5py.Dataset]]:
    """Yield name and object of what a group itself holds; links to other places are not followed."""
    for name in group:
        if isinstance(group.get(name, getlink=True), h5py.HardLink):
            yield name, group[name]


def write_group(group: h5py.Group, content: Any, attributes: Mapping[str, Any] = MappingProxyType({})) -> None:
    """Write a record or a dictionary into an empty group."""
    group.attrs.update(attributes)
    if is_dataclass(content):
        triples = [(f.name, getattr(content, f.name), f.metadata.get("unit")) for f in fields(content)]
    else:
        triples = [(name, value, None) for name, value in content.items()]
    for name, value, unit in triples:
        _write_value(group, name, value, unit)
    mark_data(group, type(content))


def _write_value(group: h5py.Group, name: str, value: Any, unit: str | None) -> None:
    """Write one value: a subgroup, an array or an attribute."""
    if isinstance(value, dict) or is_dataclass(value):
        write_group(new_group(group, name), value)
    elif isinstance(value, np.ndarray):
        _write_array(group, name, value, {"unit": unit or ""} | ({UNITS: unit} if unit else {}))
    elif isinstance(value, str) and len(value) > _MAX_ATTRIBUTE_CHARACTERS:
        _write_array(group, name, np.array(value), {})
    elif value is None:
        group.attrs[name] = h5py.Empty("f8")
    else:
        group.attrs[name] = json.dumps(to_builtins(value)) if isinstance(value, tuple | list) else value
        if unit and isinstance(value, float):
            group.attrs[f"{name}_unit"] = unit


def _write_array(group: h5py.Group, name: str, value: np.ndarray[Any, Any], attributes: Mapping[str, str]) -> None:
    """Write an array of numbers or strings as a compressed dataset, and its attributes.

    Strings get one fixed length, because HDF5 compresses only those.
    """
    if value.dtype.kind in "UO":
        coded = np.char.encode(value.astype(np.str_), "utf-8")
        value = coded.astype(h5py.string_dtype("utf-8", max(coded.dtype.itemsize, 1)))
    is_plain = value.ndim == 0 or value.size == 0
    compressed = {} if is_plain else {"compression": "gzip", "shuffle": True, "fletcher32": True}
    group.create_dataset(name, data=value, **compressed).attrs.update(attributes)


def read_array(dataset: Any) -> Any:
    """Read the array of a dataset: numbers, an array of strings, or one string.

    The file may come from anybody: what the dataset declares is checked before memory is allocated.
    """
    if not isinstance(dataset, h5py.Dataset) or dataset.external or dataset.is_virtual:
        raise ValueError("expected an array in this very file")
    is_text = h5py.check_string_dtype(dataset.dtype) is not None
    if not is_text and dataset.dtype.kind not in "biuf":
        raise ValueError(f"expected numbers or strings but got {dataset.dtype}")
    most = _MAX_COMPRESSION * dataset.id.get_storage_size() + _ALWAYS_ALLOWED_BYTES
    if dataset.nbytes > most:
        raise ValueError(f"expected at most {most} bytes but {dataset.name} claims {dataset.nbytes}")
    found = dataset.asstr()[()] if is_text else dataset[()]
    return np.asarray(found, dtype=np.str_) if is_text and not isinstance(found, str) else found


def read_dict(group: h5py.Group, *, without: Collection[str] = ()) -> dict[str, Any]:
    """Read everything in a group as a dictionary, without the provenance."""
    own = {k: v for k, v in group.attrs.items() if k not in PROVENANCE_KEYS and k != FORMER_CHECKSUM}
    content = {k: _listed(to_python(v)) for k, v in without_marks(own).items()}
    for name, item in members(group):
        if name not in without:
            content[name] = read_dict(item) if isinstance(item, h5py.Group) else read_array(item)
    return content


def read_record(group: h5py.Group, kind: Any) -> Any:
    """Read a group as the record type `kind`."""
    values = {}
    inside = dict(members(group))
    for f in fields(kind):
        if f.name in inside:
            item = inside[f.name]
            values[f.name] = read_dict(item) if isinstance(item, h5py.Group) else read_array(item)
        elif f.name in group.attrs:
            raw = to_python(group.attrs[f.name])
            is_tuple = raw is not None and str(f.type).startswith("tuple")
            values[f.name] = _tuple(json.loads(raw)) if is_tuple else raw
    return kind(**values)


def to_python(value: Any) -> Any:
    """Convert an attribute to a Python object."""
    if isinstance(value, h5py.Empty):
        return None
    return value.item() if isinstance(value, np.generic) else value


def _listed(value: Any) -> Any:
    """Decode a text that is a JSON list; return anything else as it is."""
    if isinstance(value, str) and value.startswith("["):
        with suppress(json.JSONDecodeError):
            return json.loads(value)
    return value


def _tuple(value: Any) -> Any:
    return tuple(_tuple(v) for v in value) if isinstance(value, list) else value
