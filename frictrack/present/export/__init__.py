"""Export results to other tools: the table of formats, what is written, how it is opened, and what is lost.

    tables           curves, parameters and errors as pandas tables with units; CSV, Excel, Parquet, MATLAB, netCDF
    tracker_project  project of the video program Tracker, and its text

A further format is one function and one line of the table.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from operator import methodcaller
from pathlib import Path
from typing import TYPE_CHECKING

from frictrack.base import imported
from frictrack.base.errors import UsageError
from frictrack.base.files import atomic_write, make_subfolder

if TYPE_CHECKING:
    from frictrack.results import Results


_DIAGNOSIS = "diagnosis and comparison of the models, which are in the report and in study.h5"
_PICTURES = "first frame of the film and picture of the target"
_SMOOTHER = "the smoother itself and its trade-off, which are in the HDF5 files"
_HASHES = "settings, versions and hashes of the inputs"
_NOT_IN_TABLES = (
    "tracks in pixels, standard deviations of the measured displacement, and sensors",
    "models that are not the current one, except their parameters and errors",
    *(_HASHES, _DIAGNOSIS, _SMOOTHER),
)
_NOT_IN_TRACKER = (
    "all standard deviations, because Tracker has none",
    "velocity, acceleration and friction force, because Tracker computes its own from the positions",
    "the track from the last frame to the first, which is a check",
    "angle of the target, match score, and why it was lost in a frame",
    f"models, settings, {_DIAGNOSIS}",
)
_NOT_IN_FIGURES = ("all that is not drawn: the figures and their CSV files show a part of the results",)


@dataclass(frozen=True)
class ExportedFiles:
    """The files that an exporter wrote.

    Attributes
    ----------
    files
        Their paths.
    lost
        What of these results the format could not hold, each as a phrase.

    """

    files: tuple[Path, ...]
    lost: tuple[str, ...] = ()


@dataclass(frozen=True)
class ExportFormat:
    """One format to which results can be exported.

    Attributes
    ----------
    holds
        The files, and what they hold.
    opened_by
        A call or program that opens them.
    writer
        Function that writes them, "module:name": it takes `Results` and returns `ExportedFiles`.
    lost
        What the format never holds, each as a phrase.

    """

    holds: str
    opened_by: str
    writer: str
    lost: tuple[str, ...] = ()


FORMATS = {
    "csv": ExportFormat(
        "a CSV file per run with its curves, and parameters, errors and error budgets; units in the headers",
        'pandas.read_csv("csv/v3.csv")',
        "frictrack.present.export.tables:write_csv",
        _NOT_IN_TABLES,
    ),
    "xlsx": ExportFormat(
        "the same as one Excel workbook, a sheet per table",
        'pandas.read_excel("study.xlsx", sheet_name="v3")',
        "frictrack.present.export.tables:write_xlsx",
        ("the 17th digit of numbers, which Excel does not store", *_NOT_IN_TABLES),
    ),
    "netcdf": ExportFormat(
        "one netCDF file: a group per run, track and model, with units and settings as attributes",
        'xarray.open_datatree("study.nc")',
        "frictrack.present.export.tables:write_netcdf",
        (_PICTURES, _SMOOTHER),
    ),
    "mat": ExportFormat(
        "one MATLAB file (version 5): a struct with arrays of runs and models, and their units",
        "load('study.mat')",
        "frictrack.present.export.tables:write_mat",
        (_PICTURES, _SMOOTHER),
    ),
    "parquet": ExportFormat(
        "a Parquet file per kind of table, with a column for the run; units in the metadata of the columns",
        "duckdb.sql(\"SELECT run, max(v) FROM 'parquet/curves.parquet' GROUP BY run\")",
        "frictrack.present.export.tables:write_parquet",
        (f"{_HASHES}, except the version of frictrack", _DIAGNOSIS, _PICTURES, _SMOOTHER),
    ),
    "trk": ExportFormat(
        "a project of the video program Tracker per film: the film, the scale and axes, and a point mass per target",
        "Tracker: File, Open",
        "frictrack.present.export.tracker_project:write_trk",
        _NOT_IN_TRACKER,
    ),
    "txt": ExportFormat(
        "a text per run as Tracker exports it: t in s, x and y in m; frictrack reads it as a table, too",
        "Tracker, or any program that reads columns",
        "frictrack.present.export.tracker_project:write_txt",
        _NOT_IN_TRACKER,
    ),
    "svg": ExportFormat(
        "every figure as SVG, and the plotted data as CSV",
        "Inkscape, or a browser",
        "frictrack.present.export:write_svg",
        _NOT_IN_FIGURES,
    ),
    "pdf": ExportFormat(
        "every figure as PDF, and the plotted data as CSV",
        "LaTeX: \\includegraphics{figures/history.pdf}",
        "frictrack.present.export:write_pdf",
        _NOT_IN_FIGURES,
    ),
}


def write_files(folder: Path, writers: Mapping[str, Callable[[Path], object]]) -> tuple[Path, ...]:
    """Write files, each completely or not at all; every writer gets the path to write to."""
    for name, write_content in writers.items():
        with atomic_write(folder / name) as part:
            write_content(part)
    return tuple(folder / name for name in writers)


def find_format(name: str) -> ExportFormat:
    """Return a format by its name.

    Parameters
    ----------
    name
        One of `FORMATS`.

    Raises
    ------
    FrictrackError
        If there is no such format.

    Examples
    --------
    >>> find_format("mat").opened_by
    "load('study.mat')"

    """
    if name not in FORMATS:
        raise UsageError(f"expected one of the formats {', '.join(FORMATS)} but got {name!r}")
    return FORMATS[name]


def export_results(results: Results, to: str) -> ExportedFiles:
    """Write the results of a study for another tool, and say what its format cannot hold.

    Parameters
    ----------
    results
        Results of a study; the files are written into its folder of results.
    to
        Name of a format; one of `frictrack.present.export.FORMATS`.

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
        Name of a format; one of `frictrack.present.export.FORMATS`.

    Returns
    -------
    list of Path
        The files.

    """
    return list(export_results(results, to).files)


NOT_IN_FILE_NAMES = re.compile(r'[<>:"/\\|?*]')  # of Windows; names of effects may have them


def write_svg(results: Results) -> ExportedFiles:
    """Write the figures as SVG, whose texts stay texts; the same results give the same bytes."""
    return _write(results, "svg")


def write_pdf(results: Results) -> ExportedFiles:
    """Write the figures as PDF; the same results give the same bytes."""
    return _write(results, "pdf")


def _write(results: Results, form: str) -> ExportedFiles:
    """Write every figure and its data into the folder `figures`."""
    from frictrack.present import plots  # noqa: PLC0415 - loads Matplotlib

    folder = make_subfolder(results.output, "figures")
    paths: list[Path] = []
    lost: tuple[str, ...] = ()
    for title, draw in plots.study_figures(results):
        name, figure = NOT_IN_FILE_NAMES.sub("_", title), draw()
        data, content = plots.plotted_data(figure), plots.file_content(figure, form)
        if any(ax.images for ax in figure.axes):
            lost = ("grey values of pictures, which a figure shows and its CSV file leaves out",)
        as_csv = partial(data.to_csv, index=False)
        paths += write_files(folder, {f"{name}.{form}": methodcaller("write_bytes", content), f"{name}.csv": as_csv})
    return ExportedFiles(tuple(paths), lost)
