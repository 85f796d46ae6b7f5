"""Migrate files of earlier schemas, in memory: each step fills an empty file from the one before it.

A later schema adds one function and one line of the table. Files on disk change only when something is written.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import count

import h5py
import numpy as np

from frictrack.flow.store.checksums import add_checksums, read_array
from frictrack.flow.store.encoding import new_group, write_array
from frictrack.flow.store.file_header import HEADER_BYTES, SCHEMA

# HDF5 1.8: MATLAB and HDFView of the last ten years read it
FORMAT = {"libver": ("v108", "v108"), "locking": False, "userblock_size": HEADER_BYTES}
_NUMBER = count()


def empty_file_in_memory() -> h5py.File:
    """Create an empty file that never reaches the disk."""
    name = f"in memory {next(_NUMBER)}"  # HDF5 knows open files by name
    return h5py.File(name, "w", driver="core", backing_store=False, **FORMAT)


def migrate(file: h5py.File) -> h5py.File:
    """Return the same content in today's schema: the file itself, or a copy in memory."""
    for schema in range(int(file.attrs["schema"]), SCHEMA):
        newer = empty_file_in_memory()
        MIGRATIONS[schema](file, newer)
        newer.attrs["schema"] = schema + 1
        add_checksums(newer)
        file = newer
    return file


def _add_checksums(old: h5py.Group, new: h5py.Group) -> None:
    """Migrate schema 1, which had no checksums, strings of any length, and no list of inputs."""
    new.attrs.update(old.attrs)
    for name in old:
        link = old.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink):
            new[name] = link
        elif isinstance(old[name], h5py.Group):
            _add_checksums(old[name], new_group(new, name))
        else:
            write_array(new, name, np.asarray(read_array(old[name])), **old[name].attrs)


MIGRATIONS: dict[int, Callable[[h5py.Group, h5py.Group], None]] = {1: _add_checksums}
