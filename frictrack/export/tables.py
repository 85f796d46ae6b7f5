"""Curves, parameters, errors and error budgets of a study as pandas tables."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from frictrack.export.columns import Column, curve_columns, own_motion
from frictrack.results import ModelResults, Results, RunResults

if TYPE_CHECKING:
    import pandas as pd

SUMMARIES = ("parameters", "errors", "budget")


def plain_tables(results: Results) -> dict[str, pd.DataFrame]:
    """Return the curves of every run with units in the headers, then the summaries, by name of the table.

    Parameters
    ----------
    results
        Results of a study.

    """
    own = own_motion(results)
    tables = {_table_name(run.name): _with_units(curve_columns(run, own.get(run.name))) for run in results.runs}
    return tables | summary_tables(results)


def summary_tables(results: Results) -> dict[str, pd.DataFrame]:
    """Return parameters and errors of all models, and the error budgets of the runs if there are any."""
    tables = {"parameters": parameters_table(results.models), "errors": _errors_table(results)}
    return tables | ({"budget": budget_table(results.runs)} if any(run.budget for run in results.runs) else {})


def _table_name(name: str) -> str:
    """Return the name of a run's table, different from those of the other tables."""
    return f"run {name}" if name in SUMMARIES else name


def _with_units(columns: Iterable[Column]) -> pd.DataFrame:
    """Return the columns of one run, one row per frame, units in the headers."""
    import pandas as pd  # noqa: PLC0415 - slow to load

    return pd.DataFrame({_header(column): column.values for column in columns})


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
    import pandas as pd  # noqa: PLC0415

    rows = [
        {"model": model.name, "parameter": name, **_flat(values)}
        for model in models
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


def budget_table(runs: Iterable[RunResults]) -> pd.DataFrame:
    """Return every source of error of the friction force of runs; an empty cell is unknown."""
    import pandas as pd  # noqa: PLC0415

    return pd.DataFrame([{"run": run.name, **row} for run in runs for row in run.budget.get("rows", ())])
