"""Runs that come as tables: CSV or Excel -> columns in SI units, checked at the border."""

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
from frictrack.study.schema import COLUMNS, SENSOR_COLUMNS, suggest
from frictrack.units import parse_quantity

if TYPE_CHECKING:
    import pandas as pd

UNIT = re.compile(r"[(\[]\s*([^()\[\]]+?)\s*[)\]]\s*$")  # "pos (mm)", "Position [mm]"
FRACTION = re.compile(r'"?[+-]?\d*([.,])\d+(?:[eE][+-]?\d+)?"?$')  # a number that shows its decimal sign
MAX_UNPACKED_BYTES = 256 << 20  # bytes of a workbook
MAX_VALUE = 1e12  # SI units: beyond anything that slides
MIN_INTERVAL_S = 1e-9  # s between rows
MAX_REPEATED_SHARE = 0.9  # of the time stamps that may repeat the one before
MIN_ROWS_FOR_REPEATS = 16  # rows from which time stamps may repeat
MAX_COLUMNS, MAX_ROWS = 256, 1 << 20  # of a sheet; Excel ends at that row
NO_COLUMNS: Mapping[str, str] = {}


@dataclass(frozen=True, eq=False)
class TableData:
    """The columns of a table in SI units, each of shape (n,); None for one that is not there."""

    t: Array
    x: Array | None = None
    sigma: Array | None = None
    y: Array | None = None
    drive: Array | None = None
    a: Array | None = None
    friction: Array | None = None
    pressure: Array | None = None


def read_table(path: Path, columns: Mapping[str, str] = NO_COLUMNS) -> TableData:
    """Read a run: columns t_s and x_m, and of sigma_m, y_m, drive_N, a_m_s2, friction_N those that are there.

    `columns` names other headers: ``{"t": "Time (ms)", "friction": "-F (uN)"}``; the unit is read from the
    parentheses (SI without), a leading minus flips the sign. Raises `FrictrackError` that lists all faults:
    a missing column, a value that is no number, time that does not rise, fewer than two rows.
    """
    return TableData(**_read(path, columns, ("t", "x"), COLUMNS))


def read_sensor_table(path: Path, wanted: Sequence[str], columns: Mapping[str, str] = NO_COLUMNS) -> TableData:
    """Read a sensor with its own clock: t_s and at least one of the `wanted` columns.

    `columns` names other headers as for `read_table`, with "pressure" (pressure_Pa) beside; an acceleration may be in
    units of gravity, "a (g)". An empty cell is a sample that was not taken: NaN.
    """
    values = _read(path, columns, ("t",), {key: SENSOR_COLUMNS[key] for key in ("t", *wanted)})
    if len(values) == 1:
        headers = " or ".join(SENSOR_COLUMNS[name][0] for name in wanted)
        raise FrictrackError(
            f"{path.name}: expected a column {headers} beside t_s but got none; "
            f'name it with {{table = "{path.name}", columns = {{{wanted[0]} = "..."}}}}'
        )
    return TableData(**values)


def _read(
    path: Path, columns: Mapping[str, str], required: Sequence[str], known: Mapping[str, tuple[str, str]]
) -> dict[str, Array]:
    """The columns that are there of those `known`; empty cells are allowed in what is not required."""
    frame = _frame(path)
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
    raise_faults(faults, path.name)
    return values


def _hint(header: str, present: list[str]) -> str:
    return f'{suggest(header, present)} Map it with columns = {{t = "Time (ms)", x = "pos (mm)"}}'


def _header(written: str, present: list[str]) -> tuple[str, float]:
    """The header that is meant, and its sign."""
    if written.startswith("-") and written not in present:
        return written[1:].strip(), -1.0
    return written, 1.0


def _factor(header: str, standard: str, unit: str) -> float:
    """SI units per unit of the column."""
    named = UNIT.search(header)
    if named and header != standard and (named[1], unit) == ("g", "m/s^2"):
        return GRAVITY
    return parse_quantity(f"1 {named[1]}", unit, header)[0] if named and header != standard else 1.0


def _column(series: pd.Series[Any], factor: float, *, gaps: bool = False) -> tuple[Array, list[str]]:
    import pandas as pd  # noqa: PLC0415 - half a second that `--help` need not wait for

    with np.errstate(over="ignore"):
        try:
            numbers = pd.to_numeric(series, errors="coerce")
        except OverflowError:  # a whole number of more than 308 digits; written as text it is infinite
            numbers = pd.to_numeric(series.astype(str), errors="coerce")
        values = factor * np.asarray(numbers, dtype=float)
    bad = np.flatnonzero(~(np.abs(values) < MAX_VALUE) & ~(series.isna().to_numpy() & gaps))
    if len(bad) == 0:
        return values, []
    came = series.iloc[int(bad[0])]
    more = f" and {len(bad) - 1} more" if len(bad) > 1 else ""
    said = f"expected numbers below {MAX_VALUE:g} (SI)" if np.isfinite(values[bad[0]]) else "expected numbers"
    return values, [f'{said} in "{series.name}" but got {str(came)[:40]} in row {bad[0] + 1}{more}']


def _time_faults(t: Array) -> list[str]:
    if len(t) < 2:
        return [f"expected at least two rows but got {len(t)}"]
    steps = np.diff(t)
    repeated = np.sum(steps == 0) <= MAX_REPEATED_SHARE * len(
        steps
    )  # a clock that is read too seldom; rows go on all the same
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
    """The first sheet of a workbook: its filled rows, the first of them the header."""
    import openpyxl  # noqa: PLC0415 - not everybody has it
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
    """Rows in which something stands; the sheet itself may claim any number of them."""
    sheet.reset_dimensions()
    for i, row in enumerate(sheet.iter_rows(max_col=MAX_COLUMNS, values_only=True)):
        if i == MAX_ROWS:
            raise ValueError(f"more than {MAX_ROWS} rows")
        if any(cell is not None for cell in row):
            yield row


def _named(frame: pd.DataFrame) -> pd.DataFrame:
    """The columns under their own names: of rows with more fields than names pandas takes the first for labels.

    A separator at the end of every row is left out. Raises `ValueError` where the further fields hold something.
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
    """Separator and decimal sign: as the first lines show them, where none of the two could be the other."""
    with path.open(encoding="utf-8-sig") as file:
        lines = (line for line in file if line.strip() and not line.startswith("#"))
        head = list(itertools.islice(lines, 3))
        separator = _separator(head)
        cells = (cell.strip() for line in itertools.chain(head[1:], lines) for cell in line.split(separator))
        decimal = "." if separator == "," else next((sign[1] for cell in cells if (sign := FRACTION.match(cell))), ".")
    return {"sep": separator, "decimal": decimal}


def _separator(head: Sequence[str]) -> str:
    """What stands as often in the header as in the rows below it, and most often."""
    counts = {sign: [line.count(sign) for line in head] for sign in "\t;,"}
    return max(counts, key=lambda sign: (len(set(counts[sign])) == 1 and counts[sign][0] > 0, sum(counts[sign][:1])))
