"""The only door to HDF5: records and plain dictionaries in, the same out, a file replaced whole or not at all.

    door        write, read, what is there
    layout      records and dictionaries as groups
    seal        the checksum of a whole file, looked at before HDF5 sees a byte of it
    marks       whether this user wrote a file
    apart       files of others, opened by a process of its own before we do
    sums        the checksum of every group and dataset, which says where a fault is
    migrations  files of earlier schemas
    faults      all that can be wrong with one file

What is in a file, and how others read it, is in SCHEMA.md.
"""

from frictrack.store.door import attributes, held, names, read, stamp, stamps, write
from frictrack.store.faults import Fault, check
from frictrack.store.layout import Entry, Stamp
from frictrack.store.seal import ROOM, SCHEMA, START, head

__all__ = [
    "ROOM",
    "SCHEMA",
    "START",
    "Entry",
    "Fault",
    "Stamp",
    "attributes",
    "check",
    "head",
    "held",
    "names",
    "read",
    "stamp",
    "stamps",
    "write",
]
