"""The only door to HDF5: records and plain dictionaries in, the same out, a file replaced whole or not at all.

Layout, readable by h5py, HDFView or MATLAB without us: a record is a group; its columns are datasets with the
attribute `unit`, its numbers and strings are attributes, its tuples and lists are attributes in JSON, None is an
empty attribute, a dictionary is a subgroup. Every group that a stage wrote carries the attributes of its `Stamp`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, is_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from frictrack.claims import array_of, once
from frictrack.errors import FrictrackError
from frictrack.files import alone, replaced
from frictrack.results import plain

VERSION = version("frictrack")
REMEDY = "delete it and run again, the recordings are untouched"
NOTHING: Mapping[str, Any] = {}
SCHEMA = 1  # of the layout; a file with a higher number was written by a later frictrack
_STRING = h5py.string_dtype()
_LONG = 16_000  # characters; HDF5 keeps an attribute below 64 kB


@dataclass(frozen=True)
class Stamp:
    """Where a group comes from: it is current as long as the same `key` would be made today."""

    key: str = ""
    input_hash: str = ""
    settings: str = "{}"  # JSON
    version: str = VERSION


@dataclass(frozen=True, eq=False)
class Entry:
    """What goes into one group: a record, or a dictionary of arrays, numbers, strings, records."""

    content: Any
    stamp: Stamp = Stamp()


def write(
    path: Path,
    groups: Mapping[str, Entry],
    *,
    remove: tuple[str, ...] = (),
    links: Mapping[str, str] = NOTHING,
    marks: Mapping[str, Mapping[str, Any]] = NOTHING,
) -> None:
    """Put groups into the file at `path`, keeping all others, and replace the file in one step.

    `groups` maps a group's name (``"track"``, ``"models/1_tustin"``) to what it holds; one that is there is
    replaced. Those in `remove` are dropped. `links` maps a group's name to what it shows: another file of the same
    folder, or with a leading slash another group. `marks` are attributes to set on groups without touching what
    they hold. Raises `FrictrackError` when the file that is there is not ours, or the folder cannot be written.
    """
    with _replacing(path) as file:
        for name in (*remove, *groups, *links, *(f"{name}/" for name in marks)):
            _guard(file, path, name)
        for name in (*remove, *groups, *links):
            if file.get(name, getlink=True) is not None:
                del file[name]
        for name, entry in groups.items():
            group = file.create_group(name)
            _put(group, entry.content)
            group.attrs.update(vars(entry.stamp))
        for name, target in links.items():
            inside = target.startswith("/")
            file[name] = h5py.SoftLink(target) if inside else h5py.ExternalLink(target, "/")
        for name, attributes in marks.items():
            file[name].attrs.update(attributes)


def read(path: Path, group: str, kind: Any = dict) -> Any:
    """Read a group as the record type `kind`, or as a dictionary.

    Raises `FrictrackError` when the file is not ours, is damaged, or has no such group.
    """
    with _reading(path) as file:
        found = _found(file, path, group)
        if found is None:
            raise FrictrackError(f'{path} holds no "{group}"; run the study again')
        return _take(found, set()) if kind is dict else _record(found, kind)


def stamp(path: Path, group: str) -> Stamp | None:
    """Where a group comes from; None when there is no such file or group."""
    held = attributes(path, group)
    return Stamp(**{f.name: str(held.get(f.name, "")) for f in fields(Stamp)}) if held else None


def attributes(path: Path, group: str) -> dict[str, Any]:
    """The numbers and strings of a group, without its arrays; none when there is no such file or group."""
    if not path.exists():
        return {}
    with _reading(path) as file:
        found = _found(file, path, group)
        return {} if found is None else {k: _number(v) for k, v in found.attrs.items()}


def names(path: Path, group: str = "/") -> list[str]:
    """The groups inside a group, in the order they were written; none when there is no such file."""
    if not path.exists():
        return []
    with _reading(path) as file:
        return list(_found(file, path, group) or ())


@contextmanager
def _reading(path: Path) -> Iterator[h5py.File]:
    try:
        with h5py.File(path, "r") as file:
            if "schema" not in file.attrs:
                raise FrictrackError(
                    f"expected {path} to be a frictrack result but another program wrote it; move it away"
                )
            if file.attrs["schema"] > SCHEMA:
                raise FrictrackError(
                    f"{path} was written by frictrack {file.attrs['version']}, this is {VERSION}; update it"
                )
            yield file
    except FileNotFoundError as e:
        raise FrictrackError(f"expected results in {path} but there is no such file; run the study") from e
    except PermissionError as e:
        raise FrictrackError(f"cannot read {path}: permission denied") from e
    except FrictrackError:
        raise
    except (OSError, LookupError, RuntimeError, TypeError, ValueError, AttributeError, MemoryError) as e:
        raise FrictrackError(f"{path} is damaged or is not HDF5; {REMEDY}") from e


@contextmanager
def _replacing(path: Path) -> Iterator[h5py.File]:
    """A new file with the old one's groups, which takes the old one's place when the block ends well."""
    with alone(path.parent), replaced(path) as part, h5py.File(part, "w") as file:
        file.attrs.update(schema=SCHEMA, version=VERSION)
        if path.exists():
            with _reading(path) as old:
                _copy(old, file)
        yield file


def _copy(old: h5py.File, new: h5py.File) -> None:
    for name in old:
        link = old.get(name, getlink=True)
        if isinstance(link, h5py.ExternalLink | h5py.SoftLink):
            new[name] = link
        else:
            old.copy(name, new)


def _guard(file: h5py.File, path: Path, name: str) -> None:
    """Raise where the way to a group (`name` up to its last slash) is a link: what is written must stay in the file."""
    inside = ""
    for part in name.split("/")[:-1]:
        inside = f"{inside}/{part}"
        link = file.get(inside, getlink=True)
        if link is not None and not isinstance(link, h5py.HardLink):
            raise FrictrackError(f"expected the group {inside} in {path} but it is a link; {REMEDY}")


def _found(file: h5py.File, path: Path, name: str) -> h5py.Group | None:
    """The group of that name, also where a link shows it inside the same file; None where there is none.

    Raises `FrictrackError` where a link leads out of the file.
    """
    if name not in file:
        return None
    found = file[name]
    if found.file.filename != file.filename or not isinstance(found, h5py.Group):
        raise FrictrackError(f'expected the group "{name}" in {path} but it is another thing; {REMEDY}')
    return found


def _put(group: h5py.Group, content: Any) -> None:
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
        _put(group.create_group(name), value)
    elif isinstance(value, np.ndarray):
        _put_array(group, name, value).attrs["unit"] = unit or ""
    elif isinstance(value, str) and len(value) > _LONG:
        group.create_dataset(name, data=value, dtype=_STRING)
    else:
        group.attrs[name] = json.dumps(plain(value)) if isinstance(value, tuple | list) else value
        if unit and isinstance(value, float):
            group.attrs[f"{name}_unit"] = unit


def _put_array(group: h5py.Group, name: str, value: np.ndarray[Any, Any]) -> h5py.Dataset:
    if value.dtype.kind in "UO":
        return group.create_dataset(name, data=value.astype(object), dtype=_STRING)
    if value.ndim == 0 or value.size == 0:
        return group.create_dataset(name, data=value)
    return group.create_dataset(name, data=value, compression="gzip", shuffle=True, fletcher32=True)


def _members(group: h5py.Group) -> Iterator[tuple[str, h5py.Group | h5py.Dataset]]:
    """What lies in a group itself; a link to somewhere else is not followed."""
    for name in group:
        if isinstance(group.get(name, getlink=True), h5py.HardLink):
            yield name, group[name]


def _take(group: h5py.Group, met: set[int]) -> dict[str, Any]:
    """Everything in a group as a dictionary, without the stamp; `met` are the groups above and beside it."""
    once(group, met)
    stamped = {f.name for f in fields(Stamp)}
    content = {k: _listed(_number(v)) for k, v in group.attrs.items() if k not in stamped}
    for name, item in _members(group):
        content[name] = _take(item, met) if isinstance(item, h5py.Group) else array_of(item)
    return content


def _record(group: h5py.Group, kind: Any) -> Any:
    values = {}
    inside = dict(_members(group))
    for f in fields(kind):
        if f.name in inside:
            item = inside[f.name]
            values[f.name] = _take(item, set()) if isinstance(item, h5py.Group) else array_of(item)
        elif f.name in group.attrs:
            raw = _number(group.attrs[f.name])
            is_tuple = raw is not None and str(f.type).startswith("tuple")
            values[f.name] = _tuple(json.loads(raw)) if is_tuple else raw
    return kind(**values)


def _number(value: Any) -> Any:
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
