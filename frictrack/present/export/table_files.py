"""Export tables as CSV files, as one Excel workbook, and as Parquet files for pandas, Polars, DuckDB and Spark.

Curves of all runs are one Parquet table with a column `run`. The unit and the meaning of a column are in the metadata
of its Arrow field (`unit`, `description`); pandas finds the units in ``attrs["units"]``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from frictrack.base.errors import FrictrackError
from frictrack.base.files import atomic_write, make_subfolder
from frictrack.present.export.formats import ExportedFiles
from frictrack.present.export.tables import (
    Column,
    column_groups,
    plain_tables,
    summary_tables,
)
from frictrack.results import Results

if TYPE_CHECKING:
    import pyarrow as pa


def write_csv(results: Results) -> ExportedFiles:
    """Write CSV files into the folder `csv`."""
    folder = make_subfolder(results.output, "csv")
    paths = []
    for name, table in plain_tables(results).items():
        paths.append(folder / f"{name}.csv")
        with atomic_write(paths[-1]) as part:
            table.to_csv(part, index=False)
    return ExportedFiles(tuple(paths))


MAX_SHEET_NAME, MAX_ROWS = 31, 1 << 20  # of Excel


def write_xlsx(results: Results) -> ExportedFiles:
    """Write the workbook."""
    import pandas as pd  # noqa: PLC0415 - slow to load

    tables, path = plain_tables(results), results.output / f"{results.path.stem}.xlsx"
    long = [name for name, table in tables.items() if len(table) >= MAX_ROWS]
    if long:
        raise FrictrackError(
            f'expected tables of less than {MAX_ROWS} rows but "{long[0]}" has {len(tables[long[0]])}, which Excel '
            "cannot hold; export --to parquet"
        )
    sheets = sheet_names(tables)
    try:
        with atomic_write(path) as part, pd.ExcelWriter(part, engine="openpyxl") as book:
            for name, table in tables.items():
                table.to_excel(book, sheet_name=sheets[name], index=False)
    except ImportError as e:
        raise FrictrackError("writing Excel needs openpyxl; pip install frictrack[xlsx]") from e
    shortened = tuple(f'name of the sheet "{name}", shortened to "{s}"' for name, s in sheets.items() if s != name)
    return ExportedFiles((path,), shortened)


def sheet_names(names: Iterable[str]) -> dict[str, str]:
    """Return names that Excel allows for sheets: short enough, and different also without upper case.

    Examples
    --------
    >>> sheet_names(["a", "A", "x" * 40])["A"]
    'A (2)'

    """
    sheets: dict[str, str] = {}
    used: set[str] = set()
    for name in names:
        sheet, number = name[:MAX_SHEET_NAME], 1
        while sheet.lower() in used:
            number += 1
            end = f" ({number})"
            sheet = name[: MAX_SHEET_NAME - len(end)] + end
        used.add(sheet.lower())
        sheets[name] = sheet
    return sheets


Rows = tuple[Mapping[str, str], list[Column]]  # constants of a part of the table, and its columns


def write_parquet(results: Results) -> ExportedFiles:
    """Write the tables into the folder `parquet`: curves, tracks, motion by the models, and the summaries."""
    try:
        import pyarrow as pa  # noqa: PLC0415 - optional
        import pyarrow.parquet as pq  # noqa: PLC0415
    except ImportError as e:
        raise FrictrackError("writing Parquet needs pyarrow; pip install frictrack[parquet]") from e
    parts: dict[str, list[Rows]] = {"curves": [], "tracks": [], "motion": []}
    for kind, names, columns in column_groups(results):
        parts[{"runs": "curves", "models": "motion"}.get(kind, kind)].append((names, columns))
    made = {name: _joined(rows) for name, rows in parts.items()}
    made |= {name: pa.Table.from_pandas(t, preserve_index=False) for name, t in summary_tables(results).items()}
    folder = make_subfolder(results.output, "parquet")
    about = {"frictrack_version": results.version, "study": results.name}
    paths = []
    for name, table in made.items():
        if table.num_rows:
            paths.append(folder / f"{name}.parquet")
            with atomic_write(paths[-1]) as part:
                pq.write_table(table.replace_schema_metadata({**(table.schema.metadata or {}), **about}), part)
    return ExportedFiles(tuple(paths))


def _joined(parts: list[Rows]) -> pa.Table:
    """Return one table of all parts; what a part lacks is null."""
    import pyarrow as pa  # noqa: PLC0415

    tables = [_table(constants, columns) for constants, columns in parts]
    joined = pa.concat_tables(tables, promote_options="permissive") if tables else pa.table({})
    units = {f.name: f.metadata[b"unit"].decode() for f in joined.schema if f.metadata}
    return joined.replace_schema_metadata({"PANDAS_ATTRS": json.dumps({"units": units})})


def _table(constants: Mapping[str, str], columns: list[Column]) -> pa.Table:
    """Return one part of a table; unit and meaning stand in the metadata of the fields."""
    import pyarrow as pa  # noqa: PLC0415

    n = len(columns[0].values)
    arrays: list[Any] = [pa.repeat(value, n) for value in constants.values()]
    arrays += [pa.array(column.values) for column in columns]
    described = [(c.name, {"unit": c.unit, "description": c.meaning}) for c in columns]
    names = [*((name, None) for name in constants), *described]
    schema = pa.schema([pa.field(name, a.type, metadata=about) for (name, about), a in zip(names, arrays, strict=True)])
    return pa.Table.from_arrays(arrays, schema=schema)
