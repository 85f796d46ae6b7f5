"""Check what an HDF5 file declares against its real size before memory is allocated: the file may come from anybody."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np

_MAX_COMPRESSION = 1100  # times that deflate can shrink an array (1032 at most, with overhead)
_ALWAYS_ALLOWED_BYTES = 1 << 20  # any array may be this large
_STRINGS_PER_READ = 64  # strings read at a time


def read_array(dataset: Any) -> Any:
    """Read the array of a dataset: numbers, an array of strings, or one string.

    Raises
    ------
    ValueError
        For what frictrack never writes; see `check_size`.

    """
    check_size(dataset)
    text = h5py.check_string_dtype(dataset.dtype)
    if text is None:
        return dataset[()]
    return _strings(
        dataset, 16 * dataset.file.id.get_filesize() + _ALWAYS_ALLOWED_BYTES if text.length is None else math.inf
    )


def check_size(dataset: Any) -> None:
    """Check what a dataset declares before it is read.

    Raises
    ------
    ValueError
        For data in another file, for types other than numbers and strings, and for an array or a chunk that is larger
        than the bytes of the file can decompress to.

    """
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
    """Raise ValueError if a group was visited before: groups inside themselves or each other would never end.

    Parameters
    ----------
    item
        A group or a dataset.
    met
        Addresses of the objects that were visited; this one is added.

    """
    address = h5py.h5o.get_info(item.id).addr
    if address in met:
        raise ValueError(f"expected every group in one place but {item.name} is in several")
    met.add(address)


def members(group: h5py.Group) -> Iterator[tuple[str, h5py.Group | h5py.Dataset]]:
    """Yield name and object of what a group itself holds; links to other places are not followed."""
    for name in group:
        if isinstance(group.get(name, getlink=True), h5py.HardLink):
            yield name, group[name]
