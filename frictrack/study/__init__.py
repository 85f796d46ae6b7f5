"""The study file: what was filmed, with what, and which model is tried first.

`load` reads it into a frozen `Study`, `write_study` makes one from recordings, `read_table` reads the runs that
were measured by something other than a camera.
"""

from frictrack.study.load import Study, load
from frictrack.study.schema import EffectTable, RunTable
from frictrack.study.tables import TableData, read_clocked, read_table
from frictrack.study.write import TABLES, find_recordings, write_study

__all__ = [
    "TABLES",
    "EffectTable",
    "RunTable",
    "Study",
    "TableData",
    "find_recordings",
    "load",
    "read_clocked",
    "read_table",
    "write_study",
]
