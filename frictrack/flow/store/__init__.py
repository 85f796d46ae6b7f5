"""Read and write HDF5 results files: records and dictionaries in, the same out. A file is replaced as a whole.

    encoding     records and dictionaries as HDF5 groups; marks for viewers
    integrity    the header with the checksum of a whole file, checked before HDF5 reads it, and who wrote it; faults
                 inside a file; a separate process opens files of others

What is in a file, and how others read it, is in SCHEMA.md.

A file is never changed in place. The new file replaces the old one in one step, so that a reader always sees one
complete version, and whoever has the old file open keeps it. HDF5's own locks are therefore not used: they would only
block viewers, or fail on network drives.
"""

# ruff: noqa: F401 - the imports are the interface

from __future__ import annotations

import io
import os
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py

from frictrack.base import __version__
from frictrack.base.errors import FrictrackError
from frictrack.base.files import atomic_write, lock_folder
from frictrack.flow.store import encoding, integrity
from frictrack.flow.store.encoding import ATTRIBUTES as NEXUS_ATTRIBUTES
from frictrack.flow.store.encoding import GroupContent, Provenance, mark_default, members, without_marks
from frictrack.flow.store.integrity import (
    CHECKSUM_START,
    HEADER_BYTES,
    REMEDY,
    SCHEMA,
    Fault,
    copy_groups,
    fault_inside,
    file_state,
    opens_safely,
    read_header,
)

NOTHING: Mapping[Any, Any] = {}
# HDF5 1.8: MATLAB and HDFView of the last ten years read it
FORMAT = {"libver": ("v108", "v108"), "locking": False, "userblock_size": integrity.HEADER_BYTES}
MAX_GROUPS_KNOWN = 10_000  # whose attributes are kept
_ATTRIBUTES: dict[tuple[Path, Any, str], dict[str, Any]] = {}  # by file, its version and the group
_HELD: ContextVar[Mapping[Path, h5py.File]] = ContextVar("files held open", default=NOTHING)


def write(
    path: Path,
    groups: Mapping[str, GroupContent],
    *,
    remove: tuple[str, ...] = (),
    links: Mapping[str, str] = NOTHING,
    attribute_updates: Mapping[str, Mapping[str, Any]] = NOTHING,
) -> None:
    """Write groups into a file, keep all others, and replace the file in one step."""
    with _replacing(path) as file:
        for name in (*remove, *groups, *links, *(f"{name}/" for name in attribute_updates)):
            _guard(file, path, name)
        for name in (*remove, *groups, *links):
            if file.get(name, getlink=True) is not None:
                del file[name]
        for name, entry in groups.items():
            encoding.write_group(encoding.new_group(file, name), entry.content, vars(entry.provenance))
        for name, target in links.items():
            inside, above = target.startswith("/"), name.rpartition("/")[0]
            if above and above not in file:  # HDF5 would make it with its time
                encoding.new_group(file, above)
            file[name] = h5py.SoftLink(target) if inside else h5py.ExternalLink(target, "/")
        for name, attributes in attribute_updates.items():
            file[name].attrs.update(attributes)


def read(path: Path, group: str, kind: Any = dict, *, without: Collection[str] = ()) -> Any:
    """Read one group of a file.

    Parameters
    ----------
    path, group
        The file, and the name of the group.
    kind
        Record type to build, or `dict`.
    without
        Names of subgroups and arrays that a dictionary leaves out.

    Returns
    -------
    object
        The record, or a dictionary of arrays, numbers, strings and dictionaries.

    Raises
    ------
    FrictrackError
        If the file is not a frictrack file, is damaged, or has no such group.

    """
    with _reading(path) as file:
        found = _found(file, path, group)
        if found is None:
            raise FrictrackError(f'{path} holds no "{group}"; run the study again')
        return encoding.read_dict(found, without=without) if kind is dict else encoding.read_record(found, kind)


def provenance(path: Path, group: str) -> Provenance | None:
    """Return what a group was made from; None if there is no such file or group."""
    return _provenance_of(attributes(path, group))


def provenances(path: Path) -> dict[str, Provenance]:
    """Return the provenance of every group of a file, without the files that it links to."""
    with _reading(path) as file:
        return dict(_provenances_in(file, ""))


def attributes(path: Path, group: str) -> dict[str, Any]:
    """Return the numbers and strings of a group, without its arrays; empty if there is no such file or group."""
    return without_marks(_attributes(path, group))


def _attributes(path: Path, group: str) -> dict[str, Any]:
    """Return the attributes of a group; those of many groups are kept, since a page asks again and again."""
    if not path.exists():
        return {}
    with _reading(path) as file:
        opened = os.fstat(file.id.get_vfd_handle())
        key = path, (opened.st_ino, opened.st_mtime_ns, opened.st_size), group
        if key not in _ATTRIBUTES:
            if len(_ATTRIBUTES) >= MAX_GROUPS_KNOWN:
                _ATTRIBUTES.clear()
            found = _found(file, path, group)
            _ATTRIBUTES[key] = {} if found is None else {k: encoding.to_python(v) for k, v in found.attrs.items()}
        return _ATTRIBUTES[key]


def names(path: Path, group: str = "/") -> list[str]:
    """List the names inside a group in alphabetical order; empty if there is no such file or group."""
    if not path.exists():
        return []
    with _reading(path) as file:
        return list(_found(file, path, group) or ())


@contextmanager
def snapshot(*paths: Path) -> Iterator[None]:
    """Read several files at one version: reads in the block see the same content, even if the files are replaced."""
    with ExitStack() as opened:
        files = {path: opened.enter_context(_reading(path)) for path in dict.fromkeys(paths) if path.exists()}
        before = _HELD.set({**_HELD.get(), **files})
        try:
            yield
        finally:
            _HELD.reset(before)


def _provenance_of(held: Mapping[str, Any]) -> Provenance | None:
    return Provenance(**{f.name: str(held.get(f.name, "")) for f in fields(Provenance)}) if held else None


def _provenances_in(group: h5py.Group, inside: str) -> Iterator[tuple[str, Provenance]]:
    for name, item in members(group):
        if isinstance(item, h5py.Group):
            if "key" in item.attrs and (found := _provenance_of({k: item.attrs[k] for k in item.attrs})):
                yield inside + name, found
            yield from _provenances_in(item, f"{inside}{name}/")


@contextmanager
def _reading(path: Path) -> Iterator[h5py.File]:
    """Open a file for reading, in today's schema. Every fault becomes one `FrictrackError`."""
    with _one_sentence(path):
        if path in _HELD.get():
            yield _HELD.get()[path]
            return
        check_header(path)
        if not opens_safely(path):
            raise FrictrackError(f"{path} is damaged or is not HDF5; {REMEDY}")
        with h5py.File(path, "r", locking=False) as file:
            if "schema" not in file.attrs:
                raise FrictrackError(
                    f"expected {path} to be a frictrack result but another program wrote it; move it away"
                )
            yield file


def check_header(path: Path, *, reread: bool = False) -> None:
    """Check before HDF5 opens a file that it holds the bytes that were written, in a known schema."""
    header = integrity.read_header(path, reread=reread)
    if not header.is_intact:
        raise FrictrackError(f"{path} is damaged or is not HDF5; {REMEDY}")
    if header.schema > integrity.SCHEMA:
        raise FrictrackError(
            f"expected {path} of schema {integrity.SCHEMA} at most but it has {header.schema} and was written by "
            f"frictrack {header.version}, this is {__version__}; update it"
        )


def check(path: Path) -> Fault | None:
    """Find the fault of one HDF5 file, if it has one. Nothing is raised, whatever the file holds."""
    try:
        check_header(path, reread=True)
    except FrictrackError as e:
        what, _, do = str(e).removeprefix(f"{path} ").rpartition("; ")
        return Fault(path, "", what, do)
    except OSError as e:
        return Fault(path, "", f"cannot be read ({e.strerror})", "look at its rights and at the disk")
    return fault_inside(path)


@contextmanager
def _one_sentence(path: Path) -> Iterator[None]:
    """Turn whatever a reader may meet into one `FrictrackError`."""
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
    """Open a new file with the groups of the old one; it replaces the old one if the block succeeds.

    It is built in memory, because HDF5 itself would crash on a full disk.
    """
    with lock_folder(path.parent), atomic_write(path) as part:
        whole = io.BytesIO()  # whose bytes are written as they are; HDF5's own memory would have to be copied first
        with h5py.File(whole, "w", **FORMAT) as file:
            if path.exists():
                with _reading(path) as old:
                    copy_groups(old, file)
                    if old.attrs["schema"] == 2:  # whose checksums of groups would be wrong after a change
                        file.attrs.pop(encoding.FORMER_CHECKSUM, None)
                        file.visititems(lambda _, item: item.attrs.pop(encoding.FORMER_CHECKSUM, None) and None)
            file.attrs.update(schema=integrity.SCHEMA, version=__version__)
            yield file
            mark_default(file)
            begin = file.userblock_size
        content = whole.getbuffer()
        content[:begin] = integrity.header_of(content[begin:], __version__, integrity.sign)
        part.write_bytes(content)


def _guard(file: h5py.File, path: Path, name: str) -> None:
    """Raise if a parent of the group `name` is a link: what is written must stay in this file."""
    inside = ""
    for part in name.split("/")[:-1]:
        inside = f"{inside}/{part}"
        link = file.get(inside, getlink=True)
        if link is not None and not isinstance(link, h5py.HardLink):
            raise FrictrackError(f"expected the group {inside} in {path} but it is a link; {REMEDY}")


def _found(file: h5py.File, path: Path, name: str) -> h5py.Group | None:
    """Return the group of that name, also through a link inside the file; None if there is none.

    Raises `FrictrackError` if a link leads out of the file.
    """
    if name not in file:
        return None
    found = file[name]
    if found.file.filename != file.filename or not isinstance(found, h5py.Group):
        raise FrictrackError(f'expected the group "{name}" in {path} but it is another thing; {REMEDY}')
    return found
