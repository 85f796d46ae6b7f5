"""Export every figure of a study as SVG or PDF, each with a CSV file of the data that it shows."""

from __future__ import annotations

import re

from frictrack.base.files import atomic_write, make_subfolder
from frictrack.present.export.formats import ExportedFiles
from frictrack.results import Results

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
    paths, has_pictures = [], False
    for title, draw in plots.study_figures(results):
        name, figure = NOT_IN_FILE_NAMES.sub("_", title), draw()
        data = plots.plotted_data(figure)
        has_pictures = has_pictures or any(ax.images for ax in figure.axes)
        content = plots.svg_file(figure).encode() if form == "svg" else plots.pdf(figure)
        for path, written in ((f"{name}.{form}", content), (f"{name}.csv", data.to_csv(index=False).encode())):
            with atomic_write(folder / path) as part:
                part.write_bytes(written)
            paths.append(folder / path)
    lost = ("grey values of pictures, which a figure shows and its CSV file leaves out",) if has_pictures else ()
    return ExportedFiles(tuple(paths), lost)
