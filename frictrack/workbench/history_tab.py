"""Show the tab "History and report": all fitted models, and files to download."""

from __future__ import annotations

import asyncio
import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import panel as pn
from matplotlib.figure import Figure

from frictrack import plots
from frictrack.errors import FrictrackError
from frictrack.export import write
from frictrack.flow import replay_script
from frictrack.report import print_pdf
from frictrack.report.tables import history_table
from frictrack.results import Results
from frictrack.workbench.page_state import PageState
from frictrack.workbench.widgets import button, grid, html, note

FIGURE_FORMATS = ("svg", "png", "pdf")


class HistoryTab:
    """The tab: the models in the order in which they were fitted, and the files.

    Parameters
    ----------
    state : PageState
        The study.

    """

    title = "6 History and report"

    def __init__(self, state: PageState) -> None:
        self.state = state
        self.models = html("")
        self.choice = pn.widgets.Select(label="Model", options={}, width=300)
        self.kind = pn.widgets.RadioButtonGroup(label="Figures as", options=list(FIGURE_FORMATS), value="svg")
        self.link = html("")
        self.reports = (
            self._download_button("Report (HTML)", "report.html", self._report_html),
            self._download_button("Report (PDF)", "report.pdf", self._report_pdf),
        )
        self.view = pn.Column(
            self.models,
            pn.FlexBox(self.choice, button("Use this model", self._make_current), align_items="flex-end", gap="10px"),
            pn.FlexBox(
                button("Write the report", lambda: state.start_job("report"), "primary"),
                *self.reports,
                self._download_button("Tables (CSV)", "tables.zip", self._tables),
                self._download_button("Everything (HDF5)", "hdf5.zip", self._hdf5_files),
                self._download_button("Python script", "repeat.py", self._script),
                gap="10px",
            ),
            pn.FlexBox(
                self.kind,
                self._download_button("Figures", "figures.zip", self._figures),
                align_items="flex-end",
                gap="10px",
            ),
            self.link,
            sizing_mode="stretch_width",
        )

    def _download_button(self, label: str, name: str, make: Callable[[], bytes]) -> pn.widgets.FileDownload:
        """Create a button that downloads a file. Another thread makes the file, so that the page stays responsive."""

        async def made() -> io.BytesIO:
            one.param.update(label=f"{label} ...", disabled=True)
            self.state.notify(f"{name} is being made")
            try:
                content = await asyncio.to_thread(make)
            except FrictrackError as e:
                self.state.notify(str(e), is_error=True)
                raise  # nothing is downloaded
            finally:
                one.param.update(label=label, disabled=False)
            self.state.notify(f"{name}: done")
            return io.BytesIO(content)

        one = pn.widgets.FileDownload(label=label, filename=name, callback=made, icon=None, color="default")
        return one

    def refresh(self) -> None:
        """Show the fitted models."""
        results = self.state.results
        models = results.models if results else ()
        path = results.output / "report.html" if results else None
        written = path is not None and path.exists()
        self.link.object = note(f"The report is {path}" if written else "Write the report before downloading it.")
        for one in self.reports:
            one.disabled = not written
        if not models:
            self.models.object = note("No model is fitted yet.")
            self.choice.options = {}
            return
        self.models.object = grid(history_table(models))
        self.choice.options = {plots.numbered_name(m.name): m.name for m in models}
        self.choice.value = next((m.name for m in models if m.current), models[-1].name)

    def _make_current(self) -> None:
        if self.choice.value:
            self.state.apply_change("use", model=self.choice.value)

    # --- files

    def _need_results(self) -> Results:
        assert self.state.results is not None
        return self.state.results

    def _report_path(self) -> Path:
        path = self._need_results().output / "report.html"
        if not path.exists():
            raise FrictrackError(f"expected the report {path} but it does not exist; write it first")
        return path

    def _report_html(self) -> bytes:
        return self._report_path().read_bytes()

    def _report_pdf(self) -> bytes:
        return print_pdf(self._report_path()).read_bytes()

    def _tables(self) -> bytes:
        return zip_files({path.name: path.read_bytes() for path in write(self._need_results(), "csv")})

    def _hdf5_files(self) -> bytes:
        return zip_files({path.name: path.read_bytes() for path in sorted(self._need_results().output.glob("*.h5"))})

    def _script(self) -> bytes:
        assert self.state.study is not None
        return replay_script(self.state.study).encode()

    def _figures(self) -> bytes:
        kind = self.kind.value
        return zip_files(
            {f"{name}.{kind}": figure_bytes(made, kind) for name, made in figures(self._need_results()).items()}
        )


def figures(results: Results) -> dict[str, Figure]:
    """Draw every figure of a study.

    Returns
    -------
    dict
        Figures by file name without suffix.

    """
    out: dict[str, Figure] = {}
    for run in results.runs:
        out[f"motion {run.name}"] = plots.motion(run)
        if run.film is not None:
            out[f"film {run.name}"] = plots.film(run)
    for model in results.models:
        out[f"model {model.name}"] = plots.fit(model, results.runs)
        if model.diagnosis:
            out[f"fails {model.name}"] = plots.failing(model, results.runs, model.diagnosis["fails_at"])
            out[f"candidates {model.name}"] = plots.candidates(model.diagnosis)
    if results.models:
        out["history"] = plots.history(results.models)
    return out


def figure_bytes(made: Figure, kind: str) -> bytes:
    """Convert a figure to the content of a file.

    Parameters
    ----------
    made : Figure
        The figure.
    kind : str
        "svg", "png" or "pdf".

    """
    if kind == "svg":
        return ('<?xml version="1.0" encoding="UTF-8"?>\n' + plots.svg(made)).encode()
    if kind == "png":
        return plots.png(made, dpi=200)
    sheet = io.BytesIO()
    made.savefig(sheet, format=kind)
    return sheet.getvalue()


def zip_files(files: dict[str, bytes]) -> bytes:
    """Pack files into one ZIP archive.

    Parameters
    ----------
    files : dict
        Content of each file by its name.

    Returns
    -------
    bytes
        Content of the archive.

    """
    sheet = io.BytesIO()
    with zipfile.ZipFile(sheet, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return sheet.getvalue()
