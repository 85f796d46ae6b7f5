"""Read, check, edit and write study files, and read tables of measurements.

A study file (TOML) says what was filmed, what is known of it, and which model is fitted first.

    loading          study.toml -> `Study`, with every fault in one error
    schema           the keys of a study file, with types and units
    editing          change one key of a study file; comments are kept
    writing          a new study file from recordings
    reading_tables   CSV and Excel -> columns in SI units
"""

# ruff: noqa: F401 - the imports are for type checkers; at run time the names are imported on first use

from typing import TYPE_CHECKING

from frictrack.lazy import lazy_names

if TYPE_CHECKING:
    from frictrack.study.editing import read_key, with_effect, with_key, with_runs, without_run
    from frictrack.study.loading import Study, load, parse, read_toml, results_folder
    from frictrack.study.reading_tables import TableData, read_frame, read_run_table, read_sensor_table, read_table
    from frictrack.study.schema import EffectTable, RunTable, suggest
    from frictrack.study.writing import TABLES, find_recordings, write_study

_MODULE_OF = {
    "EffectTable": "schema",
    "find_recordings": "writing",
    "load": "loading",
    "parse": "loading",
    "read_key": "editing",
    "read_frame": "reading_tables",
    "read_run_table": "reading_tables",
    "read_sensor_table": "reading_tables",
    "read_table": "reading_tables",
    "read_toml": "loading",
    "results_folder": "loading",
    "RunTable": "schema",
    "Study": "loading",
    "suggest": "schema",
    "TableData": "reading_tables",
    "TABLES": "writing",
    "with_effect": "editing",
    "with_key": "editing",
    "with_runs": "editing",
    "without_run": "editing",
    "write_study": "writing",
}

__all__ = [*_MODULE_OF]  # noqa: PLE0604 - they are strings
__getattr__ = lazy_names(__name__, _MODULE_OF)
