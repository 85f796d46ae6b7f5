"""Publish a study as one research object (RO-Crate), and compute the results of such a crate again elsewhere.

In Python, a crate is written from a session and reproduced in a new folder.

    from frictrack.flow.crate import CrateOptions, reproduce_crate, write_crate
    write_crate(Session(open_study("study.toml")), Path("study.crate.zip"), CrateOptions(licence="CC-BY-4.0"))
    reproduce_crate(Path("study.crate.zip"), Path("again"))["equal"]

    payload      what is in a crate: its files, tables and versions; open it safely
    writing      describe it in JSON-LD, and write it
    reproducing  read it, find and check the recordings, compute its results again and compare them
"""

from frictrack.flow.crate.reproducing import reproduce_crate
from frictrack.flow.crate.writing import CrateOptions, write_crate

__all__ = ["CrateOptions", "reproduce_crate", "write_crate"]
