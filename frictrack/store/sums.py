"""The checksum of every group and dataset: the attribute `sha256` on each, over what is read of it.

That of a dataset is over its kind, shape, numbers and attributes; that of a group over its attributes, the names in
it, their checksums and the links: the one of the file itself thus answers for all.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np

from frictrack.store.claims import fits, members, once

SUM = "sha256"


def add_sums(item: h5py.Group | h5py.Dataset) -> str:
    """Put the checksum on everything inside that has none, and say that of the whole."""
    held = item.attrs.get(SUM)
    if held is None:
        if isinstance(item, h5py.Group):
            for _, child in members(item):
                add_sums(child)
        held = item.attrs[SUM] = _sum(item)
    return str(held)


def drop_sums(file: h5py.File, name: str) -> None:
    """Take the checksum off what is about to change, and off all that it lies in."""
    file.attrs.pop(SUM, None)
    inside = ""
    for part in filter(None, name.split("/")):
        inside = f"{inside}/{part}"
        if isinstance(file.get(inside, getlink=True), h5py.HardLink):
            file[inside].attrs.pop(SUM, None)


def wrong_sums(item: h5py.Group | h5py.Dataset, met: set[int] | None = None) -> Iterator[tuple[str, str]]:
    """(name, what is wrong) of everything inside that is not as its checksum says, or cannot be read.

    A fault stands with the innermost thing that it is in; `met` are the groups above and beside it.
    """
    met = set() if met is None else met
    try:
        once(item, met)
        for name in item if isinstance(item, h5py.Group) else ():
            yield from _wrong_child(item, name, met)
        held, found = item.attrs.get(SUM), _sum(item)
    except Exception as e:  # noqa: BLE001 - whatever h5py stumbles over in a damaged file
        yield item.name, f"cannot be read ({' '.join(str(e).split())})"
        return
    if held is None:
        yield item.name, "has no checksum, frictrack did not write it"
    elif held != found:
        yield item.name, "holds something else than was written (its checksum is another one)"


def _wrong_child(group: h5py.Group, name: str, met: set[int]) -> Iterator[tuple[str, str]]:
    try:
        inside = group[name] if isinstance(group.get(name, getlink=True), h5py.HardLink) else None
    except Exception as e:  # noqa: BLE001 - as above
        yield f"{group.name.rstrip('/')}/{name}", f"cannot be read ({' '.join(str(e).split())})"
        return
    if inside is not None:
        yield from wrong_sums(inside, met)


def _sum(item: h5py.Group | h5py.Dataset) -> str:
    """Of what lies in the thing itself; of what is inside a group the checksums that stand there are taken."""
    digest = hashlib.sha256()
    for part in _group(item) if isinstance(item, h5py.Group) else _coded(_array(item), item.dtype):
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    for name in sorted(item.attrs):
        if name != SUM:
            value = item.attrs[name]
            for part in (name.encode(), *_coded(value, getattr(value, "dtype", None))):
                digest.update(len(part).to_bytes(8, "little"))
                digest.update(part)
    return digest.hexdigest()


def _array(dataset: h5py.Dataset) -> Any:
    """The array as it stands in the file. Raises ValueError for what frictrack never writes in today's schema."""
    fits(dataset)
    if (text := h5py.check_string_dtype(dataset.dtype)) and text.length is None:
        raise ValueError("expected texts of fixed length")
    return dataset[()]


def _group(group: h5py.Group) -> Iterator[bytes]:
    yield b"group"
    for name in sorted(group):
        yield name.encode()
        link = group.get(name, getlink=True)
        if isinstance(link, h5py.HardLink):
            yield str(group[name].attrs.get(SUM)).encode()
        else:
            yield f"{type(link).__name__} {getattr(link, 'filename', '')} {link.path}".encode()


def _coded(value: Any, dtype: Any) -> Iterator[bytes]:
    """Kind, shape and content of an array, a number, a text or nothing."""
    if isinstance(value, h5py.Empty):
        yield b"empty"
    elif isinstance(value, str | bytes):
        yield b"text"
        yield value.encode() if isinstance(value, str) else value
    else:
        array = np.ascontiguousarray(value)
        yield f"{dtype.str} {np.shape(value)}".encode()
        yield array.tobytes() if array.dtype.kind != "O" else repr(array.tolist()).encode()
