"""Export results as CSV, Excel, Parquet, MATLAB version 5, or netCDF after the CF conventions.

    study = load('study.mat').study;
    plot(study.runs(1).t, study.runs(1).v)      % study.runs(1).units.v is 'm/s'

Curves of all runs are one Parquet table with a column `run`. The unit and the meaning of a column are in the metadata
of its Arrow field (`unit`, `description`); pandas finds the units in ``attrs["units"]``.

Groups of netCDF: ``runs/<run>`` (all that is known at the frames of the displacement), ``tracks/<run>/<target>``
(positions in the picture), ``budgets/<run>``, ``models/<model>`` (parameters) and ``models/<model>/<run>`` (motion by
the model). Lists and dictionaries are texts in JSON.

References
----------
MathWorks: MAT-File Format, level 5. Names of fields have at most 63 characters.
CF Conventions 1.11, https://cfconventions.org: `units`, `long_name`, `ancillary_variables` for standard deviations.

"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from frictrack.base.errors import FrictrackError, needs_package
from frictrack.base.files import make_subfolder
from frictrack.present.export import tables
from frictrack.present.export.formats import ExportedFiles, write_files
from frictrack.results import ModelResults, Results, RunResults

if TYPE_CHECKING:
    import pyarrow as pa
    import xarray as xr


EMPTY = np.zeros((0, 0))  # MATLAB's [] for what is unknown


def write_mat(results: Results) -> ExportedFiles:
    """Write the file."""
    from scipy.io import savemat  # noqa: PLC0415 - slow to load
    from scipy.io.matlab import MatWriteError  # noqa: PLC0415

    own = tables.own_motion(results)
    study = {
        **tables.study_attributes(results),
        "version": results.version,
        "runs": _array_of([_run(run, own.get(run.name)) for run in results.runs]),
        "models": _array_of([_model(model) for model in results.models]),
    }
    how: dict[str, Any] = {"long_field_names": True, "do_compression": True, "oned_as": "column"}
    writer = partial(savemat, mdict={"study": study}, **how)
    try:
        return ExportedFiles(write_files(results.output, {f"{results.path.stem}.mat": writer}))
    except MatWriteError as e:
        raise FrictrackError(f"MATLAB's format cannot hold these results ({e}); export --to netcdf") from e


def _run(run: RunResults, own: Any) -> dict[str, Any]:
    """Return the struct of a run: its columns, their units, its description and its tracks."""
    tracks = [{"name": name, **_columns(tables.track_columns(track))} for name, track in run.all_tracks.items()]
    budget = _rows(tables.budget_table([run]).drop(columns="run")) if run.budget.get("rows") else EMPTY
    about = {"attributes": tables.run_attributes(run), "tracks": _array_of(tracks), "budget": budget}
    return {"name": run.name, **_columns(tables.all_columns(run, own)), **about}


def _model(model: ModelResults) -> dict[str, Any]:
    """Return the struct of a model: its parameters, its errors, and the motion of each run."""
    table = tables.parameters_table([model]).drop(columns="model").rename(columns={"parameter": "name"})
    return {
        "name": model.name,
        **tables.model_attributes(model),
        "current": model.current,
        "parameters": _rows(table),
        "errors": {key: _known(value) for key, value in model.summary["errors"].items()},
        "motion": _array_of([{"run": one.run, **_columns(tables.motion_columns(one))} for one in model.motion]),
    }


def _columns(columns: Iterable[tables.Column]) -> dict[str, Any]:
    """Return columns as fields, texts as cells, and the struct of their units."""
    columns = list(columns)
    values = {c.name: c.values.astype(object) if c.values.dtype.kind == "U" else c.values for c in columns}
    return {**values, "units": {c.name: c.unit for c in columns}}


def _array_of(structs: Sequence[Mapping[str, Any]]) -> Any:
    """Return structs as one array of structs, which needs the same fields in all; missing ones are empty."""
    if not structs:
        return EMPTY
    names = list(dict.fromkeys(name for struct in structs for name in struct))
    array = np.empty((1, len(structs)), dtype=[(name, object) for name in names])
    for i, struct in enumerate(structs):
        array[0, i] = tuple(struct.get(name, EMPTY) for name in names)
    return array


def _rows(table: pd.DataFrame) -> Any:
    """Return the rows of a table as an array of structs."""
    return _array_of([{str(k): _known(value) for k, value in row.items()} for row in table.to_dict("records")])


def _known(value: Any) -> Any:
    """Return a cell of a table; empty if it is unknown."""
    return EMPTY if value is None or value != value else value  # noqa: PLR0124 - NaN differs from itself


CONVENTIONS = "CF-1.11"
MAX_ATTRIBUTE_CHARACTERS = 16_000  # HDF5 keeps an attribute below 64 kB; a longer text becomes a variable


def write_netcdf(results: Results) -> ExportedFiles:
    """Write the file."""
    with needs_package("writing netCDF", "frictrack[xarray]"):
        import h5netcdf  # noqa: F401, PLC0415 - optional; xarray loads it
        import xarray as xr  # noqa: PLC0415
    writer = partial(xr.DataTree.from_dict(_groups(results)).to_netcdf, engine="h5netcdf")
    return ExportedFiles(write_files(results.output, {f"{results.path.stem}.nc": writer}))


def _groups(results: Results) -> dict[str, xr.Dataset]:
    """Return the datasets by the names of their groups."""
    import xarray as xr  # noqa: PLC0415

    groups = {"/": _described(xr.Dataset(), {"Conventions": CONVENTIONS, **tables.study_attributes(results)})}
    for kind, names, columns in tables.column_groups(results):
        groups["/".join([kind, *names.values()])] = _dataset(columns)
    for run in results.runs:
        groups[f"runs/{run.name}"] = _described(groups[f"runs/{run.name}"], tables.run_attributes(run))
        if run.budget.get("rows"):
            groups[f"budgets/{run.name}"] = _table_dataset(tables.budget_table([run]).drop(columns="run"), "source")
    return groups | {f"models/{model.name}": _model_dataset(model) for model in results.models}


def _dataset(columns: Iterable[tables.Column]) -> xr.Dataset:
    """Return columns over the time, each with its unit, its meaning, and the name of its standard deviation."""
    import xarray as xr  # noqa: PLC0415

    values = {column.name: column for column in columns}
    variables = {}
    for name, column in values.items():
        sigma = tables.SIGMA + name if tables.SIGMA + name in values else ""
        about = {"long_name": column.meaning, "units": column.unit, "ancillary_variables": sigma}
        variables[name] = ("t", column.values, {key: text for key, text in about.items() if text})
    return xr.Dataset(variables).set_coords("t")


def _model_dataset(model: ModelResults) -> xr.Dataset:
    """Return the parameters of a model; its equation and its errors are attributes."""
    errors = {name: value for name, value in model.summary["errors"].items() if value is not None}
    parameters = _table_dataset(tables.parameters_table([model]).drop(columns="model"), "parameter")
    return _described(parameters, {"current": int(model.current), **errors, **tables.model_attributes(model)})


def _table_dataset(table: pd.DataFrame, index: str) -> xr.Dataset:
    """Return a table over the texts of one of its columns."""
    import xarray as xr  # noqa: PLC0415

    variables = {str(name): (index, _values(table[name])) for name in table if name != index}
    return xr.Dataset(variables, coords={index: table[index].to_numpy(dtype=str)})


def _described(dataset: xr.Dataset, attributes: dict[str, Any]) -> xr.Dataset:
    """Return a dataset with attributes; a long text becomes a variable without dimension."""
    long = {k: v for k, v in attributes.items() if isinstance(v, str) and len(v) > MAX_ATTRIBUTE_CHARACTERS}
    return dataset.assign_attrs({k: v for k, v in attributes.items() if k not in long}).assign(long)


def _values(cells: pd.Series[Any]) -> Any:
    """Return cells as an array of one type: truth values, numbers with NaN, or texts with "" for what is unknown."""
    if cells.dtype == bool:
        return cells.to_numpy()
    is_number = cells.dropna().map(lambda cell: isinstance(cell, int | float)).all()
    if is_number and cells.notna().any():
        return cells.to_numpy(dtype=np.float64, na_value=np.nan)
    return cells.fillna("").astype(str).to_numpy(dtype=str)


# --- tables


def write_csv(results: Results) -> ExportedFiles:
    """Write CSV files into the folder `csv`."""
    writers = {
        f"{name}.csv": partial(table.to_csv, index=False) for name, table in tables.plain_tables(results).items()
    }
    return ExportedFiles(write_files(make_subfolder(results.output, "csv"), writers))


MAX_SHEET_NAME, MAX_ROWS = 31, 1 << 20  # of Excel


def write_xlsx(results: Results) -> ExportedFiles:
    """Write the workbook."""
    pages = tables.plain_tables(results)
    sheets = sheet_names(pages)
    if long := [name for name, table in pages.items() if len(table) >= MAX_ROWS]:
        raise FrictrackError(
            f'expected tables of less than {MAX_ROWS} rows but "{long[0]}" has {len(pages[long[0]])}, which Excel '
            "cannot hold; export --to parquet"
        )

    def write_book(part: Path) -> None:
        with pd.ExcelWriter(part, engine="openpyxl") as book:
            for name, table in pages.items():
                table.to_excel(book, sheet_name=sheets[name], index=False)

    with needs_package("writing Excel", "frictrack[xlsx]"):
        paths = write_files(results.output, {f"{results.path.stem}.xlsx": write_book})
    shortened = tuple(f'name of the sheet "{name}", shortened to "{s}"' for name, s in sheets.items() if s != name)
    return ExportedFiles(paths, shortened)


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


Rows = tuple[Mapping[str, str], list[tables.Column]]  # constants of a part of the table, and its columns


def write_parquet(results: Results) -> ExportedFiles:
    """Write the tables into the folder `parquet`: curves, tracks, motion by the models, and the summaries."""
    with needs_package("writing Parquet", "frictrack[parquet]"):
        import pyarrow as pa  # noqa: PLC0415 - optional
        import pyarrow.parquet as pq  # noqa: PLC0415
    parts: dict[str, list[Rows]] = {"curves": [], "tracks": [], "motion": []}
    for kind, names, columns in tables.column_groups(results):
        parts[{"runs": "curves", "models": "motion"}.get(kind, kind)].append((names, columns))
    made = {name: _joined(rows) for name, rows in parts.items()}
    made |= {name: pa.Table.from_pandas(t, preserve_index=False) for name, t in tables.summary_tables(results).items()}
    about = {"frictrack_version": results.version, "study": results.name}
    writers = {}
    for name, table in made.items():
        if table.num_rows:
            described = table.replace_schema_metadata({**(table.schema.metadata or {}), **about})
            writers[f"{name}.parquet"] = partial(pq.write_table, described)
    return ExportedFiles(write_files(make_subfolder(results.output, "parquet"), writers))


def _joined(parts: list[Rows]) -> pa.Table:
    """Return one table of all parts; what a part lacks is null. Unit and meaning are in the metadata of the fields."""
    import pyarrow as pa  # noqa: PLC0415

    joinable = [
        pa.table({name: pa.repeat(value, len(columns[0].values)) for name, value in constants.items()}
                 | {column.name: pa.array(column.values) for column in columns})
        for constants, columns in parts
    ]  # fmt: skip
    joined = pa.concat_tables(joinable, promote_options="permissive") if joinable else pa.table({})
    about = {c.name: {"unit": c.unit, "description": c.meaning} for _, columns in parts for c in columns}
    fields = [f.with_metadata(about[f.name]) if f.name in about else f for f in joined.schema]
    units = {f.name: about[f.name]["unit"] for f in fields if f.name in about}
    return joined.cast(pa.schema(fields, metadata={"PANDAS_ATTRS": json.dumps({"units": units})}))
