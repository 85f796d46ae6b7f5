"""The page of one study: a header, six tabs, and a regular check of the files."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import panel as pn

from frictrack import plots
from frictrack.number_format import format_number
from frictrack.workbench.compare_tab import CompareTab
from frictrack.workbench.film_tab import FilmTab
from frictrack.workbench.history_tab import HistoryTab
from frictrack.workbench.missing_tab import MissingTab
from frictrack.workbench.model_tab import ModelTab
from frictrack.workbench.motion_tab import MotionTab
from frictrack.workbench.page_state import PageState
from frictrack.workbench.plots_with_film import OpenFilms
from frictrack.workbench.widgets import button, html, note

POLL_MS = 150  # ms between two looks at the files


class Page:
    """The workbench of one study."""

    def __init__(self, path: Path) -> None:
        self.state = state = PageState(path)
        self.films = films = OpenFilms()
        self.tabs: list[Any] = [
            FilmTab(state, films),
            MotionTab(state, films),
            ModelTab(state),
            CompareTab(state, films),
            MissingTab(state, films),
            HistoryTab(state),
        ]
        self.head = html("", width=400)
        self.old = html("", visible=False)
        self.message = html(
            "", visible=False, styles={"position": "sticky", "top": "0", "z-index": "10"}
        )  # seen wherever one scrolls
        self.run = pn.widgets.Select(label="Run", options=[], width=180)
        self.bar = pn.indicators.Progress(value=0, max=100, width=260, visible=False, align="center")
        self.doing = html("", width=520)
        self.cancel = button("Cancel", state.cancel, "warning", visible=False)
        self.undo, self.redo = button("Undo", lambda: state.do("undo")), button("Redo", lambda: state.do("redo"))
        self.whole = button("Run everything", lambda: state.start("run"), "success")
        self.tab_bar = pn.Tabs(*((tab.title, tab.view) for tab in self.tabs), dynamic=True, sizing_mode="stretch_width")
        self.run.link(state, value="run")
        self._shown: dict[object, object] = {}  # what the head and each tab were last made from
        self._busy = False
        state.param.watch(self._show_message, ["message", "is_error"])
        state.param.watch(self._show_progress, "busy")
        self.view = pn.Column(
            pn.FlexBox(
                self.head,
                self.run,
                self.whole,
                self.undo,
                self.redo,
                align_items="flex-end",
                gap="10px",
            ),
            pn.Row(self.bar, self.doing, self.cancel),
            self.old,
            self.message,
            self.tab_bar,
            sizing_mode="stretch_width",
            styles={"padding": "8px 14px"},
        )

    def serve(self) -> pn.Column:
        """The page as the files are now; once it is drawn it looks at them again and again."""
        self.state.look_first()
        self._show()
        pn.state.onload(lambda: pn.state.add_periodic_callback(self._poll, POLL_MS))  # type: ignore[arg-type,return-value]
        pn.state.on_session_destroyed(lambda context: self.films.close())
        return self.view

    async def _poll(self) -> None:
        """Look at the files, unless the last look still goes on."""
        if self._busy:
            return
        self._busy = True
        try:
            await self.state.look()
            self._show()
        finally:
            self._busy = False

    def _show(self) -> None:
        """Bring up to date what is above, and the tab that is looked at."""
        now, active = (self.state.seen, self.state.run, id(self.state.ghost)), self.tab_bar.active
        for part, refresh in ((self.head, self._show_head), (self.tabs[active], self.tabs[active].refresh)):
            if self._shown.get(part) != now:
                refresh()
                self._shown[part] = now

    def _show_head(self) -> None:
        """The study in one line: model, error, verdict."""
        state, model = self.state, self.state.model
        self.run.options = list(state.runs)
        if state.run:
            self.run.value = state.run
        self.undo.disabled, self.redo.disabled = not state.can("undo"), not state.can("redo")
        self.whole.disabled = state.study is None
        name = state.study.name if state.study else f"a new study in {state.path.parent.resolve().name}"
        words = ""
        if model is not None:
            chi2 = model.summary["errors"].get("reduced_chi2")
            verdict = (state.diagnosis or {}).get("verdict", "not diagnosed")
            words = f"{plots.plain_name(model.name)}: reduced chi-squared {format_number(chi2)}, {verdict}"
        self.head.object = f"<b>{escape(name)}</b><br>{escape(words)}"
        old = state.results.outdated if state.results else ()
        self.old.visible = bool(old)
        self.old.object = note(f"Changed since these results were made: {'; '.join(old)}. Run everything again.")

    def _show_message(self, *events: Any) -> None:
        kind = " wrong" if self.state.is_error else ""
        self.message.visible = bool(self.state.message)
        self.message.object = f"<div class='ft-said{kind}' role=status>{escape(self.state.message)}</div>"

    def _show_progress(self, event: Any) -> None:
        """What is being done, and how far it is."""
        busy = event.new
        self.bar.visible = self.cancel.visible = bool(busy)
        if not busy:
            self.doing.object = ""
            return
        self.bar.value = round(100 * busy["done"] / busy["total"]) if busy["total"] else -1
        self.doing.object = f"{escape(busy['do'])}: {escape(busy['what'])}"
