"""Build the page of one study: a header, six tabs, and a regular check of the files."""

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

POLL_MS = 150  # between two checks of the files


class Page:
    """The workbench of one study in one browser tab.

    Parameters
    ----------
    path : Path
        Study file, which need not exist yet.

    """

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
        self.outdated = html("", visible=False)
        self.message = html(
            "", visible=False, styles={"position": "sticky", "top": "0", "z-index": "10"}
        )  # visible at any scroll position
        self.run = pn.widgets.Select(label="Run", options=[], width=180)
        self.progress_bar = pn.indicators.Progress(value=0, max=100, width=260, visible=False, align="center")
        self.job_text = html("", width=520)
        self.cancel = button("Cancel", state.cancel, "warning", visible=False)
        self.undo, self.redo = (
            button("Undo", lambda: state.apply_change("undo")),
            button("Redo", lambda: state.apply_change("redo")),
        )
        self.run_all = button("Run everything", lambda: state.start_job("run"), "success")
        self.tab_bar = pn.Tabs(*((tab.title, tab.view) for tab in self.tabs), dynamic=True, sizing_mode="stretch_width")
        self.run.link(state, value="run")
        self._shown: dict[object, object] = {}  # state from which the head and each tab were last drawn
        self._is_polling = False
        state.param.watch(self._show_message, ["message", "is_error"])
        state.param.watch(self._show_progress, "progress")
        self.view = pn.Column(
            pn.FlexBox(
                self.head,
                self.run,
                self.run_all,
                self.undo,
                self.redo,
                align_items="flex-end",
                gap="10px",
            ),
            pn.Row(self.progress_bar, self.job_text, self.cancel),
            self.outdated,
            self.message,
            self.tab_bar,
            sizing_mode="stretch_width",
            styles={"padding": "8px 14px"},
        )

    def serve(self) -> pn.Column:
        """Build the page from the files, and check the files regularly once it is shown.

        Returns
        -------
        panel.Column
            The page.

        """
        self.state.load()
        self._show()
        pn.state.onload(lambda: pn.state.add_periodic_callback(self._poll, POLL_MS))  # type: ignore[arg-type,return-value]
        pn.state.on_session_destroyed(lambda context: self.films.close())
        return self.view

    async def _poll(self) -> None:
        """Check the files, unless the last check is still running."""
        if self._is_polling:
            return
        self._is_polling = True
        try:
            await self.state.update()
            self._show()
        finally:
            self._is_polling = False

    def _show(self) -> None:
        """Redraw the head and the active tab if their state has changed."""
        now, active = (self.state.version, self.state.run, id(self.state.attempted)), self.tab_bar.active
        for part, refresh in ((self.head, self._show_head), (self.tabs[active], self.tabs[active].refresh)):
            if self._shown.get(part) != now:
                refresh()
                self._shown[part] = now

    def _show_head(self) -> None:
        """Show the study, its model, its error and its verdict."""
        state, model = self.state, self.state.model
        self.run.options = list(state.runs)
        if state.run:
            self.run.value = state.run
        self.undo.disabled, self.redo.disabled = not state.can_apply("undo"), not state.can_apply("redo")
        self.run_all.disabled = state.study is None
        name = state.study.name if state.study else f"a new study in {state.path.parent.resolve().name}"
        words = ""
        if model is not None:
            chi2 = model.summary["errors"].get("reduced_chi2")
            verdict = (state.diagnosis or {}).get("verdict", "not diagnosed")
            words = f"{plots.plain_name(model.name)}: reduced chi-squared {format_number(chi2)}, {verdict}"
        self.head.object = f"<b>{escape(name)}</b><br>{escape(words)}"
        outdated = state.results.outdated if state.results else ()
        self.outdated.visible = bool(outdated)
        self.outdated.object = note(
            f"Changed since these results were made: {'; '.join(outdated)}. Run everything again."
        )

    def _show_message(self, *events: Any) -> None:
        kind = " wrong" if self.state.is_error else ""
        self.message.visible = bool(self.state.message)
        self.message.object = f"<div class='ft-message{kind}' role=status>{escape(self.state.message)}</div>"

    def _show_progress(self, event: Any) -> None:
        """Show the running job and its progress."""
        progress = event.new
        self.progress_bar.visible = self.cancel.visible = bool(progress)
        if not progress:
            self.job_text.object = ""
            return
        self.progress_bar.value = round(100 * progress["done"] / progress["total"]) if progress["total"] else -1
        self.job_text.object = f"{escape(progress['do'])}: {escape(progress['what'])}"
