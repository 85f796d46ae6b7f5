"""Export results to other tools: one module per format, and one table of formats.

    formats          the table: what each format holds, and what it cannot hold
    writing          write a study's results in one of them
    columns, tables  the curves of a run with their units; curves, parameters and errors of a study as tables
    text_tables      CSV
    workbook         Excel
    parquet_tables   Parquet
    netcdf_file      netCDF, for xarray
    matlab_file      MATLAB
    tracker_project  project of the video program Tracker, and its text
    figure_files     SVG and PDF of all figures, each with its data

A further format is one module and one line of the table.
"""

from frictrack.export.formats import FORMATS, ExportedFiles, ExportFormat, find_format
from frictrack.export.writing import export_results, write

__all__ = [
    "FORMATS",
    "ExportFormat",
    "ExportedFiles",
    "export_results",
    "find_format",
    "write",
]
