"""Export results to other tools: one function per format, and one table of formats.

    formats          the table: what each format holds, what it cannot hold, and the function that writes it; figures
    tables           the curves of a run with their units; curves, parameters and errors of a study as pandas tables
    data_files       CSV, Excel, Parquet, MATLAB, netCDF
    tracker_project  project of the video program Tracker, and its text

A further format is one function and one line of the table.
"""

# ruff: noqa: F401 - the imports are the interface

from frictrack.present.export.formats import FORMATS, ExportedFiles, ExportFormat, export_results, find_format, write
