"""Write the table of a batch: one row per run, as CSV and, if pyarrow is installed, as Parquet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from frictrack.files import atomic_write

if TYPE_CHECKING:
    import pandas as pd

FIRST_COLUMNS = ("study", "run", "role", "verdict", "missing", "reason", "model", "domain")


def make_table(rows: Sequence[dict[str, Any]]) -> pd.DataFrame:
    """Return the rows as a table; missing values are empty."""
    import pandas as pd  # noqa: PLC0415 - slow to load

    names = list(dict.fromkeys([*FIRST_COLUMNS, *(name for row in rows for name in row)]))
    table = pd.DataFrame(list(rows), columns=names)
    for name in FIRST_COLUMNS:
        table[name] = table[name].astype("string")
    return table


def write_table(rows: Sequence[dict[str, Any]], stem: Path, units: Mapping[str, str]) -> list[Path]:
    """Write ``stem.csv`` and, if pyarrow is installed, ``stem.parquet``, where the fields of parameters have a `unit`.

    Parameters
    ----------
    rows
        One dictionary per run.
    stem
        Path without suffix.
    units
        Units of the parameters.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    FrictrackError
        If a file cannot be written.

    """
    table = make_table(rows)
    paths = [stem.with_name(f"{stem.name}.csv")]
    with atomic_write(paths[0]) as part:
        table.to_csv(part, index=False)
    if find_spec("pyarrow") is not None:
        paths.append(stem.with_name(f"{stem.name}.parquet"))
        with atomic_write(paths[1]) as part:
            _write_parquet(table, part, units)
    return paths


def _write_parquet(table: pd.DataFrame, path: Path, units: Mapping[str, str]) -> None:
    import pyarrow as pa  # noqa: PLC0415 - optional
    import pyarrow.parquet  # noqa: PLC0415

    whole = pa.Table.from_pandas(table, preserve_index=False)
    known = {f"{name}{kind}": unit for name, unit in units.items() for kind in ("", " std", " std_misfit")}
    fields = [one.with_metadata({"unit": known[one.name]}) if one.name in known else one for one in whole.schema]
    pa.parquet.write_table(whole.cast(pa.schema(fields, whole.schema.metadata)), path)
