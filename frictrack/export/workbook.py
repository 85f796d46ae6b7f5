"""Export results as one Excel workbook with a sheet per table."""

from __future__ import annotations

from collections.abc import Iterable

from frictrack.errors import FrictrackError
from frictrack.export.formats import ExportedFiles
from frictrack.export.tables import plain_tables
from frictrack.files import atomic_write
from frictrack.results import Results

MAX_SHEET_NAME, MAX_ROWS = 31, 1 << 20  # of Excel


def write_xlsx(results: Results) -> ExportedFiles:
    """Write the workbook."""
    import pandas as pd  # noqa: PLC0415 - slow to load

    tables, path = plain_tables(results), results.output / f"{results.path.stem}.xlsx"
    long = [name for name, table in tables.items() if len(table) >= MAX_ROWS]
    if long:
        raise FrictrackError(
            f'expected tables of less than {MAX_ROWS} rows but "{long[0]}" has {len(tables[long[0]])}, which Excel '
            "cannot hold; export --to parquet"
        )
    sheets = sheet_names(tables)
    try:
        with atomic_write(path) as part, pd.ExcelWriter(part, engine="openpyxl") as book:
            for name, table in tables.items():
                table.to_excel(book, sheet_name=sheets[name], index=False)
    except ImportError as e:
        raise FrictrackError("writing Excel needs openpyxl; pip install frictrack[xlsx]") from e
    shortened = tuple(f'name of the sheet "{name}", shortened to "{s}"' for name, s in sheets.items() if s != name)
    return ExportedFiles((path,), shortened)


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
