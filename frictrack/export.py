"""Export results as plain tables: CSV files, or one Excel workbook."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import Field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from frictrack.errors import FrictrackError
from frictrack.files import atomic_write, make_subfolder
from frictrack.records import ModelledMotion
from frictrack.results import Results, RunResults

if TYPE_CHECKING:
    import pandas as pd


def write(results: Results, to: Literal["csv", "xlsx"]) -> list[Path]:
    """Write the curves and error budget of every run, and the parameters and errors of all models.

    Parameters
    ----------
    results
        Results of a study; the tables are written into its folder of results.
    to
        "csv" for one file per table, "xlsx" for one workbook.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    FrictrackError
        If openpyxl is needed but not installed, or the folder cannot be written.

    """
    own = {motion.run: motion for motion in results.current.motion} if results.current else {}
    tables = {_table_name(run.name): _curves_table(run, own.get(run.name)) for run in results.runs}
    tables |= {"parameters": _parameters_table(results), "errors": _errors_table(results)}
    if any(run.budget for run in results.runs):
        tables["budget"] = _budget_table(results)
    if to == "csv":
        folder = make_subfolder(results.output, "csv")
        paths = [folder / f"{name}.csv" for name in tables]
        for path, table in zip(paths, tables.values(), strict=True):
            with atomic_write(path) as part:
                table.to_csv(part, index=False)
        return paths
    return [_write_workbook(tables, results.output / f"{results.path.stem}.xlsx")]


def _write_workbook(tables: dict[str, pd.DataFrame], path: Path) -> Path:
    import pandas as pd  # noqa: PLC0415 - slow to load

    try:
        with atomic_write(path) as part, pd.ExcelWriter(part, engine="openpyxl") as book:
            for name, table in tables.items():
                table.to_excel(book, sheet_name=name[:31], index=False)
    except ImportError as e:
        raise FrictrackError("writing Excel needs openpyxl; pip install frictrack[xlsx]") from e
    return path


def _table_name(name: str) -> str:
    """Return the name of a run's table, different from those of the other tables."""
    return f"run {name}" if name in ("parameters", "errors", "budget") else name


def _curves_table(run: RunResults, own: ModelledMotion | None) -> pd.DataFrame:
    """Return displacement, motion and friction of one run, with the motion by the current model.

    One row per frame, units in the headers; frames that were not fitted have no motion by the model.
    """
    import pandas as pd  # noqa: PLC0415

    columns: dict[str, Any] = {"t_s": run.displacement.t, "x_measured_m": run.displacement.x}
    for record in (run.motion, run.friction):
        for f in fields(record) if record is not None else ():
            if f.metadata.get("column") and f.name != "t" and getattr(record, f.name) is not None:
                columns[_column_name(f.name, f)] = getattr(record, f.name)
    table = pd.DataFrame(columns)
    if own is not None:
        rows = np.searchsorted(run.displacement.t, own.t - 1e-9)
        for f in fields(own):
            if f.metadata.get("unit") and f.name != "t":
                table.loc[rows, _column_name(f"{f.name}_model", f)] = getattr(own, f.name)
    return table


def _column_name(name: str, field: Field[Any]) -> str:
    """Return the header of a column, with its unit."""
    unit = re.sub(r"[/^]", "", field.metadata["unit"])
    return f"{name}_{unit}" if unit else name


def _parameters_table(results: Results) -> pd.DataFrame:
    """Return the parameters of all models."""
    import pandas as pd  # noqa: PLC0415

    rows = [
        {"model": model.name, "parameter": name, **_flat(values)}
        for model in results.models
        for name, values in model.summary["parameters"].items()
    ]
    return pd.DataFrame(rows)


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


def _errors_table(results: Results) -> pd.DataFrame:
    """Return the errors of all models."""
    import pandas as pd  # noqa: PLC0415

    return pd.DataFrame([{"model": model.name, **model.summary["errors"]} for model in results.models])


def _budget_table(results: Results) -> pd.DataFrame:
    """Return every source of error of every run's friction force; an empty cell is unknown."""
    import pandas as pd  # noqa: PLC0415

    return pd.DataFrame([{"run": run.name, **row} for run in results.runs for row in run.budget.get("rows", ())])
