"""One browser tab: what is at hand above, six tabs below, and again and again a look at the files."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import panel as pn

from frictrack import plots
from frictrack.plots import number
from frictrack.workbench.compare import CompareTab
from frictrack.workbench.desk import Desk
from frictrack.workbench.film import FilmTab
from frictrack.workbench.films import Films
from frictrack.workbench.missing import MissingTab
from frictrack.workbench.model import ModelTab
from frictrack.workbench.motion import MotionTab
from frictrack.workbench.record import RecordTab
from frictrack.workbench.widgets import button, html, note

LOOK = 150  # ms between two looks at the files


class Page:
    """The workbench of one study."""

    def __init__(self, path: Path) -> None:
        self.desk = desk = Desk(path)
        self.films = films = Films()
        self.tabs: list[Any] = [
            FilmTab(desk, films),
            MotionTab(desk, films),
            ModelTab(desk),
            CompareTab(desk, films),
            MissingTab(desk, films),
            RecordTab(desk),
        ]
        self.head = html("", width=400)
        self.old = html("", visible=False)
        self.said = html(
            "", visible=False, styles={"position": "sticky", "top": "0", "z-index": "10"}
        )  # seen wherever one scrolls
        self.run = pn.widgets.Select(label="Run", options=[], width=180)
        self.bar = pn.indicators.Progress(value=0, max=100, width=260, visible=False, align="center")
        self.doing = html("", width=520)
        self.cancel = button("Cancel", desk.cancel, "warning", visible=False)
        self.undo, self.redo = button("Undo", lambda: desk.do("undo")), button("Redo", lambda: desk.do("redo"))
        self.whole = button("Run everything", lambda: desk.start("run"), "success")
        self.shelf = pn.Tabs(*((tab.title, tab.view) for tab in self.tabs), dynamic=True, sizing_mode="stretch_width")
        self.run.link(desk, value="run")
        self._shown: dict[object, object] = {}  # what the head and each tab were last made from
        self._busy = False
        desk.param.watch(self._told, ["said", "wrong"])
        desk.param.watch(self._working, "busy")
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
            self.said,
            self.shelf,
            sizing_mode="stretch_width",
            styles={"padding": "8px 14px"},
        )

    def serve(self) -> pn.Column:
        """The page as the files are now; once it is drawn it looks at them again and again."""
        self.desk.look_first()
        self._show()
        pn.state.onload(lambda: pn.state.add_periodic_callback(self._tick, LOOK))  # type: ignore[arg-type,return-value]
        pn.state.on_session_destroyed(lambda context: self.films.close())
        return self.view

    async def _tick(self) -> None:
        """Look at the files, unless the last look still goes on."""
        if self._busy:
            return
        self._busy = True
        try:
            await self.desk.look()
            self._show()
        finally:
            self._busy = False

    def _show(self) -> None:
        """Bring up to date what is above, and the tab that is looked at."""
        now, active = (self.desk.seen, self.desk.run, id(self.desk.ghost)), self.shelf.active
        for part, refresh in ((self.head, self._headed), (self.tabs[active], self.tabs[active].refresh)):
            if self._shown.get(part) != now:
                refresh()
                self._shown[part] = now

    def _headed(self) -> None:
        """The study in one line: model, error, verdict."""
        desk, model = self.desk, self.desk.model
        self.run.options = list(desk.runs)
        if desk.run:
            self.run.value = desk.run
        self.undo.disabled, self.redo.disabled = not desk.can("undo"), not desk.can("redo")
        self.whole.disabled = desk.study is None
        name = desk.study.name if desk.study else f"a new study in {desk.path.parent.resolve().name}"
        words = ""
        if model is not None:
            chi2 = model.summary["errors"].get("reduced_chi2")
            verdict = (desk.diagnosis or {}).get("verdict", "not diagnosed")
            words = f"{plots.plain_name(model.name)}: reduced chi-squared {number(chi2)}, {verdict}"
        self.head.object = f"<b>{escape(name)}</b><br>{escape(words)}"
        old = desk.results.outdated if desk.results else ()
        self.old.visible = bool(old)
        self.old.object = note(f"Changed since these results were made: {'; '.join(old)}. Run everything again.")

    def _told(self, *events: Any) -> None:
        kind = " wrong" if self.desk.wrong else ""
        self.said.visible = bool(self.desk.said)
        self.said.object = f"<div class='ft-said{kind}' role=status>{escape(self.desk.said)}</div>"

    def _working(self, event: Any) -> None:
        """What is being done, and how far it is."""
        busy = event.new
        self.bar.visible = self.cancel.visible = bool(busy)
        if not busy:
            self.doing.object = ""
            return
        self.bar.value = round(100 * busy["done"] / busy["total"]) if busy["total"] else -1
        self.doing.object = f"{escape(busy['do'])}: {escape(busy['what'])}"
