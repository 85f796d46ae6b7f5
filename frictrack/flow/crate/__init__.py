"""Publish a study as one research object (RO-Crate), and compute the results of such a crate again elsewhere.

In Python, a crate is written from a session and reproduced in a new folder.

    from frictrack.flow.crate import CrateOptions, reproduce_crate, write_crate
    write_crate(Session(open_study("study.toml")), Path("study.crate.zip"), CrateOptions(licence="CC-BY-4.0"))
    reproduce_crate(Path("study.crate.zip"), Path("again"))["equal"]

    payload      what is in a crate; open it safely
    metadata     its description in JSON-LD: authors, units, versions, columns of tables
    writing      write it
    reading      read it, find and check the recordings
    reproducing  compute its results again and compare them
"""

from frictrack.flow.crate.reproducing import reproduce_crate
from frictrack.flow.crate.writing import CrateOptions, write_crate

__all__ = ["CrateOptions", "reproduce_crate", "write_crate"]
