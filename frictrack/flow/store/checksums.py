"""Check what an HDF5 file declares before memory is allocated, and the checksum of every group and dataset.

The file may come from anybody: sizes are checked against its real size first.

The attribute `sha256` of a dataset covers its type, shape, values and attributes. The checksum of a group covers its
attributes, the names in it, their checksums and its links, so that the checksum of the root covers everything.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from typing import Any

import h5py
import numpy as np

_MAX_COMPRESSION = 1100  # times that deflate can shrink an array (1032 at most, with overhead)
_ALWAYS_ALLOWED_BYTES = 1 << 20  # any array may be this large
_STRINGS_PER_READ = 64  # strings read at a time


def read_array(dataset: Any) -> Any:
    """Read the array of a dataset: numbers, an array of strings, or one string."""
    check_size(dataset)
    text = h5py.check_string_dtype(dataset.dtype)
    if text is None:
        return dataset[()]
    limit = 16 * dataset.file.id.get_filesize() + _ALWAYS_ALLOWED_BYTES
    return _strings(dataset, limit if text.length is None else math.inf)


def check_size(dataset: Any) -> None:
    """Check what a dataset declares before it is read."""
    if not isinstance(dataset, h5py.Dataset) or dataset.external or dataset.is_virtual:
        raise ValueError("expected an array in this very file")
    if h5py.check_string_dtype(dataset.dtype) is None and dataset.dtype.kind not in "biuf":
        raise ValueError(f"expected numbers or strings but got {dataset.dtype}")
    most = _MAX_COMPRESSION * min(dataset.id.get_storage_size(), dataset.file.id.get_filesize()) + _ALWAYS_ALLOWED_BYTES
    chunk = math.prod(dataset.chunks or (0,)) * dataset.dtype.itemsize
    if max(dataset.nbytes, chunk) > most:
        raise ValueError(f"expected at most {most} bytes but {dataset.name} claims {max(dataset.nbytes, chunk)}")


def _strings(dataset: Any, most: float) -> Any:
    """Read the strings (n,) of a dataset, or the only one; many may refer to the same bytes of the file."""
    if dataset.ndim != 1:
        text = dataset.asstr()[()]
        return text if isinstance(text, str) else np.asarray(text, dtype=np.str_)
    found: list[str] = []
    total = longest = 0
    for at in range(0, len(dataset), _STRINGS_PER_READ):
        some = dataset.asstr()[at : at + _STRINGS_PER_READ].tolist()
        found += some
        total, longest = total + sum(map(len, some)), max(longest, *map(len, some))
        if max(total, longest * len(dataset)) > most:
            raise ValueError(f"expected at most {most} characters but {dataset.name} has more")
    return np.asarray(found, dtype=np.str_)


def check_visited_once(item: Any, met: set[int]) -> None:
    """Raise ValueError if a group was visited before: groups inside themselves or each other would never end."""
    address = h5py.h5o.get_info(item.id).addr
    if address in met:
        raise ValueError(f"expected every group in one place but {item.name} is in several")
    met.add(address)


def members(group: h5py.Group) -> Iterator[tuple[str, h5py.Group | h5py.Dataset]]:
    """Yield name and object of what a group itself holds; links to other places are not followed."""
    for name in group:
        if isinstance(group.get(name, getlink=True), h5py.HardLink):
            yield name, group[name]


CHECKSUM = "sha256"


def add_checksums(item: h5py.Group | h5py.Dataset) -> str:
    """Write the missing checksums of an object and everything in it; return the checksum of the object."""
    stored = item.attrs.get(CHECKSUM)
    if stored is None and isinstance(item, h5py.Group):
        return add_group_checksum(item, {name: add_checksums(child) for name, child in members(item)})
    if stored is None:
        stored = item.attrs[CHECKSUM] = _checksum(item)
    return str(stored)


def add_group_checksum(group: h5py.Group, inside: Mapping[str, str]) -> str:
    """Write the checksum of a group, given those of everything in it by name; return it."""
    checksum = group.attrs[CHECKSUM] = _digest(_group(group, inside), dict(group.attrs))
    return checksum


def drop_checksums(file: h5py.File, name: str) -> None:
    """Remove the checksums of a group that is about to change, and of all its parents."""
    file.attrs.pop(CHECKSUM, None)
    inside = ""
    for part in filter(None, name.split("/")):
        inside = f"{inside}/{part}"
        if isinstance(file.get(inside, getlink=True), h5py.HardLink):
            file[inside].attrs.pop(CHECKSUM, None)


def wrong_checksums(item: h5py.Group | h5py.Dataset, met: set[int] | None = None) -> Iterator[tuple[str, str]]:
    """Find everything whose content differs from its checksum, or that cannot be read."""
    met = set() if met is None else met
    try:
        check_visited_once(item, met)
        for name in item if isinstance(item, h5py.Group) else ():
            try:
                inside = item[name] if isinstance(item.get(name, getlink=True), h5py.HardLink) else None
            except Exception as e:  # noqa: BLE001 - as below
                yield f"{item.name.rstrip('/')}/{name}", f"cannot be read ({' '.join(str(e).split())})"
            else:
                yield from () if inside is None else wrong_checksums(inside, met)
        stored, found = item.attrs.get(CHECKSUM), _checksum(item)
    except Exception as e:  # noqa: BLE001 - h5py raises any exception on a damaged file
        yield item.name, f"cannot be read ({' '.join(str(e).split())})"
        return
    if stored is None:
        yield item.name, "has no checksum, frictrack did not write it"
    elif stored != found:
        yield item.name, "holds something else than was written (its checksum is another one)"


def array_checksum(value: np.ndarray[Any, Any], attributes: Mapping[str, Any]) -> str:
    """Compute the checksum of a dataset from what is written into it, so that it need not be read again."""
    return _digest(_coded(value[()] if value.ndim == 0 else value, value.dtype), attributes)


def _checksum(item: h5py.Group | h5py.Dataset) -> str:
    """Compute the checksum of an object; for the members of a group, their stored checksums are used."""
    content = _group(item, {}) if isinstance(item, h5py.Group) else _coded(_array(item), item.dtype)
    return _digest(content, dict(item.attrs))


def _digest(content: Iterable[bytes], attributes: Mapping[str, Any]) -> str:
    """Compute the checksum of encoded content and attributes."""
    digest = hashlib.sha256()
    pairs = ((name, attributes[name]) for name in sorted(attributes) if name != CHECKSUM)
    coded = ((name.encode(), *_coded(value, getattr(value, "dtype", None))) for name, value in pairs)
    for part in chain(content, *coded):
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


def _array(dataset: h5py.Dataset) -> Any:
    """Read an array as stored. Raise ValueError for types that frictrack never writes in today's schema."""
    check_size(dataset)
    if (text := h5py.check_string_dtype(dataset.dtype)) and text.length is None:
        raise ValueError("expected texts of fixed length")
    return dataset[()]


def _group(group: h5py.Group, inside: Mapping[str, str]) -> Iterator[bytes]:
    """Encode the names in a group with their checksums; those not in `inside` are read."""
    yield b"group"
    for name in sorted(group):
        yield name.encode()
        if name in inside:
            yield inside[name].encode()
            continue
        link = group.get(name, getlink=True)
        if isinstance(link, h5py.HardLink):
            yield str(group[name].attrs.get(CHECKSUM)).encode()
        else:
            yield f"{type(link).__name__} {getattr(link, 'filename', '')} {link.path}".encode()


def _coded(value: Any, dtype: Any) -> Iterator[bytes]:
    """Encode type, shape and content of an array, a number, a text or an empty value."""
    if isinstance(value, h5py.Empty):
        yield b"empty"
    elif isinstance(value, str | bytes):
        yield b"text"
        yield value.encode() if isinstance(value, str) else value
    else:
        array = np.ascontiguousarray(value)
        yield f"{dtype.str} {np.shape(value)}".encode()
        yield array.tobytes() if array.dtype.kind != "O" else repr(array.tolist()).encode()
