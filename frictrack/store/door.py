"""Groups in and out of a file; whoever reads sees one whole version of it, whoever else writes meanwhile.

A file is never changed in place: what is new takes its place in one step, and who has the old one open keeps it.
HDF5's own locks are therefore left alone: they would only shut out a viewer, or fail on a network drive.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py

from frictrack.errors import FrictrackError
from frictrack.files import alone, replaced
from frictrack.store import layout
from frictrack.store.apart import is_sound
from frictrack.store.claims import members
from frictrack.store.layout import Entry, Stamp
from frictrack.store.marks import is_ours, mark
from frictrack.store.migrations import in_memory, migrated
from frictrack.store.seal import SCHEMA, head, intact, is_bare, sealed, state
from frictrack.store.sums import SUM, add_sums, drop_sums
from frictrack.version import __version__

NOTHING: Mapping[Any, Any] = {}
REMEDY = "delete it and run again, the recordings are untouched"
_HELD: ContextVar[Mapping[Path, h5py.File]] = ContextVar("files held open", default=NOTHING)


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
            drop_sums(file, name)
        for name in (*remove, *groups, *links):
            if file.get(name, getlink=True) is not None:
                del file[name]
        for name, entry in groups.items():
            group = layout.new_group(file, name)
            layout.put(group, entry.content)
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
        return layout.take(found) if kind is dict else layout.record(found, kind)


def stamp(path: Path, group: str) -> Stamp | None:
    """Where a group comes from; None when there is no such file or group."""
    return _stamped(attributes(path, group))


def stamps(path: Path) -> dict[str, Stamp]:
    """Where each group of a file comes from, subgroups included, by name ("models/1_tustin"); not of what it links."""
    with _reading(path) as file:
        return dict(_stamps_in(file, ""))


def attributes(path: Path, group: str) -> dict[str, Any]:
    """The numbers and strings of a group, without its arrays; none when there is no such file or group."""
    if not path.exists():
        return {}
    with _reading(path) as file:
        found = _found(file, path, group)
        return {} if found is None else {k: layout.number(v) for k, v in found.attrs.items() if k != SUM}


def names(path: Path, group: str = "/") -> list[str]:
    """The names inside a group, in the order of the alphabet; none when there is no such file."""
    if not path.exists():
        return []
    with _reading(path) as file:
        return list(_found(file, path, group) or ())


@contextmanager
def held(*paths: Path) -> Iterator[None]:
    """All that is read of these files inside is of one and the same version, whoever replaces them meanwhile."""
    if not paths:
        yield
    elif not paths[0].exists() or paths[0] in _HELD.get():
        with held(*paths[1:]):
            yield
    else:
        with _reading(paths[0]) as file:
            before = _HELD.set({**_HELD.get(), paths[0]: file})
            try:
                with held(*paths[1:]):
                    yield
            finally:
                _HELD.reset(before)


def _stamped(held: Mapping[str, Any]) -> Stamp | None:
    return Stamp(**{f.name: str(held.get(f.name, "")) for f in fields(Stamp)}) if held else None


def _stamps_in(group: h5py.Group, inside: str) -> Iterator[tuple[str, Stamp]]:
    for name, item in members(group):
        if isinstance(item, h5py.Group):
            if "key" in item.attrs and (found := _stamped({k: item.attrs[k] for k in item.attrs})):
                yield inside + name, found
            yield from _stamps_in(item, f"{inside}{name}/")


@contextmanager
def _reading(path: Path) -> Iterator[h5py.File]:
    """The file to read, in today's schema. Whatever is wrong with it is one `FrictrackError`."""
    with _said(path):
        if path in _HELD.get():
            yield _HELD.get()[path]
            return
        border(path)
        if not (is_ours(path) or is_sound(path)):
            raise FrictrackError(f"{path} is damaged or is not HDF5; {REMEDY}")
        with h5py.File(path, "r", locking=False) as file:
            if "schema" not in file.attrs:
                raise FrictrackError(
                    f"expected {path} to be a frictrack result but another program wrote it; move it away"
                )
            yield file if file.attrs["schema"] == SCHEMA else _migrated(path, *state(path))


@lru_cache(maxsize=16)  # a page asks an old file a hundred times
def _migrated(path: Path, *_: int) -> h5py.File:
    """One state of a file of an earlier schema, in today's, in memory."""
    with h5py.File(path, "r", locking=False) as file:
        return migrated(file)


def border(path: Path, *, anew: bool = False) -> None:
    """Look before HDF5 does whether a file holds the bytes that were written, in a schema that is known here.

    Raises `FrictrackError` if not, `OSError` where it cannot be read.
    """
    told = head(path)
    if told is None and is_bare(path):
        return  # of schema 1, or another program's
    if told is None or not intact(path, anew=anew):
        raise FrictrackError(f"{path} is damaged or is not HDF5; {REMEDY}")
    schema, version = told
    if schema > SCHEMA:
        raise FrictrackError(
            f"expected {path} of schema {SCHEMA} at most but it has {schema} and was written by frictrack {version}, "
            f"this is {__version__}; update it"
        )


@contextmanager
def _said(path: Path) -> Iterator[None]:
    """Whatever happens to the one who reads a file, as one sentence."""
    try:
        yield
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
    """A new file with the old one's groups, which takes the old one's place when the block ends well.

    It is made in memory: HDF5 itself would crash on a disk that is full.
    """
    with alone(path.parent), replaced(path) as part:
        with in_memory() as file:
            if path.exists():
                with _reading(path) as old:
                    copy(old, file)
            file.attrs.update(schema=SCHEMA, version=__version__)
            file.attrs.pop(SUM, None)
            yield file
            add_sums(file)
            file.flush()
            whole = sealed(file.id.get_file_image(), __version__, mark)
        part.write_bytes(whole)


def copy(old: h5py.File, new: h5py.File) -> None:
    """All groups of a file into another one, links as they are."""
    new.attrs.update(old.attrs)
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
