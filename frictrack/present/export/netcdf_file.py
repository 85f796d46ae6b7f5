"""Export results as one netCDF file, after the CF conventions as far as they know such quantities.

Groups: ``runs/<run>`` (all that is known at the frames of the displacement), ``tracks/<run>/<target>`` (positions in
the picture), ``budgets/<run>`` (sources of error of the friction force), ``models/<model>`` (parameters) and
``models/<model>/<run>`` (motion by the model). Lists and dictionaries are texts in JSON.

References
----------
CF Conventions 1.11, https://cfconventions.org: `units`, `long_name`, `ancillary_variables` for standard deviations.

"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.base.files import atomic_write
from frictrack.present.export.formats import ExportedFiles
from frictrack.present.export.tables import (
    SIGMA,
    Column,
    all_columns,
    budget_table,
    model_attributes,
    motion_columns,
    own_motion,
    parameters_table,
    run_attributes,
    study_attributes,
    track_columns,
    tracks_of,
)
from frictrack.results import ModelResults, Results

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

CONVENTIONS = "CF-1.11"
MAX_ATTRIBUTE_CHARACTERS = 16_000  # HDF5 keeps an attribute below 64 kB; a longer text becomes a variable


def write_netcdf(results: Results) -> ExportedFiles:
    """Write the file."""
    try:
        import h5netcdf  # noqa: F401, PLC0415 - optional; xarray loads it
        import xarray as xr  # noqa: PLC0415
    except ImportError as e:
        raise FrictrackError(f"writing netCDF needs {e.name}; pip install frictrack[xarray]") from e
    tree = xr.DataTree.from_dict(_groups(results))
    path = results.output / f"{results.path.stem}.nc"
    with atomic_write(path) as part:
        tree.to_netcdf(part, engine="h5netcdf")
    return ExportedFiles((path,))


def _groups(results: Results) -> dict[str, xr.Dataset]:
    """Return the datasets by the names of their groups."""
    import xarray as xr  # noqa: PLC0415

    own = own_motion(results)
    groups = {"/": _described(xr.Dataset(), {"Conventions": CONVENTIONS, **study_attributes(results)})}
    for run in results.runs:
        columns = all_columns(run, own.get(run.name))
        groups[f"runs/{run.name}"] = _dataset(columns, run_attributes(run))
        if run.budget.get("rows"):
            groups[f"budgets/{run.name}"] = _table_dataset(budget_table([run]).drop(columns="run"), "source")
        groups |= {
            f"tracks/{run.name}/{name}": _dataset(track_columns(track), {}) for name, track in tracks_of(run).items()
        }
    for model in results.models:
        groups[f"models/{model.name}"] = _model_dataset(model)
        groups |= {f"models/{model.name}/{one.run}": _dataset(motion_columns(one), {}) for one in model.motion}
    return groups


def _dataset(columns: Iterable[Column], attributes: dict[str, Any]) -> xr.Dataset:
    """Return columns over the time, each with its unit, its meaning, and the name of its standard deviation."""
    import xarray as xr  # noqa: PLC0415

    columns = list(columns)
    names = {column.name for column in columns}
    variables = {}
    for column in columns:
        about = {"long_name": column.meaning} | ({"units": column.unit} if column.unit else {})
        if SIGMA + column.name in names:
            about["ancillary_variables"] = SIGMA + column.name
        variables[column.name] = ("t", column.values, about)
    return _described(xr.Dataset(variables).set_coords("t"), attributes)


def _model_dataset(model: ModelResults) -> xr.Dataset:
    """Return the parameters of a model; its equation and its errors are attributes."""
    errors = {name: value for name, value in model.summary["errors"].items() if value is not None}
    parameters = _table_dataset(parameters_table([model]).drop(columns="model"), "parameter")
    return _described(parameters, {"current": int(model.current), **errors, **model_attributes(model)})


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
