"""Tab 6, history and report: every model tried side by side, and all that a colleague can be given."""

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
from frictrack.flow import script
from frictrack.report import printed
from frictrack.report.tables import history
from frictrack.results import Results
from frictrack.workbench.desk import Desk
from frictrack.workbench.widgets import button, grid, html, note

KINDS = ("svg", "png", "pdf")


class RecordTab:
    """The models in the order tried, and the files."""

    title = "6 History and report"

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self.models = html("")
        self.choice = pn.widgets.Select(label="Model", options={}, width=300)
        self.kind = pn.widgets.RadioButtonGroup(label="Figures as", options=list(KINDS), value="svg")
        self.link = html("")
        self.reports = (
            self._file("Report (HTML)", "report.html", self._report),
            self._file("Report (PDF)", "report.pdf", self._paper),
        )
        self.view = pn.Column(
            self.models,
            pn.FlexBox(self.choice, button("Make it current", self._use), align_items="flex-end", gap="10px"),
            pn.FlexBox(
                button("Write the report", lambda: desk.start("report"), "primary"),
                *self.reports,
                self._file("Tables (CSV)", "tables.zip", self._tables),
                self._file("Everything (HDF5)", "hdf5.zip", self._stores),
                self._file("Python script", "repeat.py", self._script),
                gap="10px",
            ),
            pn.FlexBox(
                self.kind, self._file("Figures", "figures.zip", self._figures), align_items="flex-end", gap="10px"
            ),
            self.link,
            sizing_mode="stretch_width",
        )

    def _file(self, label: str, name: str, make: Callable[[], bytes]) -> pn.widgets.FileDownload:
        """A button that gives a file; it is made beside the server's loop, so that the page lives on meanwhile."""

        async def made() -> io.BytesIO:
            one.param.update(label=f"{label} ...", disabled=True)
            self.desk.tell(f"{name} is being made")
            try:
                content = await asyncio.to_thread(make)
            except FrictrackError as e:
                self.desk.tell(str(e), wrong=True)
                raise  # nothing is downloaded
            finally:
                one.param.update(label=label, disabled=False)
            self.desk.tell(f"{name}: done")
            return io.BytesIO(content)

        one = pn.widgets.FileDownload(label=label, filename=name, callback=made, icon=None, color="default")
        return one

    def refresh(self) -> None:
        """Show the models tried."""
        results = self.desk.results
        models = results.models if results else ()
        path = results.output / "report.html" if results else None
        written = path is not None and path.exists()
        self.link.object = note(f"The report is {path}" if written else "Write the report before you take it with you.")
        for one in self.reports:
            one.disabled = not written
        if not models:
            self.models.object = note("No model was fitted yet.")
            self.choice.options = {}
            return
        self.models.object = grid(history(models))
        self.choice.options = {plots.numbered_name(m.name): m.name for m in models}
        self.choice.value = next((m.name for m in models if m.current), models[-1].name)

    def _use(self) -> None:
        if self.choice.value:
            self.desk.do("use", model=self.choice.value)

    # --- files

    def _results(self) -> Results:
        assert self.desk.results is not None
        return self.desk.results

    def _written(self) -> Path:
        path = self._results().output / "report.html"
        if not path.exists():
            raise FrictrackError(f"expected the report {path} but there is none; write it first")
        return path

    def _report(self) -> bytes:
        return self._written().read_bytes()

    def _paper(self) -> bytes:
        return printed(self._written()).read_bytes()

    def _tables(self) -> bytes:
        return zipped({path.name: path.read_bytes() for path in write(self._results(), "csv")})

    def _stores(self) -> bytes:
        return zipped({path.name: path.read_bytes() for path in sorted(self._results().output.glob("*.h5"))})

    def _script(self) -> bytes:
        assert self.desk.study is not None
        return script(self.desk.study).encode()

    def _figures(self) -> bytes:
        kind = self.kind.value
        return zipped({f"{name}.{kind}": drawn(made, kind) for name, made in figures(self._results()).items()})


def figures(results: Results) -> dict[str, Figure]:
    """Every figure of a study by its file's name."""
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


def drawn(made: Figure, kind: str) -> bytes:
    """A figure as a file."""
    if kind == "svg":
        return ('<?xml version="1.0" encoding="UTF-8"?>\n' + plots.svg(made)).encode()
    if kind == "png":
        return plots.png(made, dpi=200)
    sheet = io.BytesIO()
    made.savefig(sheet, format=kind)
    return sheet.getvalue()


def zipped(files: dict[str, bytes]) -> bytes:
    """Files in one archive."""
    sheet = io.BytesIO()
    with zipfile.ZipFile(sheet, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return sheet.getvalue()
