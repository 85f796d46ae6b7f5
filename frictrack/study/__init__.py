"""The study file: what was filmed, with what, and which model is tried first.

`load` reads it into a frozen `Study`, `write_study` makes one from recordings, `read_table` reads the runs that
were measured by something other than a camera.
"""

from frictrack.study.editing import read_key, with_effect, with_key, with_runs, without_run
from frictrack.study.loading import Study, load, parse, read_toml, results_folder
from frictrack.study.reading_tables import TableData, read_sensor_table, read_table
from frictrack.study.schema import EffectTable, RunTable, suggest
from frictrack.study.writing import TABLES, find_recordings, write_study

__all__ = [
    "TABLES",
    "EffectTable",
    "RunTable",
    "Study",
    "TableData",
    "find_recordings",
    "load",
    "parse",
    "read_key",
    "read_sensor_table",
    "read_table",
    "read_toml",
    "results_folder",
    "suggest",
    "with_effect",
    "with_key",
    "with_runs",
    "without_run",
    "write_study",
]
