"""Curves, parameters, errors and error budgets of a study as pandas tables, and as CSV, Excel, Parquet, MATLAB, netCDF.

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
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from frictrack.base.errors import FrictrackError, needs_package
from frictrack.base.files import make_subfolder
from frictrack.present.export import ExportedFiles, write_files
from frictrack.records import ModelledMotion, Track
from frictrack.results import ModelResults, Results, RunResults, to_builtins

if TYPE_CHECKING:
    import pyarrow as pa
    import xarray as xr


SIGMA, MODEL = "sigma_", "_model"
MAX_TIME_DIFFERENCE_S = 1e-9  # between two records of the same frame
NOTHING: Mapping[str, str] = {}
MEANINGS = {
    "t": "time",
    "x_measured": "measured displacement along the course",
    "y_measured": "measured displacement across the course",
    "angle": "rotation of the target, counter-clockwise",
    "valid": "whether the frame was measured and is no outlier",
    "repaired": "0 as measured, 1 tracked again, 2 interpolated, 3 left out",
    "x": "smoothed displacement along the course",
    "v": "velocity",
    "a": "acceleration",
    "a_y": "acceleration across the course",
    "F": "friction force",
    "free": "whether the mass slides freely",
    "drive": "measured drive force",
    "a_sensor": "acceleration of the accelerometer",
    "friction_sensor": "measured friction force",
    "a_known": "acceleration of the accelerometer without gain and bias",
    "x_px": "position in the picture, to the right",
    "y_px": "position in the picture, downward",
    "angle_picture": "rotation of the target in the picture, clockwise",
    "score": "match score",
    "reason": "why the target was lost",
    "blow": "whether the frame belongs to an unresolved collision",
    "segment": "number of the segment",
}  # by name of a column without `SIGMA` and `MODEL`
_RENAMED_DISPLACEMENT = {name: f"{name}_measured" for name in ("x", "y", "sigma_x", "sigma_y")}
_RENAMED_SENSORS = {"a": "a_sensor", "friction_N": "friction_sensor", "known_a": "a_known"}
_RENAMED_TRACK = {"sigma_px": "sigma_x_px", "angle": "angle_picture", "sigma_angle": "sigma_angle_picture"}


@dataclass(frozen=True, eq=False)
class Column:
    """One column of a table.

    Attributes
    ----------
    name
        Its name, without unit.
    values
        One value per row, (n,).
    unit
        Unit of the values; empty for truth values and texts.

    """

    name: str
    values: NDArray[Any]
    unit: str

    @property
    def meaning(self) -> str:
        """What the column holds, in words."""
        return describe(self.name)


def describe(name: str) -> str:
    """Return what a column holds, in words.

    Examples
    --------
    >>> describe("sigma_v_model")
    'standard deviation of velocity by the current model'

    """
    bare = name.removeprefix(SIGMA).removesuffix(MODEL)
    by_model = " by the current model" if name.endswith(MODEL) else ""
    return ("standard deviation of " if name.startswith(SIGMA) else "") + MEANINGS[bare] + by_model


def curve_columns(run: RunResults, own: ModelledMotion | None) -> list[Column]:
    """Return time, displacement, motion and friction of one run, with the motion by the current model."""
    t = run.displacement.t
    found = [Column("t", t, "s"), Column("x_measured", run.displacement.x, "m")]
    for record in (run.motion, run.friction):
        found += _columns_of(record)
    if own is not None:
        rows = np.searchsorted(t, own.t - MAX_TIME_DIFFERENCE_S)
        for one in _columns_of(own):
            if one.unit:
                whole = np.full(len(t), np.nan)
                whole[rows] = one.values
                found.append(Column(one.name + MODEL, whole, one.unit))
    return _each_once(found)


def all_columns(run: RunResults, own: ModelledMotion | None) -> list[Column]:
    """Return all that is known of a run at the frames of its displacement: `curve_columns`, and how it was measured."""
    curves = curve_columns(run, own)
    measured = _columns_of(run.displacement, _RENAMED_DISPLACEMENT)
    return _each_once([curves[0], *measured, *_columns_of(run.sensors, _RENAMED_SENSORS), *curves[1:]])


def track_columns(track: Track) -> list[Column]:
    """Return time, position in the picture and quality of a target in every frame of the film."""
    return [Column("t", track.t, "s"), *_columns_of(track, _RENAMED_TRACK)]


def motion_columns(motion: ModelledMotion) -> list[Column]:
    """Return the motion of a run by one model, at the frames that were fitted or predicted."""
    return [Column("t", motion.t, "s"), *_columns_of(motion)]


def own_motion(results: Results) -> dict[str, ModelledMotion]:
    """Return the motion by the current model, by run."""
    return {motion.run: motion for motion in results.current.motion} if results.current else {}


def column_groups(results: Results) -> Iterator[tuple[str, dict[str, str], list[Column]]]:
    """Yield all columns of a study: their kind ("runs", "tracks" or "models"), what they belong to, and the columns."""
    own = own_motion(results)
    for run in results.runs:
        yield "runs", {"run": run.name}, all_columns(run, own.get(run.name))
        for name, track in run.all_tracks.items():
            yield "tracks", {"run": run.name, "target": name}, track_columns(track)
    for model in results.models:
        for one in model.motion:
            yield "models", {"model": model.name, "run": one.run}, motion_columns(one)


def run_attributes(run: RunResults) -> dict[str, Any]:
    """Return numbers and texts that describe a run; lists and dictionaries as JSON."""
    d = run.displacement
    found = {
        "run": run.name,
        "source": run.source,
        "role": run.role,
        "group": run.group,
        "mass_kg": run.mass,
        "cutoff_Hz": run.motion.cutoff,
        "guard_frames": run.motion.guard,
        "pixel_pitch_m": d.pixel_pitch,
        "relative_scale_error": d.relative_scale_error,
        "systematic_error_m": d.systematic,
        "resolution_m": d.resolution,
        "fps_Hz": run.film.fps if run.film else None,
        "film_sha256": run.film.hash if run.film else None,
        "free_section": run.friction.reason if run.friction else None,
        "events": as_json(run.events.events),
        "settings": as_json(run.settings),
        "stage_hashes": as_json(run.hashes),
        "notes": as_json(run.notes),
    }
    return {name: value for name, value in found.items() if value not in (None, "")}


def study_attributes(results: Results) -> dict[str, str]:
    """Return texts that describe a study."""
    about = {"title": results.name, "source": f"frictrack {results.version}", "study": results.path.name}
    about["notes"] = as_json([*results.notes, *results.warnings])
    return about | ({} if results.comparison is None else {"comparison": as_json(results.comparison)})


def model_attributes(model: ModelResults) -> dict[str, str]:
    """Return texts that describe a model: its equation and, if it was diagnosed, the diagnosis as JSON."""
    about = {"equation": model.equation}
    return about | ({} if model.diagnosis is None else {"diagnosis": as_json(model.diagnosis)})


def _columns_of(record: Any, renamed: Mapping[str, str] = NOTHING) -> Iterator[Column]:
    """Yield the columns of a record that were measured, without its time."""
    for f in fields(record) if record is not None else ():
        values = getattr(record, f.name)
        if f.metadata.get("column") and f.name != "t" and values is not None:
            yield Column(renamed.get(f.name, f.name), np.asarray(values), str(f.metadata["unit"]))


def _each_once(columns: Iterable[Column]) -> list[Column]:
    """Return columns without repeated names; the last one of a name is kept, at the place of the first."""
    return list({column.name: column for column in columns}.values())


def as_json(value: Any) -> str:
    """Return a value as JSON."""
    return json.dumps(to_builtins(value), ensure_ascii=False)


SUMMARIES = ("parameters", "errors", "budget")  # names of the tables of all runs together


def plain_tables(results: Results) -> dict[str, pd.DataFrame]:
    """Return the curves of every run with units in the headers, then the summaries, each by a name of its own."""
    own = own_motion(results)
    tables = {}
    for run in results.runs:
        columns = {_header(column): column.values for column in curve_columns(run, own.get(run.name))}
        tables[f"run {run.name}" if run.name in SUMMARIES else run.name] = pd.DataFrame(columns)
    return tables | summary_tables(results)


def summary_tables(results: Results) -> dict[str, pd.DataFrame]:
    """Return parameters and errors of all models, and the error budgets of the runs if there are any."""
    errors = pd.DataFrame([{"model": model.name, **model.summary["errors"]} for model in results.models])
    tables = {"parameters": parameters_table(results.models), "errors": errors}
    return tables | ({"budget": budget_table(results.runs)} if any(run.budget for run in results.runs) else {})


def _header(column: Column) -> str:
    """Return the header of a column, with its unit.

    Examples
    --------
    >>> import numpy as np
    >>> _header(Column("a", np.zeros(1), "m/s^2"))
    'a_ms2'

    """
    unit = re.sub(r"[/^]", "", column.unit)
    return f"{column.name}_{unit}" if unit else column.name


def parameters_table(models: Iterable[ModelResults]) -> pd.DataFrame:
    """Return the parameters of models, one row per model and parameter."""
    found = ((model.name, *item) for model in models for item in model.summary["parameters"].items())
    return pd.DataFrame([{"model": model, "parameter": name, **_flat(values)} for model, name, values in found])


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a parameter as cells: ``mu`` and ``mu_std``, ``interval_low`` and ``interval_high``."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= {key if part == "value" else f"{key}_{part}": one for part, one in value.items()}
        elif key == "interval":
            flat |= dict(zip(("interval_low", "interval_high"), value or (None, None), strict=True))
        else:
            flat[key] = value if isinstance(value, (str, int, float, type(None))) else json.dumps(value)
    return flat


def budget_table(runs: Iterable[RunResults]) -> pd.DataFrame:
    """Return every source of error of the friction force of runs; an empty cell is unknown."""
    return pd.DataFrame([{"run": run.name, **row} for run in runs for row in run.budget.get("rows", ())])


EMPTY = np.zeros((0, 0))  # MATLAB's [] for what is unknown


def write_mat(results: Results) -> ExportedFiles:
    """Write the file."""
    from scipy.io import savemat  # noqa: PLC0415 - slow to load
    from scipy.io.matlab import MatWriteError  # noqa: PLC0415

    own = own_motion(results)
    study = {
        **study_attributes(results),
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
    tracks = [{"name": name, **_columns(track_columns(track))} for name, track in run.all_tracks.items()]
    budget = _rows(budget_table([run]).drop(columns="run")) if run.budget.get("rows") else EMPTY
    about = {"attributes": run_attributes(run), "tracks": _array_of(tracks), "budget": budget}
    return {"name": run.name, **_columns(all_columns(run, own)), **about}


def _model(model: ModelResults) -> dict[str, Any]:
    """Return the struct of a model: its parameters, its errors, and the motion of each run."""
    table = parameters_table([model]).drop(columns="model").rename(columns={"parameter": "name"})
    return {
        "name": model.name,
        **model_attributes(model),
        "current": model.current,
        "parameters": _rows(table),
        "errors": {key: _known(value) for key, value in model.summary["errors"].items()},
        "motion": _array_of([{"run": one.run, **_columns(motion_columns(one))} for one in model.motion]),
    }


def _columns(columns: Iterable[Column]) -> dict[str, Any]:
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

    groups = {"/": _described(xr.Dataset(), {"Conventions": CONVENTIONS, **study_attributes(results)})}
    for kind, names, columns in column_groups(results):
        groups["/".join([kind, *names.values()])] = _dataset(columns)
    for run in results.runs:
        groups[f"runs/{run.name}"] = _described(groups[f"runs/{run.name}"], run_attributes(run))
        if run.budget.get("rows"):
            groups[f"budgets/{run.name}"] = _table_dataset(budget_table([run]).drop(columns="run"), "source")
    return groups | {f"models/{model.name}": _model_dataset(model) for model in results.models}


def _dataset(columns: Iterable[Column]) -> xr.Dataset:
    """Return columns over the time, each with its unit, its meaning, and the name of its standard deviation."""
    import xarray as xr  # noqa: PLC0415

    values = {column.name: column for column in columns}
    variables = {}
    for name, column in values.items():
        sigma = SIGMA + name if SIGMA + name in values else ""
        about = {"long_name": column.meaning, "units": column.unit, "ancillary_variables": sigma}
        variables[name] = ("t", column.values, {key: text for key, text in about.items() if text})
    return xr.Dataset(variables).set_coords("t")


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


# --- tables


def write_csv(results: Results) -> ExportedFiles:
    """Write CSV files into the folder `csv`."""
    writers = {f"{name}.csv": partial(table.to_csv, index=False) for name, table in plain_tables(results).items()}
    return ExportedFiles(write_files(make_subfolder(results.output, "csv"), writers))


MAX_SHEET_NAME, MAX_ROWS = 31, 1 << 20  # of Excel


def write_xlsx(results: Results) -> ExportedFiles:
    """Write the workbook."""
    pages = plain_tables(results)
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


Rows = tuple[Mapping[str, str], list[Column]]  # constants of a part of the table, and its columns


def write_parquet(results: Results) -> ExportedFiles:
    """Write the tables into the folder `parquet`: curves, tracks, motion by the models, and the summaries."""
    with needs_package("writing Parquet", "frictrack[parquet]"):
        import pyarrow as pa  # noqa: PLC0415 - optional
        import pyarrow.parquet as pq  # noqa: PLC0415
    parts: dict[str, list[Rows]] = {"curves": [], "tracks": [], "motion": []}
    for kind, names, columns in column_groups(results):
        parts[{"runs": "curves", "models": "motion"}.get(kind, kind)].append((names, columns))
    made = {name: _joined(rows) for name, rows in parts.items()}
    made |= {name: pa.Table.from_pandas(t, preserve_index=False) for name, t in summary_tables(results).items()}
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
