"""Export results as CSV files: one per run, and one each for parameters, errors and error budgets."""

from __future__ import annotations

from frictrack.export.formats import ExportedFiles
from frictrack.export.tables import plain_tables
from frictrack.files import atomic_write, make_subfolder
from frictrack.results import Results


def write_csv(results: Results) -> ExportedFiles:
    """Write CSV files into the folder `csv`."""
    folder = make_subfolder(results.output, "csv")
    paths = []
    for name, table in plain_tables(results).items():
        paths.append(folder / f"{name}.csv")
        with atomic_write(paths[-1]) as part:
            table.to_csv(part, index=False)
    return ExportedFiles(tuple(paths))
