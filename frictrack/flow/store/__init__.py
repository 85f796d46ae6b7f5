"""Read and write HDF5 results files: records and dictionaries in, the same out. A file is replaced as a whole.

    hdf5_io      write and read groups, list what is in a file
    encoding     records and dictionaries as HDF5 groups
    file_header  the checksum of a whole file, checked before HDF5 reads the file
    signatures   whether this user wrote a file
    sandbox      a separate process that opens files of other users first
    nexus        marks by which viewers draw the right curve
    checksums    the checksum of every group and dataset, which locates a fault
    size_checks  limits on what a file declares, checked before memory is allocated
    migrations   files of earlier schemas
    integrity    all faults of one file

What is in a file, and how others read it, is in SCHEMA.md.
"""

from frictrack.flow.store.encoding import GroupContent, Provenance
from frictrack.flow.store.file_header import CHECKSUM_START, HEADER_BYTES, SCHEMA, read_header
from frictrack.flow.store.hdf5_io import attributes, checksum, names, provenance, provenances, read, snapshot, write
from frictrack.flow.store.integrity import Fault, check
from frictrack.flow.store.nexus import ATTRIBUTES as NEXUS_ATTRIBUTES

__all__ = [
    "CHECKSUM_START",
    "HEADER_BYTES",
    "NEXUS_ATTRIBUTES",
    "SCHEMA",
    "Fault",
    "GroupContent",
    "Provenance",
    "attributes",
    "check",
    "checksum",
    "names",
    "provenance",
    "provenances",
    "read",
    "read_header",
    "snapshot",
    "write",
]
