"""Read, check, edit and write study files, and read tables of measurements.

A study file (TOML) says what was filmed, what is known of it, and which model is fitted first.

    loading          study.toml -> `Study`, with every fault in one error
    schema           the keys of a study file, with types and units
    editing          change one key of a study file; comments are kept
    writing          a new study file from recordings
    reading_tables   CSV and Excel -> columns in SI units
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
