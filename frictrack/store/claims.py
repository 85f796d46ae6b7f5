"""What an HDF5 file claims against what it holds, before memory is given for it: the file may come from anybody."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np

_DENSEST = 1100  # times that deflate can make an array smaller
_FREE = 1 << 20  # bytes that any array may take
_TOGETHER = 64  # strings read at a time


def array_of(dataset: Any) -> Any:
    """The array of a dataset: numbers as they are, strings as such, a single string as one.

    Raises ValueError for what frictrack never writes, as `fits` does.
    """
    fits(dataset)
    text = h5py.check_string_dtype(dataset.dtype)
    if text is None:
        return dataset[()]
    return _strings(dataset, 16 * dataset.file.id.get_filesize() + _FREE if text.length is None else math.inf)


def fits(dataset: Any) -> None:
    """Look at what a dataset claims to be before it is read.

    Raises ValueError for data in another file, other types than numbers and strings, and an array or a chunk that is
    larger than the bytes in the file can unfold to.
    """
    if not isinstance(dataset, h5py.Dataset) or dataset.external or dataset.is_virtual:
        raise ValueError("expected an array in this very file")
    if h5py.check_string_dtype(dataset.dtype) is None and dataset.dtype.kind not in "biuf":
        raise ValueError(f"expected numbers or strings but got {dataset.dtype}")
    most = _DENSEST * min(dataset.id.get_storage_size(), dataset.file.id.get_filesize()) + _FREE
    chunk = math.prod(dataset.chunks or (0,)) * dataset.dtype.itemsize
    if max(dataset.nbytes, chunk) > most:
        raise ValueError(f"expected at most {most} bytes but {dataset.name} claims {max(dataset.nbytes, chunk)}")


def _strings(dataset: Any, most: float) -> Any:
    """All strings (n,) of a dataset, or the only one; many may stand for the same bytes of the file."""
    if dataset.ndim != 1:
        text = dataset.asstr()[()]
        return text if isinstance(text, str) else np.asarray(text, dtype=np.str_)
    found: list[str] = []
    total = longest = 0
    for at in range(0, len(dataset), _TOGETHER):
        some = dataset.asstr()[at : at + _TOGETHER].tolist()
        found += some
        total, longest = total + sum(map(len, some)), max(longest, *map(len, some))
        if max(total, longest * len(dataset)) > most:
            raise ValueError(f"expected at most {most} characters but {dataset.name} has more")
    return np.asarray(found, dtype=np.str_)


def once(item: Any, met: set[int]) -> None:
    """Raise ValueError where a group was met before: groups inside themselves or each other have no end."""
    address = h5py.h5o.get_info(item.id).addr
    if address in met:
        raise ValueError(f"expected every group in one place but {item.name} is in several")
    met.add(address)


def members(group: h5py.Group) -> Iterator[tuple[str, h5py.Group | h5py.Dataset]]:
    """What lies in a group itself; a link to somewhere else is not followed."""
    for name in group:
        if isinstance(group.get(name, getlink=True), h5py.HardLink):
            yield name, group[name]
