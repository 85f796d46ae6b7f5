"""Export results as one MATLAB file of version 5, which MATLAB, Octave and SciPy load.

    study = load('study.mat').study;
    plot(study.runs(1).t, study.runs(1).v)      % study.runs(1).units.v is 'm/s'

References
----------
MathWorks: MAT-File Format, level 5. Names of fields have at most 63 characters.

"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack.base.errors import FrictrackError
from frictrack.base.files import atomic_write
from frictrack.present.export.formats import ExportedFiles
from frictrack.present.export.tables import (
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
from frictrack.results import ModelResults, Results, RunResults

if TYPE_CHECKING:
    import pandas as pd

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
    path = results.output / f"{results.path.stem}.mat"
    try:
        with atomic_write(path) as part:
            savemat(part, {"study": study}, long_field_names=True, do_compression=True, oned_as="column")
    except MatWriteError as e:
        raise FrictrackError(f"MATLAB's format cannot hold these results ({e}); export --to netcdf") from e
    return ExportedFiles((path,))


def _run(run: RunResults, own: Any) -> dict[str, Any]:
    """Return the struct of a run: its columns, their units, its description and its tracks."""
    tracks = [{"name": name, **_columns(track_columns(track))} for name, track in tracks_of(run).items()]
    return {
        "name": run.name,
        **_columns(all_columns(run, own)),
        "attributes": run_attributes(run),
        "tracks": _array_of(tracks),
        "budget": _rows(budget_table([run]).drop(columns="run")) if run.budget.get("rows") else EMPTY,
    }


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
