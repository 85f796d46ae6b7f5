"""The study file: what was filmed, with what, and which model is tried first.

`load` reads it into a frozen `Study`, `write_study` makes one from recordings, `read_table` reads the runs that
were measured by something other than a camera.
"""

from frictrack.study.editing import edited, with_effect, with_runs, without_run, written
from frictrack.study.loading import Study, load, parse, read_toml, results_of
from frictrack.study.reading_tables import TableData, read_clocked, read_table
from frictrack.study.schema import EffectTable, RunTable, nearest
from frictrack.study.writing import TABLES, find_recordings, write_study

__all__ = [
    "TABLES",
    "EffectTable",
    "RunTable",
    "Study",
    "TableData",
    "edited",
    "find_recordings",
    "load",
    "nearest",
    "parse",
    "read_clocked",
    "read_table",
    "read_toml",
    "results_of",
    "with_effect",
    "with_runs",
    "without_run",
    "write_study",
    "written",
]
