"""Open files with tables: text, Excel, and the exports of the video programs Tracker and Kinovea.

Files in which video programs keep their tracks are opened by `frictrack.study.track_formats`.

Tracker (Open Source Physics) writes text: the name of the track, then the names of the columns (t in s; x and y in the
unit of its calibration, m unless it was changed), then the rows, separated by tabs, commas, semicolons or spaces;
several tracks share a table, with their names above the columns and ``#multi:`` in the first line. Source:
``ExportDataDialog.saveAsAction`` and ``TrackerIO.getData`` of github.com/OpenSourcePhysics/tracker.

Kinovea writes three forms. Source: ``Exporters/Spreadsheet`` and ``kva2msxml-en.xsl`` of github.com/Kinovea/Kinovea.

- text for gnuplot: ``#Kinovea Trajectory data export``, ``#T X Y``, one block of rows per trajectory;
- an XML spreadsheet: per trajectory a row ``Coords (x,y:cm; t:time)``, a row x, y, t, and the rows;
- CSV with the names ``Time``, ``Trajectory 1/0/X``, ``Trajectory 1/0/Y``, or ``Time (ms)``, ``X (cm)``, ``Y (cm)``.

Its times are numbers or time codes h:mm:ss:cc. Only the XML form and some CSV state the unit of length.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from frictrack.base.errors import FrictrackError
from frictrack.study import table_layout
from frictrack.study.column_names import guess_columns, may_hold, runs_of_columns
from frictrack.study.schema import COLUMNS
from frictrack.study.track_formats import find_track_format

MIN_ROWS_OF_RECORD, MAX_JUMP_STEPS = 16, 3.0  # of records below one another; usual steps, beyond which one begins
MIN_NUMBERS_SHARE = 0.5  # of the cells of a column that else holds a few words
GROUPED = re.compile(r"[+-]?\d{1,3}(?:([.,'’ \u00a0\u202f])\d{3})(?:\1\d{3})*(?:[.,]\d+)?")  # 1,234.5 or 1.234,5
MAX_COLUMNS, MAX_ROWS, MAX_SHEETS = 256, 1 << 20, 32  # of a sheet, which Excel ends at that row, and of a workbook
SHEET_XML = "{urn:schemas-microsoft-com:office:spreadsheet}"
_COORDINATES = re.compile(r"Coords \(x,y:\s*([^;]*?)\s*; *t:\s*([^)]*?)\s*\)")
_TRACKER_COLUMNS = {"t": "t (s)", "x": "x (m)", "y": "y (m)"}
_STANDARD_UNITS = {header: unit for header, unit in COLUMNS.values()}


def open_table(path: Path, wanted: Collection[str] = ()) -> table_layout.TableFile:
    """Open a table; several runs that it has side by side become its tracks.

    Parameters
    ----------
    path
        A text file (.csv, .txt, .tsv, .dat), an Excel workbook, an XML spreadsheet, or tracks of another program; see
        `frictrack.study.track_formats`.
    wanted
        Names that only stand in a header.

    Raises
    ------
    FrictrackError
        If it cannot be read as a table.

    """
    table = _open_table(path, wanted)
    table = table if table.tracks or table.columns else replace(table, frame=_stacked_records(table.frame))
    runs = [table_layout.TrackColumns(columns) for columns in runs_of_columns(list(map(str, table.frame.columns)))]
    return replace(table, tracks=runs, has_runs=True) if runs and not table.tracks else table


def _stacked_records(frame: pd.DataFrame) -> pd.DataFrame:
    """Return records below one another, of which each begins anew in time and place, as runs side by side."""
    names = guess_columns(list(map(str, frame.columns)))
    if not names.keys() >= set("tx"):
        return frame
    try:
        t, x = (pd.to_numeric(frame[names[key]], errors="coerce").to_numpy(float) for key in "tx")
    except OverflowError:  # a number beyond all numbers of the machine, of which the reader of rows tells the row
        return frame
    rows = np.flatnonzero(np.isfinite(t) & np.isfinite(x))  # titles may stand between the records
    end, t, x = len(t), t[rows], x[rows]
    steps, moved = np.diff(t), np.abs(np.diff(x))
    starts = np.flatnonzero(steps < 0) + 1
    ends = [0, *rows[starts].tolist(), end]
    if len(ends) < 3 or np.min(np.diff(ends)) < MIN_ROWS_OF_RECORD:
        return frame
    far = MAX_JUMP_STEPS * np.fmax(moved[starts - 2], moved[starts])  # a clock that rolls over leaves the place
    if np.any(moved[starts - 1] <= far) or np.any(t[starts] - t[0] > MAX_JUMP_STEPS * np.median(steps[steps > 0])):
        return frame
    parts = [frame.iloc[a:b].reset_index(drop=True) for a, b in pairwise(ends)]
    return pd.concat([part.add_prefix(f"Run {i}: ") for i, part in enumerate(parts, 1)], axis=1)


def _open_table(path: Path, wanted: Collection[str]) -> table_layout.TableFile:
    """Open a table, whatever program wrote it."""
    expected = "a table with a header line"
    try:
        if path.is_file() and path.stat().st_size == 0:
            raise ValueError("the file is empty")
        if (tracks := find_track_format(path)) is not None:
            expected = f"tracks of {tracks.programs}"
            if path.is_file() and path.suffix.lower() != ".trz":  # which may hold the film
                table_layout.check_size(path)
            with np.errstate(all="ignore"):  # a number that is too large is refused with its row
                return tracks.read(path)
        if path.is_dir():
            raise ValueError("a folder without solutions of DICe")
        if path.suffix.lower() in (".xlsx", ".xls", ".xml"):
            table_layout.check_size(path)
        if path.suffix.lower() in (".xlsx", ".xls"):
            return _table_of_sheets(_workbook_sheets(path), wanted)
        if path.suffix.lower() == ".xml":
            root = table_layout.read_xml(path.read_bytes())  # of Excel 2003
            rows = [tuple(data.text for data in row.iter(f"{SHEET_XML}Data")) for row in root.iter(f"{SHEET_XML}Row")]
            return _table_of_rows([row for row in rows if any(row)], wanted)
        return _text_table(path, wanted)
    except ImportError as e:
        extra = {"openpyxl": "xlsx", "nptdms": "tdms"}.get(str(e.name), "xlsx")
        raise FrictrackError(f"{path.name}: reading it needs {e.name}; pip install frictrack[{extra}]") from e
    except Exception as e:  # damaged parts make the readers fail in many ways
        reason = str(e).splitlines()[0] if str(e) else type(e).__name__
        reason = "it holds no text in any known encoding" if isinstance(e, UnicodeError) else reason
        raise FrictrackError(f"{path.name}: expected {expected} but cannot read it ({reason})") from e


def _text_table(path: Path, wanted: Collection[str]) -> table_layout.TableFile:
    layout = table_layout.find_layout(path, wanted)
    header = layout.header
    with path.open(encoding=layout.encoding) as file:  # pandas would cut a line at a # within it
        skipped = {*layout.skipped, *(i for i, line in enumerate(file) if line.startswith("#"))}
    how: dict[str, Any] = {"sep": layout.separator, "decimal": layout.decimal, "encoding": layout.encoding}
    if layout.in_comment:
        how["header"] = None
    elif header and all(table_layout.is_number(name) for name in header if name):
        header, how["header"] = tuple(f"column {i + 1}" for i in range(len(header))), None
    how |= {"skiprows": sorted(skipped), "skipinitialspace": True}
    try:
        frame = _named(pd.read_csv(path, **how))
        if written := _numbers_in_texts(frame, layout.decimal):
            frame = _named(pd.read_csv(path, **how, **written))
    except pd.errors.ParserError as e:
        found = re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", str(e))
        words = "expected {0} cells in line {1} but got {2}; take out lines that are no rows" if found else str(e)
        raise ValueError(words.format(*(found.groups() if found else ()))) from e
    names = _column_names(header, layout.units, layout.groups)[: len(frame.columns)]
    if "header" in how or layout.units or layout.groups:
        frame.columns = [*names, *map(str, frame.columns[len(names) :])]
    names = list(map(str, frame.columns))
    if len({group for group in layout.groups if group}) == 1 and names[:1] == ["t"] and "x" in names:
        columns = {key: header for key, header in _TRACKER_COLUMNS.items() if key in names}
        return table_layout.TableFile(frame, columns, "Tracker")  # a frame that was not marked has no position
    return table_layout.TableFile(frame, above=layout.above)


def _numbers_in_texts(frame: pd.DataFrame, decimal: str) -> dict[str, Any]:
    """Return how else to read columns of numbers that pandas took for texts: words for gaps, thousands separators."""
    texts = [column.dropna().astype(str) for _, column in frame.items() if column.dtype.kind not in "fiub"]
    numeric = [text for text in texts if text.str.contains(r"\d").mean() > MIN_NUMBERS_SHARE]
    words = {  # a force that is "off" is no gap
        text.name: sorted(text[~text.str.contains(r"\d")].unique())
        for text in numeric
        if may_hold(str(text.name), "x") or may_hold(str(text.name), "t")
    }
    groups = {g[1] for text in numeric for cell in text if (g := GROUPED.fullmatch(cell)) and g[1] != decimal}
    how: dict[str, Any] = {"na_values": words} if any(words.values()) else {}
    return how | ({"thousands": groups.pop()} if len(groups) == 1 else {})


def _column_names(header: Sequence[str], units: Sequence[str], groups: Sequence[str]) -> list[str]:
    """Return the names of columns with their units; a name that occurs twice with the name of its group."""
    names = []
    for i, name in enumerate(header):
        unit = table_layout.bare_unit(units[i]) if i < len(units) else ""
        group = groups[i] if header.count(name) > 1 and i < len(groups) else ""
        shown = f" ({unit})" if unit and _STANDARD_UNITS.get(name) != unit else ""
        names.append(f"{group} {name}".strip() + shown)
    return names


def _table_of_sheets(sheets: dict[str, list[tuple[Any, ...]]], wanted: Collection[str]) -> table_layout.TableFile:
    """Return the table of the first sheet; of several with times and positions all, side by side."""
    read = {name: _table_of_rows(rows, wanted) for name, rows in sheets.items() if rows}
    runs = {name: one.frame for name, one in read.items() if guess_columns(list(one.frame.columns)).keys() >= set("tx")}
    if len(runs) > 1:
        cells = {f"{name}: {header}": values for name, frame in runs.items() for header, values in frame.items()}
        return table_layout.TableFile(pd.DataFrame(cells))
    return next((read[name] for name in runs or read), None) or _table_of_rows([], wanted)


def _table_of_rows(rows: list[tuple[Any, ...]], wanted: Collection[str]) -> table_layout.TableFile:
    """Return the table among the rows of a sheet; titles may stand above it, and further tables below it."""
    if not rows:
        raise ValueError("no rows")
    width = max(i for row in rows for i, cell in enumerate(row, 1) if cell is not None)
    rows = [row[:width] for row in rows]
    texts = [tuple("" if cell is None else str(cell).strip() for cell in row) for row in rows]
    at = table_layout.header_row(texts, wanted)
    header = texts[at]
    below = texts[at + 1] if at + 1 < len(texts) and table_layout.is_units_row(header, texts[at + 1]) else ()
    data = rows[at + 2 if below else at + 1 :]
    if at:  # a sheet with titles may hold further tables
        data = list(takewhile(lambda row: any(table_layout.is_number(str(cell)) for cell in row), data))
    names = [*_column_names(header, below, ()), *[""] * (max(map(len, rows)) - len(header))]
    if table_layout.decimal_sign((cell for row in data for cell in row if isinstance(cell, str)), ",") == ",":
        data = [tuple(cell.replace(",", ".") if isinstance(cell, str) else cell for cell in row) for row in data]
    frame = pd.DataFrame([(*row, *[None] * (len(names) - len(row))) for row in data], columns=names)
    coordinates = next((found for row in texts[:at] for cell in row if (found := _COORDINATES.match(cell))), None)
    if coordinates is not None:
        return _kinovea_sheet(frame, texts, *coordinates.groups())
    return table_layout.TableFile(frame, above="\n".join(" ".join(row) for row in texts[:at]))


def _kinovea_sheet(frame: pd.DataFrame, texts: list[tuple[str, ...]], length: str, time: str) -> table_layout.TableFile:
    """Return the table of the one trajectory in a spreadsheet of Kinovea, with the units that it states."""
    count = sum(bool(_COORDINATES.match(cell)) for row in texts for cell in row)
    if count > 1:
        raise ValueError(f"it holds {count} trajectories; export one trajectory per file")
    if time == "timestamps":
        raise ValueError("its times are time stamps of the file; export them as time in Kinovea")
    columns = {key: f"{key} ({length})" for key in ("x", "y")}
    return table_layout.TableFile(frame, {"t": "t (s)"} | columns, "Kinovea")


def _workbook_sheets(path: Path) -> dict[str, list[tuple[Any, ...]]]:
    """Return the rows of the sheets of a workbook that have content."""
    import openpyxl  # noqa: PLC0415 - optional

    with path.open("rb") as file:
        sheets = openpyxl.load_workbook(file, read_only=True, data_only=True).worksheets[:MAX_SHEETS]
        return {sheet.title: list(_filled(sheet)) for sheet in sheets}


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
