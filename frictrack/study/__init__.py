"""Read, check, edit and write study files, and read tables of measurements.

A study file (TOML) says what was filmed, what is known of it, and which model is fitted first.

    loading          study.toml -> `Study`, with every fault in one error
    schema           the keys of a study file, with types and units
    writing          a new study file from recordings; change one key of a study file, comments are kept
    reading_tables   tables -> columns in SI units
    table_files      text, Excel, exports of Tracker and Kinovea -> cells; `table_layout` finds header and units
    track_formats    tracks in the own files of Tracker, Kinovea, DeepLabCut, movement, SLEAP, DICe, pyidi -> cells
    column_names     names of columns: exact, with a unit, or proposed
"""

# ruff: noqa: F401 - the imports are for type checkers; at run time the names are imported on first use

from typing import TYPE_CHECKING

from frictrack.base import lazy_names

if TYPE_CHECKING:
    from frictrack.study import writing
    from frictrack.study.column_names import (
        base_name,
        columns_line,
        find_header,
        guess_points,
        has_units,
        may_hold,
        stated_unit,
        unnamed_force,
    )
    from frictrack.study.loading import Study, load, name_of_table, parse, read_toml, results_folder
    from frictrack.study.reading_tables import (
        ANGLE_NOTE,
        TableData,
        propose_columns,
        read_frame,
        read_points,
        read_run_table,
        read_sensor_table,
        read_table,
        unrolled_clock,
    )
    from frictrack.study.schema import (
        COLUMNS,
        POINT_COLUMNS,
        EffectTable,
        RunTable,
        needs_film,
        read_frame_rate,
    )
    from frictrack.study.table_files import open_table
    from frictrack.study.table_layout import TableFile, stated
    from frictrack.study.writing import FILMS, TABLES, find_recordings, is_table, list_files, with_key, write_study

__getattr__, __all__ = lazy_names(__name__)
