"""Write the table of a batch: one row per run, as CSV and, if pyarrow is installed, as Parquet."""

from __future__ import annotations

from collections.abc import Sequence
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


def write_table(rows: Sequence[dict[str, Any]], stem: Path) -> list[Path]:
    """Write ``stem.csv`` and, if pyarrow is installed, ``stem.parquet``.

    Parameters
    ----------
    rows
        One dictionary per run.
    stem
        Path without suffix.

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
            table.to_parquet(part, index=False, engine="pyarrow")
    return paths
