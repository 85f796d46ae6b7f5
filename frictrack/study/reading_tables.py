"""Read tables of measurements (CSV or Excel) as columns in SI units, and check them."""

from __future__ import annotations

import itertools
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from frictrack.errors import FrictrackError, raise_faults
from frictrack.records import GRAVITY, Array
from frictrack.remote import local_path
from frictrack.study.schema import COLUMNS, SENSOR_COLUMNS, RunTable, suggest
from frictrack.units import parse_quantity

if TYPE_CHECKING:
    import pandas as pd

UNIT = re.compile(r"[(\[]\s*([^()\[\]]+?)\s*[)\]]\s*$")  # "pos (mm)", "Position [mm]"
FRACTION = re.compile(r'"?[+-]?\d*([.,])\d+(?:[eE][+-]?\d+)?"?$')  # a number with a decimal sign
MAX_UNPACKED_BYTES = 256 << 20  # of a workbook
MAX_VALUE = 1e12  # in SI units, far beyond any measurement of sliding
MIN_INTERVAL_S = 1e-9  # between rows
MAX_REPEATED_SHARE = 0.9  # of the time stamps that may repeat the one before
MIN_ROWS_FOR_REPEATS = 16  # rows from which time stamps may repeat
MAX_COLUMNS, MAX_ROWS = 256, 1 << 20  # of a sheet; Excel ends at that row
NO_COLUMNS: Mapping[str, str] = {}


@dataclass(frozen=True, eq=False)
class TableData:
    """The columns of a table in SI units, each of shape (n,); None for a column that is not there.

    Attributes
    ----------
    t
        Time, s.
    x, y
        Position along and across the course, m.
    sigma
        Standard deviation of x, m.
    drive, friction
        Drive force and friction force, N.
    a
        Acceleration, m/s^2.
    pressure
        Pressure of a drive, Pa.

    """

    t: Array
    x: Array | None = None
    sigma: Array | None = None
    y: Array | None = None
    drive: Array | None = None
    a: Array | None = None
    friction: Array | None = None
    pressure: Array | None = None


def read_table(path: Path, columns: Mapping[str, str] = NO_COLUMNS) -> TableData:
    """Read the table of a run: columns t_s and x_m, and sigma_m, y_m, drive_N, a_m_s2, friction_N if they are there.

    Parameters
    ----------
    path
        A CSV or Excel file with one header line.
    columns
        Other headers by short name: ``{"t": "Time (ms)", "friction": "-F (uN)"}``. The unit stands in parentheses (SI
        without them); a leading minus flips the sign.

    Returns
    -------
    TableData
        The columns in SI units.

    Raises
    ------
    FrictrackError
        With all faults: a column is missing, a value is not a number, time does not rise, fewer than two rows.

    """
    return TableData(**_read(_frame(path), path.name, columns, ("t", "x")))


def read_run_table(run: RunTable) -> TableData:
    """Read the table of a run; see `read_table`.

    Parameters
    ----------
    run
        The ``[[run]]``, with a table.

    """
    assert run.table is not None
    return read_table(local_path(run.table), run.columns)


def read_frame(frame: pd.DataFrame, columns: Mapping[str, str] = NO_COLUMNS, name: str = "table") -> TableData:
    """Take the columns of a run from a pandas DataFrame; see `read_table`.

    Parameters
    ----------
    frame
        One row per sample.
    columns
        Other headers by short name.
    name
        Name of the table in messages.

    """
    return TableData(**_read(frame.copy(deep=False), name, columns, ("t", "x")))


def read_sensor_table(path: Path, wanted: Sequence[str], columns: Mapping[str, str] = NO_COLUMNS) -> TableData:
    """Read the table of a sensor with its own clock.

    Parameters
    ----------
    path
        A CSV or Excel file with one header line and a column t_s.
    wanted
        Short names of columns ("a", "friction", "drive", "pressure"), of which at least one must be there.
    columns
        Other headers by short name, as for `read_table`. An acceleration may be in units of gravity: ``"a (g)"``.

    Returns
    -------
    TableData
        The columns in SI units; an empty cell is NaN.

    Raises
    ------
    FrictrackError
        With all faults.

    """
    known = {key: SENSOR_COLUMNS[key] for key in ("t", *wanted)}
    values = _read(_frame(path), path.name, columns, ("t",), known)
    if len(values) == 1:
        headers = " or ".join(SENSOR_COLUMNS[name][0] for name in wanted)
        raise FrictrackError(
            f"{path.name}: expected a column {headers} in addition to t_s but got none; "
            f'name it with {{table = "{path.name}", columns = {{{wanted[0]} = "..."}}}}'
        )
    return TableData(**values)


def _read(
    frame: pd.DataFrame,
    table: str,
    columns: Mapping[str, str],
    required: Sequence[str],
    known: Mapping[str, tuple[str, str]] = COLUMNS,
) -> dict[str, Array]:
    """Read the columns of `known` that are there; empty cells are allowed in columns that are not required."""
    present = [str(header).strip() for header in frame.columns]
    frame.columns = present
    faults: list[str] = []
    values: dict[str, Any] = {}
    for name, (standard, unit) in known.items():
        header, sign = _header(columns.get(name, standard), present)
        if present.count(header) > 1:
            faults.append(f'expected one column "{header}" but got {present.count(header)}')
        elif header in present:
            gaps = known is not COLUMNS and name not in required
            values[name], found = _column(frame[header], sign * _factor(header, standard, unit), gaps=gaps)
            faults += found
        elif name in required or name in columns:
            faults.append(f'expected a column "{header}" but got {", ".join(present)}; {_hint(header, present)}')
    if not faults:
        faults += _time_faults(values["t"])
        if "sigma" in values and not np.all(values["sigma"] > 0):
            faults.append(f"expected standard deviations above 0 but got {np.min(values['sigma']):g} m")
    raise_faults(faults, table)
    return values


def _hint(header: str, present: list[str]) -> str:
    return f'{suggest(header, present)} Map it with columns = {{t = "Time (ms)", x = "pos (mm)"}}'


def _header(written: str, present: list[str]) -> tuple[str, float]:
    """Return the header without its sign, and the sign."""
    if written.startswith("-") and written not in present:
        return written[1:].strip(), -1.0
    return written, 1.0


def _factor(header: str, standard: str, unit: str) -> float:
    """Return the size of the column's unit in SI units."""
    named = UNIT.search(header)
    if named and header != standard and (named[1], unit) == ("g", "m/s^2"):
        return GRAVITY
    return parse_quantity(f"1 {named[1]}", unit, header)[0] if named and header != standard else 1.0


def _column(series: pd.Series[Any], factor: float, *, gaps: bool = False) -> tuple[Array, list[str]]:
    import pandas as pd  # noqa: PLC0415 - takes half a second, which `--help` does not need

    with np.errstate(over="ignore"):
        try:
            numbers = pd.to_numeric(series, errors="coerce")
        except OverflowError:  # a whole number of more than 308 digits; written as text it is infinite
            numbers = pd.to_numeric(series.astype(str), errors="coerce")
        values = factor * np.asarray(numbers, dtype=float)
    bad = np.flatnonzero(~(np.abs(values) < MAX_VALUE) & ~(series.isna().to_numpy() & gaps))
    if len(bad) == 0:
        return values, []
    value = series.iloc[int(bad[0])]
    more = f" and {len(bad) - 1} more" if len(bad) > 1 else ""
    expected = f"expected numbers below {MAX_VALUE:g} (SI)" if np.isfinite(values[bad[0]]) else "expected numbers"
    return values, [f'{expected} in "{series.name}" but got {str(value)[:40]} in row {bad[0] + 1}{more}']


def _time_faults(t: Array) -> list[str]:
    if len(t) < 2:
        return [f"expected at least two rows but got {len(t)}"]
    steps = np.diff(t)
    repeated = np.sum(steps == 0) <= MAX_REPEATED_SHARE * len(steps)  # the clock is read less often than rows come
    back = np.flatnonzero((steps < 0) if repeated and len(t) >= MIN_ROWS_FOR_REPEATS else (steps <= 0))
    if len(back):
        i = int(back[0])
        return [f"expected rising time but got {t[i + 1]:g} s after {t[i]:g} s in row {i + 2}"]
    if (step := float(np.median(steps[steps > 0]))) < MIN_INTERVAL_S:
        return [f"expected rows {MIN_INTERVAL_S:g} s apart or more but got {step:g} s; check the unit of the time"]
    return []


def _frame(path: Path) -> pd.DataFrame:
    import pandas as pd  # noqa: PLC0415

    try:
        if path.suffix.lower() in (".xlsx", ".xls"):
            return _sheet(path)
        return _named(pd.read_csv(path, comment="#", encoding="utf-8-sig", **_dialect(path)))
    except ImportError as e:
        raise FrictrackError(f"{path.name}: reading Excel needs openpyxl; pip install frictrack[xlsx]") from e
    except (OSError, ValueError, KeyError) as e:  # ValueError covers pandas' parser and Unicode errors
        reason = str(e).splitlines()[0] if str(e) else type(e).__name__
        raise FrictrackError(f"{path.name}: expected a table with a header line but cannot read it ({reason})") from e


def _sheet(path: Path) -> pd.DataFrame:
    """Read the first sheet of a workbook; its first row with content is the header."""
    import openpyxl  # noqa: PLC0415 - optional
    import pandas as pd  # noqa: PLC0415

    try:
        with zipfile.ZipFile(path) as packed:
            unpacked = sum(part.file_size for part in packed.infolist())
        if unpacked > MAX_UNPACKED_BYTES:
            raise ValueError(f"{unpacked / 1e6:.0f} MB when unpacked")
        with path.open("rb") as file:
            rows = list(_filled(openpyxl.load_workbook(file, read_only=True, data_only=True).worksheets[0]))
    except OSError:
        raise
    except Exception as e:  # damaged parts make openpyxl fail in many ways
        raise ValueError(str(e) or type(e).__name__) from e
    if not rows:
        raise ValueError("no rows")
    return pd.DataFrame(rows[1:], columns=["" if head is None else str(head) for head in rows[0]])


def _filled(sheet: Any) -> Iterator[tuple[Any, ...]]:
    """Yield the rows with content; the sheet itself may declare any number of rows."""
    sheet.reset_dimensions()
    for i, row in enumerate(sheet.iter_rows(max_col=MAX_COLUMNS, values_only=True)):
        if i == MAX_ROWS:
            raise ValueError(f"more than {MAX_ROWS} rows")
        if any(cell is not None for cell in row):
            yield row


def _named(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the columns under their own names; pandas takes the first fields for labels if rows have too many.

    A separator at the end of every row is ignored. Raises `ValueError` if the further fields have content.
    """
    import pandas as pd  # noqa: PLC0415

    if isinstance(frame.index, pd.RangeIndex):
        return frame
    names = frame.columns
    whole = frame.reset_index()
    filled = np.flatnonzero(whole.iloc[:, len(names) :].notna().any(axis=1))
    if len(filled):
        got = int(whole.iloc[int(filled[0])].notna().to_numpy().nonzero()[0][-1]) + 1
        hint = "name every column; decimal commas need a semicolon between the columns"
        raise ValueError(f"{len(names)} names in the header but {got} fields in row {filled[0] + 1}; {hint}")
    return whole.iloc[:, : len(names)].set_axis(names, axis=1)


def _dialect(path: Path) -> dict[str, Any]:
    """Find separator and decimal sign from the first lines that show them."""
    with path.open(encoding="utf-8-sig") as file:
        lines = (line for line in file if line.strip() and not line.startswith("#"))
        head = list(itertools.islice(lines, 3))
        separator = _separator(head)
        cells = (cell.strip() for line in itertools.chain(head[1:], lines) for cell in line.split(separator))
        decimal = "." if separator == "," else next((sign[1] for cell in cells if (sign := FRACTION.match(cell))), ".")
    return {"sep": separator, "decimal": decimal}


def _separator(head: Sequence[str]) -> str:
    """Return the character that stands equally often in the header and in the rows, and most often."""
    counts = {sign: [line.count(sign) for line in head] for sign in "\t;,"}
    return max(counts, key=lambda sign: (len(set(counts[sign])) == 1 and counts[sign][0] > 0, sum(counts[sign][:1])))
