"""Write the results of a study in one of the formats."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from frictrack.export.formats import ExportedFiles, find_format
from frictrack.lazy import imported

if TYPE_CHECKING:
    from frictrack.results import Results


def export_results(results: Results, to: str) -> ExportedFiles:
    """Write the results of a study for another tool, and say what its format cannot hold.

    Parameters
    ----------
    results
        Results of a study; the files are written into its folder of results.
    to
        Name of a format; one of `frictrack.export.FORMATS`.

    Returns
    -------
    ExportedFiles
        The files, and what was lost.

    Raises
    ------
    FrictrackError
        If the format is unknown, if its library is not installed, or if the results cannot be written.

    """
    found = find_format(to)
    written: ExportedFiles = imported(found.writer)(results)
    return ExportedFiles(written.files, tuple(dict.fromkeys((*found.lost, *written.lost))))


def write(results: Results, to: str) -> list[Path]:
    """Write the results of a study for another tool; see `export_results`.

    Parameters
    ----------
    results
        Results of a study; the files are written into its folder of results.
    to
        Name of a format; one of `frictrack.export.FORMATS`.

    Returns
    -------
    list of Path
        The files.

    """
    return list(export_results(results, to).files)
