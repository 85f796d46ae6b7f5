"""The files that the page offers for download: report, tables, HDF5 files, a script that repeats the study, figures."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import IO, TYPE_CHECKING, Any

from frictrack.base.errors import FrictrackError
from frictrack.workbench.errors import MissingError, OutdatedError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from frictrack.results import Results
    from frictrack.study import Study

DOWNLOADS = ("report.html", "report.pdf", "tables.zip", "hdf5.zip", "repeat.py", "figures.zip")
FIGURE_FORMATS = ("svg", "png", "pdf")
MEMORY_BYTES = 20_000_000  # of a file that is made; a larger one goes to the disk
CONTENT_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".pdf": "application/pdf",
    ".zip": "application/zip",
    ".py": "text/x-python; charset=utf-8",
}
Content = IO[bytes]


def make_download(what: str, snapshot: Any, form: str = "svg", outdated: str | None = None) -> Content:
    """Make a file for download."""
    if what not in DOWNLOADS or form not in FIGURE_FORMATS:
        known = f"{', '.join(DOWNLOADS)} (figures as {', '.join(FIGURE_FORMATS)})"
        raise FrictrackError(f"expected one of the files {known} but got {what!r} as {form!r}", usage=True)
    if snapshot is None or snapshot.study is None or (snapshot.results is None and what != "repeat.py"):
        raise MissingError(f"expected results for {what} but there are none; press Run first")
    if what.startswith("report") and outdated:
        raise OutdatedError(f"{outdated.rstrip('.')}; write it again or download it as it is")
    return _content(what, snapshot.study, snapshot.results, form)


def _content(what: str, study: Study, results: Results, form: str) -> Content:
    """Make one of the files that exist or can be made of the results."""
    from frictrack.flow import replay_script  # noqa: PLC0415
    from frictrack.present import export  # noqa: PLC0415

    if what == "repeat.py":
        return BytesIO(replay_script(study).encode())
    if what == "tables.zip":
        return zip_files((path.name, path) for path in export.write(results, "csv"))
    if what == "hdf5.zip":
        return zip_files((path.name, path) for path in sorted(results.output.glob("[!.]*.h5")))
    from frictrack.present import plots, report  # noqa: PLC0415 - loads Matplotlib

    if what == "figures.zip":
        return zip_files((f"{name}.{form}", figure_bytes(draw(), form)) for name, draw in plots.study_figures(results))
    path = study.output / "report.html"
    if not path.exists():
        raise MissingError(f"expected the report {path} but it does not exist; write it first")
    return (report.print_pdf(path) if what == "report.pdf" else path).open("rb")


def figure_bytes(made: Figure, form: str) -> bytes:
    """Convert a figure to the content of a file."""
    from frictrack.present import plots  # noqa: PLC0415

    if form == "svg":
        return plots.svg_file(made).encode()
    return plots.png(made, dpi=200) if form == "png" else plots.pdf(made)


def zip_files(files: Iterator[tuple[str, bytes | Path]]) -> Content:
    """Pack files into one ZIP archive."""
    sheet: Any = SpooledTemporaryFile(MEMORY_BYTES)  # noqa: SIM115 - the caller closes it
    with zipfile.ZipFile(sheet, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files:
            if isinstance(content, Path):
                archive.write(content, name)
            else:
                archive.writestr(name, content)
    sheet.seek(0)
    return sheet


def page_figure(name: str, snapshot: Any) -> bytes:
    """Draw a figure that the page shows."""
    results = snapshot.results if snapshot else None
    made = _draw(name, results) if results is not None else None
    if made is None:
        raise MissingError(f'expected a figure of the results but there is none named "{name}"; reload the page')
    return figure_bytes(made, "svg")


# Kinds of figures of the page: name in the list of figures, and how the page draws it.
PAGE_FIGURES: dict[str, tuple[str, dict[str, Any]]] = {
    "law": ("law", {"title": False, "width": 4.8}),
    "search": ("convergence", {}),
    "cutoff": ("cutoff", {}),
    "filters": ("filters", {}),
}


def _draw(name: str, results: Results) -> Figure | None:
    from frictrack.present import plots  # noqa: PLC0415

    kind, _, which = name.partition(":")
    if kind == "scan":  # of any candidate; the list has that of the best
        curves = results.figures.get(which, {})
        return plots.scan(which, curves, width=5.0) if plots.has_scan(curves) else None
    listed, options = PAGE_FIGURES.get(kind, ("", {}))
    draw = dict(plots.study_figures(results)).get(f"{listed} {which}")
    return None if draw is None else draw(**options)
