"""The tab "Film": choose recordings, draw target and scale, and see how well the target was tracked."""

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

TOOLS = {"look only": "", "target": "target", "fixed reference": "reference", "ruler": "ruler"}
RUN_KEYS = {"mass": "Mass of this run", "scale": "Scale of this run"}
MAX_UPLOAD_SIZE = "2GB"  # of a recording that is dropped; larger ones lie in the folder already
MAX_NAME_BYTES = 200  # bytes of a file name; systems end at 255


class FilmTab:
    """Recordings in; target, reference and ruler drawn on the film; the track and its quality out."""

    title = "1 Film"

    def __init__(self, state: PageState, films: OpenFilms) -> None:
        self.state, self.plots_with_film = state, PlotsWithFilm(state, films, PanelPlots(sizing_mode="stretch_width"))
        self.linked = self.plots_with_film.linked
        self.tool = pn.widgets.RadioButtonGroup(label="Draw", options=TOOLS, value="")
        self.length = pn.widgets.TextInput(label="Length of the ruler", placeholder="100 mm", width=140)
        self.shape: dict[str, Any] = {}
        self._filling = False
        self.found = pn.widgets.CheckBoxGroup(label="Recordings in this folder", options=[], width=330)
        self.drop = pn.widgets.FileDropper(
            label="or drop them here", multiple=True, max_file_size=MAX_UPLOAD_SIZE, width=330
        )
        self.mass = pn.widgets.TextInput(label="Mass of the slider", placeholder="0.350 +/- 0.002 kg", width=160)
        self.fps = pn.widgets.TextInput(label="Frames per second while filming", placeholder="4000", width=160)
        self.scale = pn.widgets.TextInput(label="Scale", placeholder="0.5 mm/px", width=160)
        self.go = button("Take them in", self._take_in, "primary")
        self.audit = html("")
        self.own = {key: pn.widgets.TextInput(label=label, width=200) for key, label in RUN_KEYS.items()}
        self.show_frame = pn.pane.PNG(None, alt_text="", sizing_mode="scale_width", max_width=1280)
        self.sheet = pn.Column(html(heading("Contact sheet")), self.show_frame, sizing_mode="stretch_width")
        self.keys = pn.Column(self.mass, self.fps, self.scale)
        self.others = html("")
        self.more = pn.Column(
            self.others,
            pn.FlexBox(pn.Column(self.found, self.drop), self.keys, self.go, align_items="flex-end", gap="14px"),
        )
        self.tools = pn.FlexBox(
            self.tool,
            self.length,
            button("Use as scale", self._rule),
            button("Take back what was drawn", self._undraw),
            button("Track every film", lambda: state.start("measure", stage="track"), "primary"),
            align_items="flex-end",
            gap="10px",
        )
        self.keys_of_run = pn.FlexBox(align_items="flex-end", gap="10px")
        self.view = pn.Column(
            self.tools, self.linked, self.keys_of_run, self.audit, self.sheet, self.more, sizing_mode="stretch_width"
        )
        self.tool.link(self.linked, value="tool")
        self.linked.on_change("drawn", self._drawn)
        self.drop.param.watch(self._dropped, "value")
        for key, box in self.own.items():
            box.param.watch(partial(self._keyed, key), "value")

    def refresh(self) -> None:
        """Show the study as it is now."""
        new = self.state.study is None
        self.keys.visible, self.tools.visible = new, not new
        self.found.options = self.state.recordings
        self.found.visible = bool(self.found.options)
        self.others.object = heading("Recordings in this folder" + ("" if new else " that are not in the study"))
        run = self.state.measured
        self.plots_with_film.draw(plot_data.tracked(run) if run else plot_data.PlotData(), self.state.run)
        self.audit.object = self._audit_html()
        self._show_run_keys()
        path = contact_sheet_path(self.state.study, self.state.run) if self.state.study else None
        self.sheet.visible = run is not None and run.film is not None and path is not None and path.exists()
        if self.sheet.visible and path is not None:
            self.show_frame.alt_text = f"contact sheet: what was tracked in {self.state.run}"
            self.show_frame.object = path.read_bytes()

    # --- mass and scale of one run

    def _show_run_keys(self) -> None:
        """What the study file says of this run, and in grey what holds where it says nothing."""
        self.keys_of_run.objects = list(self.own.values()) if self.state.runs else []
        self._filling = True
        for (key, box), common in zip(self.own.items(), ("study", "camera"), strict=True):
            held = self.state.written("run", key, self.state.run) if self.state.run else None
            common_value = self.state.written(common, key)
            box.placeholder = (
                "drawn on the film" if _is_drawn(held or common_value) else f"{common_value or 'none'} for all runs"
            )
            box.value = "" if held is None or _is_drawn(held) else str(held)
        self._filling = False

    def _keyed(self, key: str, event: Any) -> None:
        """Write a key of the run; an empty one is taken away, so that the study's holds again."""
        if not self._filling and self.state.run:
            text = event.new.strip()
            value = _number(text) if text else None
            self.state.do("edit", table="run", which=self.state.run, key=key, value=value)

    # --- recordings

    def _take_in(self) -> None:
        names = list(self.found.value)
        if not names:
            return self.state.notify("choose recordings in this folder, or drop them here first", is_error=True)
        keys = {"mass": self.mass.value, "fps": _number(self.fps.value), "scale": self.scale.value}
        new = self.state.study is None
        if self.state.begin(names, keys) if new else self.state.do("take_in", recordings=names):
            self.found.value = []
        return None

    def _dropped(self, event: Any) -> None:
        """Store what was dropped beside the study file, under the last part of its name only."""
        kept = []
        for name, content in (event.new or {}).items():
            try:
                kept.append(stored_upload(self.state.path.parent, name, content))
            except FrictrackError as e:
                self.state.notify(str(e), is_error=True)
        if kept:
            self.found.options = self.state.recordings
            self.found.value = [name for name in kept if name in self.found.options]
            self.state.notify(f"{', '.join(kept)}: stored beside {self.state.path.name}")

    # --- what is drawn on the film

    def _drawn(self, shape: dict[str, Any]) -> None:
        self.shape = dict(shape)
        tool, place = self.shape.get("tool"), self.shape.get("shape")
        if tool in ("target", "reference") and self.state.runs:
            self.state.do("edit", table="run", which=self.state.run, key=tool, value=place)
        elif tool == "ruler":
            self.linked.film = {**self.linked.film, "shapes": {**self.linked.film.get("shapes", {}), "ruler": place}}
            self.state.notify("now give the length of the ruler and use it as the scale")

    def _rule(self) -> None:
        if self.shape.get("tool") != "ruler" or not self.length.value:
            return self.state.notify("draw a ruler on the film and give its length, as 100 mm", is_error=True)
        scale = {"points": self.shape["shape"], "length": self.length.value}
        self.state.do("edit", table="camera", key="scale", value=scale)
        return None

    def _undraw(self) -> None:
        """The target and the reference are found by themselves again."""
        for key in ("target", "reference"):
            table = self.state.runs.get(self.state.run)
            if table is not None and isinstance(getattr(table, key), tuple):
                self.state.do("edit", table="run", which=self.state.run, key=key, value=None)

    # --- looking

    def _audit_html(self) -> str:
        """Frame rate and time base in plain sight, what the tracker noticed, and its contact sheet."""
        run = self.state.measured
        if run is None or run.film is None:
            if not self.state.run:
                return note("Choose recordings, or drop them; then give mass, frame rate and scale.")
            return note(f"{self.state.run} is not measured to its end yet: run everything, or track every film first.")
        rows = [("frame rate while filming", f"{run.film.fps:g} /s", "forces go with its square"), *run.film.audit]
        notes = "".join(f"<li>{escape(words)}</li>" for words in run.notes)
        return (
            heading("Time base") + grid(make_table(("what was looked at", "value", "verdict"), rows))
            + (heading("Noticed") + f"<ul>{notes}</ul>" if notes else "")
        )  # fmt: skip


def stored_upload(folder: Path, name: str, content: bytes | str) -> str:
    """Put an uploaded file into the study's folder and return its name there.

    Of the name only the last part counts, so that it cannot leave the folder; another file of that name is not
    overwritten. Raises `FrictrackError` for a name that is none.
    """
    last = Path(name.replace("\\", "/")).name
    path = folder / last
    fits = last.isprintable() and len(last.encode()) <= MAX_NAME_BYTES and not last.startswith(".")
    if not last or not fits or path.is_symlink():
        raise FrictrackError(f'expected the name of a recording but got "{name}"')
    data = content.encode() if isinstance(content, str) else content
    if path.exists() and path.read_bytes() != data:
        raise FrictrackError(f"{last} is there already with another content; rename one of them")
    with atomic_write(path) as part:
        part.write_bytes(data)
    return last


def _is_drawn(scale: Any) -> bool:
    """Whether a scale comes from the film itself."""
    return isinstance(scale, dict | list)


def _number(text: str | None) -> Any:
    """A number where the text is one."""
    try:
        return float(text or "")
    except ValueError:
        return text
