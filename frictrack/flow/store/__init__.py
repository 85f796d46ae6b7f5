"""Read and write HDF5 results files: records and dictionaries in, the same out. A file is replaced as a whole.

    hdf5_io      write and read groups, list what is in a file, check it
    encoding     records and dictionaries as HDF5 groups; marks for viewers
    integrity    the header with the checksum of a whole file, checked before HDF5 reads it, and who wrote it; faults
                 inside a file; a separate process opens files of others

What is in a file, and how others read it, is in SCHEMA.md.
"""

# ruff: noqa: F401 - the imports are the interface

from frictrack.flow.store.encoding import ATTRIBUTES as NEXUS_ATTRIBUTES
from frictrack.flow.store.encoding import GroupContent, Provenance
from frictrack.flow.store.hdf5_io import attributes, check, names, provenance, provenances, read, snapshot, write
from frictrack.flow.store.integrity import CHECKSUM_START, HEADER_BYTES, SCHEMA, Fault, file_state, read_header
