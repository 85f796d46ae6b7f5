"""Files of earlier schemas: each step fills an empty file with what the one before it held, in memory.

A later schema adds one function and one line of the table; files on disk change only when something is written.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import count

import h5py
import numpy as np

from frictrack.store.claims import array_of
from frictrack.store.layout import new_group, put_array
from frictrack.store.seal import ROOM, SCHEMA
from frictrack.store.sums import add_sums

FORMAT = {"libver": ("v108", "v108"), "locking": False}  # HDF5 1.8: MATLAB and HDFView of the last ten years read it
_NUMBER = count()


def in_memory() -> h5py.File:
    """An empty file that never reaches the disk."""
    name = f"in memory {next(_NUMBER)}"  # HDF5 knows open files by name
    return h5py.File(name, "w", driver="core", backing_store=False, userblock_size=ROOM, **FORMAT)


def migrated(file: h5py.File) -> h5py.File:
    """The same content in today's schema: the file itself, or one in memory."""
    for schema in range(int(file.attrs["schema"]), SCHEMA):
        newer = in_memory()
        MIGRATIONS[schema](file, newer)
        newer.attrs["schema"] = schema + 1
        add_sums(newer)
        file = newer
    return file


def _with_sums(old: h5py.Group, new: h5py.Group) -> None:
    """Schema 1 had no checksums, strings of any length, and named no inputs one by one."""
    new.attrs.update(old.attrs)
    for name in old:
        link = old.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink):
            new[name] = link
        elif isinstance(old[name], h5py.Group):
            _with_sums(old[name], new_group(new, name))
        else:
            made = put_array(new, name, np.asarray(array_of(old[name])))
            made.attrs.update(old[name].attrs)


MIGRATIONS: dict[int, Callable[[h5py.Group, h5py.Group], None]] = {1: _with_sums}
