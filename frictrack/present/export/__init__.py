"""Export results to other tools: one function per format, and one table of formats.

    formats          the table: what each format holds, what it cannot hold, and the function that writes it
    tables           the curves of a run with their units; curves, parameters and errors of a study as pandas tables
    table_files      CSV, Excel, Parquet
    netcdf_file      netCDF, for xarray
    matlab_file      MATLAB
    tracker_project  project of the video program Tracker, and its text
    figure_files     SVG and PDF of all figures, each with its data

A further format is one function and one line of the table.
"""

from frictrack.present.export.formats import FORMATS, ExportedFiles, ExportFormat, export_results, find_format, write

__all__ = [
    "FORMATS",
    "ExportFormat",
    "ExportedFiles",
    "export_results",
    "find_format",
    "write",
]
