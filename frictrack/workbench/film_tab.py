"""Show the tab "Film": choose recordings, draw target and scale, and check the track."""

from __future__ import annotations

from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import panel as pn

from frictrack.errors import FrictrackError
from frictrack.files import atomic_write
from frictrack.flow import contact_sheet_path
from frictrack.report.tables import make_table
from frictrack.workbench import plot_data
from frictrack.workbench.page_state import PageState
from frictrack.workbench.panel_plots import PanelPlots
from frictrack.workbench.plots_with_film import OpenFilms, PlotsWithFilm
from frictrack.workbench.widgets import button, grid, heading, html, note

TOOLS = {"nothing": "", "target": "target", "fixed reference": "reference", "ruler": "ruler"}
RUN_KEYS = {"mass": "Mass of this run", "scale": "Scale of this run"}
MAX_UPLOAD_SIZE = "2GB"  # copy larger recordings to the folder of the study
MAX_NAME_BYTES = 200  # file systems allow 255


class FilmTab:
    """The tab: add recordings, draw target, reference and ruler on the film, show the track and its quality.

    Parameters
    ----------
    state : PageState
        The study.
    films : OpenFilms
        Its films.

    """

    title = "1 Film"

    def __init__(self, state: PageState, films: OpenFilms) -> None:
        self.state, self.plots_with_film = state, PlotsWithFilm(state, films, PanelPlots(sizing_mode="stretch_width"))
        self.linked = self.plots_with_film.linked
        self.tool = pn.widgets.RadioButtonGroup(label="Draw", options=TOOLS, value="")
        self.length = pn.widgets.TextInput(label="Length of the ruler", placeholder="100 mm", width=140)
        self.shape: dict[str, Any] = {}
        self._filling = False
        self.recordings = pn.widgets.CheckBoxGroup(label="Recordings in this folder", options=[], width=330)
        self.drop = pn.widgets.FileDropper(
            label="or drop them here", multiple=True, max_file_size=MAX_UPLOAD_SIZE, width=330
        )
        self.mass = pn.widgets.TextInput(label="Mass of the slider", placeholder="0.350 +/- 0.002 kg", width=160)
        self.fps = pn.widgets.TextInput(label="Frames per second while filming", placeholder="4000", width=160)
        self.scale = pn.widgets.TextInput(label="Scale", placeholder="0.5 mm/px", width=160)
        self.add = button("Add to the study", self._add_recordings, "primary")
        self.audit = html("")
        self.run_boxes = {key: pn.widgets.TextInput(label=label, width=200) for key, label in RUN_KEYS.items()}
        self.show_frame = pn.pane.PNG(None, alt_text="", sizing_mode="scale_width", max_width=1280)
        self.sheet = pn.Column(html(heading("Contact sheet")), self.show_frame, sizing_mode="stretch_width")
        self.new_study_keys = pn.Column(self.mass, self.fps, self.scale)
        self.recordings_heading = html("")
        self.new_recordings = pn.Column(
            self.recordings_heading,
            pn.FlexBox(
                pn.Column(self.recordings, self.drop), self.new_study_keys, self.add, align_items="flex-end", gap="14px"
            ),
        )
        self.tools = pn.FlexBox(
            self.tool,
            self.length,
            button("Use as scale", self._use_ruler),
            button("Remove drawn shapes", self._remove_shapes),
            button("Track every film", lambda: state.start_job("measure", stage="track"), "primary"),
            align_items="flex-end",
            gap="10px",
        )
        self.run_keys = pn.FlexBox(align_items="flex-end", gap="10px")
        self.view = pn.Column(
            self.tools,
            self.linked,
            self.run_keys,
            self.audit,
            self.sheet,
            self.new_recordings,
            sizing_mode="stretch_width",
        )
        self.tool.link(self.linked, value="tool")
        self.linked.on_change("drawn", self._on_shape_drawn)
        self.drop.param.watch(self._store_dropped, "value")
        for key, box in self.run_boxes.items():
            box.param.watch(partial(self._on_run_key, key), "value")

    def refresh(self) -> None:
        """Show the study as it is now."""
        new = self.state.study is None
        self.new_study_keys.visible, self.tools.visible = new, not new
        self.recordings.options = self.state.new_recordings
        self.recordings.visible = bool(self.recordings.options)
        self.recordings_heading.object = heading(
            "Recordings in this folder" + ("" if new else " that are not in the study")
        )
        run = self.state.run_results
        self.plots_with_film.draw(plot_data.track_plots(run) if run else plot_data.PlotData(), self.state.run)
        self.audit.object = self._audit_html()
        self._show_run_keys()
        path = contact_sheet_path(self.state.study, self.state.run) if self.state.study else None
        self.sheet.visible = run is not None and run.film is not None and path is not None and path.exists()
        if self.sheet.visible and path is not None:
            self.show_frame.alt_text = f"contact sheet of the tracked target in {self.state.run}"
            self.show_frame.object = path.read_bytes()

    # --- mass and scale of one run

    def _show_run_keys(self) -> None:
        """Show mass and scale of this run in the study file; in grey the value for all runs, where the run has none."""
        self.run_keys.objects = list(self.run_boxes.values()) if self.state.runs else []
        self._filling = True
        for (key, box), common in zip(self.run_boxes.items(), ("study", "camera"), strict=True):
            own = self.state.file_value("run", key, self.state.run) if self.state.run else None
            common_value = self.state.file_value(common, key)
            box.placeholder = (
                "drawn on the film" if _is_drawn(own or common_value) else f"{common_value or 'none'} for all runs"
            )
            box.value = "" if own is None or _is_drawn(own) else str(own)
        self._filling = False

    def _on_run_key(self, key: str, event: Any) -> None:
        """Write a key of the run. An empty text removes it, so that the value for all runs applies."""
        if not self._filling and self.state.run:
            text = event.new.strip()
            value = _number(text) if text else None
            self.state.apply_change("edit", table="run", which=self.state.run, key=key, value=value)

    # --- recordings

    def _add_recordings(self) -> None:
        names = list(self.recordings.value)
        if not names:
            return self.state.notify("choose recordings in this folder or drop them here first", is_error=True)
        keys = {"mass": self.mass.value, "fps": _number(self.fps.value), "scale": self.scale.value}
        new = self.state.study is None
        if self.state.create_study(names, keys) if new else self.state.apply_change("take_in", recordings=names):
            self.recordings.value = []
        return None

    def _store_dropped(self, event: Any) -> None:
        """Store dropped files in the folder of the study."""
        kept = []
        for name, content in (event.new or {}).items():
            try:
                kept.append(stored_upload(self.state.path.parent, name, content))
            except FrictrackError as e:
                self.state.notify(str(e), is_error=True)
        if kept:
            self.recordings.options = self.state.new_recordings
            self.recordings.value = [name for name in kept if name in self.recordings.options]
            self.state.notify(f"{', '.join(kept)}: stored in the folder of {self.state.path.name}")

    # --- shapes drawn on the film

    def _on_shape_drawn(self, shape: dict[str, Any]) -> None:
        self.shape = dict(shape)
        tool, place = self.shape.get("tool"), self.shape.get("shape")
        if tool in ("target", "reference") and self.state.runs:
            self.state.apply_change("edit", table="run", which=self.state.run, key=tool, value=place)
        elif tool == "ruler":
            self.linked.film = {**self.linked.film, "shapes": {**self.linked.film.get("shapes", {}), "ruler": place}}
            self.state.notify("now enter the length of the ruler and press Use as scale")

    def _use_ruler(self) -> None:
        if self.shape.get("tool") != "ruler" or not self.length.value:
            return self.state.notify("draw a ruler on the film and enter its length, for example 100 mm", is_error=True)
        scale = {"points": self.shape["shape"], "length": self.length.value}
        self.state.apply_change("edit", table="camera", key="scale", value=scale)
        return None

    def _remove_shapes(self) -> None:
        """Remove target and reference from the study file, so that they are detected automatically."""
        for key in ("target", "reference"):
            table = self.state.runs.get(self.state.run)
            if table is not None and isinstance(getattr(table, key), tuple):
                self.state.apply_change("edit", table="run", which=self.state.run, key=key, value=None)

    # --- quality

    def _audit_html(self) -> str:
        """Frame rate, checks of the time base, and notes of the tracker, as HTML."""
        run = self.state.run_results
        if run is None or run.film is None:
            if not self.state.run:
                return note("Choose or drop recordings, then enter mass, frame rate and scale.")
            return note(f"{self.state.run} is not processed yet. Press Run everything or Track every film.")
        rows = [
            ("frame rate while filming", f"{run.film.fps:g} /s", "forces are proportional to its square"),
            *run.film.audit,
        ]
        notes = "".join(f"<li>{escape(words)}</li>" for words in run.notes)
        return (
            heading("Time base") + grid(make_table(("check", "value", "verdict"), rows))
            + (heading("Notes") + f"<ul>{notes}</ul>" if notes else "")
        )  # fmt: skip


def stored_upload(folder: Path, name: str, content: bytes | str) -> str:
    """Store an uploaded file in the folder of the study.

    Parameters
    ----------
    folder : Path
        Folder of the study.
    name : str
        Name that the browser sent. Only its last part is used, so that the file stays in the folder.
    content : bytes or str
        Content of the file.

    Returns
    -------
    str
        Name of the stored file.

    Raises
    ------
    FrictrackError
        If the name is not a valid file name, or if another file of that name exists.

    """
    last = Path(name.replace("\\", "/")).name
    path = folder / last
    fits = last.isprintable() and len(last.encode()) <= MAX_NAME_BYTES and not last.startswith(".")
    if not last or not fits or path.is_symlink():
        raise FrictrackError(f'expected the file name of a recording but got "{name}"')
    data = content.encode() if isinstance(content, str) else content
    if path.exists() and path.read_bytes() != data:
        raise FrictrackError(f"{last} exists with different content; rename one of the files")
    with atomic_write(path) as part:
        part.write_bytes(data)
    return last


def _is_drawn(scale: Any) -> bool:
    """Whether a scale was drawn on the film."""
    return isinstance(scale, dict | list)


def _number(text: str | None) -> Any:
    """Convert a text to a number if it is one; else return the text."""
    try:
        return float(text or "")
    except ValueError:
        return text
