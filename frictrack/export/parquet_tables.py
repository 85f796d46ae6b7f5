"""Export results as Parquet files, one per kind of table, which pandas, Polars, DuckDB and Spark read.

Curves of all runs are one table with a column `run`. The unit and the meaning of a column are in the metadata of its
Arrow field (`unit`, `description`); pandas finds the units in ``attrs["units"]``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from frictrack.errors import FrictrackError
from frictrack.export.columns import Column, all_columns, motion_columns, own_motion, track_columns, tracks_of
from frictrack.export.formats import ExportedFiles
from frictrack.export.tables import summary_tables
from frictrack.files import atomic_write, make_subfolder
from frictrack.results import Results

if TYPE_CHECKING:
    import pyarrow as pa

Rows = tuple[Mapping[str, str], list[Column]]  # constants of a part of the table, and its columns


def write_parquet(results: Results) -> ExportedFiles:
    """Write the tables into the folder `parquet`: curves, tracks, motion by the models, and the summaries."""
    try:
        import pyarrow as pa  # noqa: PLC0415 - optional
        import pyarrow.parquet as pq  # noqa: PLC0415
    except ImportError as e:
        raise FrictrackError("writing Parquet needs pyarrow; pip install frictrack[parquet]") from e
    made = {name: _joined(list(parts)) for name, parts in _parts(results).items()}
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


def _parts(results: Results) -> dict[str, Iterator[Rows]]:
    """Return the parts of the long tables: one per run, per run and target, and per model and run."""
    own = own_motion(results)
    tracks = (
        ({"run": run.name, "target": name}, track_columns(track))
        for run in results.runs
        for name, track in tracks_of(run).items()
    )
    motion = (({"model": m.name, "run": one.run}, motion_columns(one)) for m in results.models for one in m.motion)
    return {
        "curves": (({"run": run.name}, all_columns(run, own.get(run.name))) for run in results.runs),
        "tracks": tracks,
        "motion": motion,
    }


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
