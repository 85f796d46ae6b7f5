"""Tab 4, the comparison: model on measurement; what is selected in one plot shows in all others and on the film."""

from __future__ import annotations

from typing import Any

import panel as pn

from frictrack import plots
from frictrack.workbench import scenes
from frictrack.workbench.desk import Desk
from frictrack.workbench.films import Films
from frictrack.workbench.linked import Linked
from frictrack.workbench.widgets import html, note, table

NONE = "none"


class CompareTab:
    """Residual and force of one model, another one behind it."""

    title = "4 Compare"

    def __init__(self, desk: Desk, films: Films) -> None:
        self.desk, self.films = desk, films
        self.linked = Linked(sizing_mode="stretch_width")
        self.scene = scenes.Scene()
        self.model = pn.widgets.Select(name="Model", options=[], width=300)
        self.behind = pn.widgets.Select(name="Behind it", options=[NONE], width=300)
        self.spans = html("")
        self.view = pn.Column(
            pn.FlexBox(self.model, self.behind, gap="10px"),
            html(
                note(
                    "Drag over points to select them everywhere; shift and drag zooms, a double click shows all. The "
                    "film shows the frame in the middle of what is selected. Bars at the foot: where the model fails."
                )
            ),
            self.linked,
            self.spans,
            sizing_mode="stretch_width",
        )
        self.model.param.watch(self._draw, "value")
        self.behind.param.watch(self._draw, "value")
        self.linked.param.watch(self._selected, "selection")
        self.linked.param.watch(self._wanted, "want")

    def refresh(self) -> None:
        """Show the current model, and behind it what was attempted last."""
        models = self.desk.results.models if self.desk.results else ()
        names = {plots.plain_name(m.name): m.name for m in models}
        current = self.desk.model
        self.model.options = names
        self.behind.options = {NONE: "", **names, **({"attempted": "attempted"} if self.desk.ghost else {})}
        if current is not None:
            self.model.value = current.name
        self.behind.value = "attempted" if self.desk.ghost else ""
        self._draw()

    def _draw(self, *events: Any) -> None:
        results = self.desk.results
        model = next((m for m in (results.models if results else ()) if m.name == self.model.value), None)
        if results is None or model is None:
            self.scene = scenes.Scene()
            self.linked.draw(self.scene)
            self.spans.object = note("No model was fitted yet: go to Model and fit one.")
            return
        others = {m.name: m for m in results.models if m is not model}
        ghost = self.desk.ghost if self.behind.value == "attempted" else others.get(self.behind.value)
        self.scene = scenes.compared(results, model, ghost)
        self.linked.draw(self.scene)
        self.films.show(self.linked, self.desk.run, 0, self.scene)
        self.spans.object = _failing(model.diagnosis or (results.comparison if model.current else None) or {})

    def _selected(self, event: Any) -> None:
        if event.new.get("middle") is None:
            return
        run, frame = self.scene.place(int(event.new["middle"]))
        self.films.show(self.linked, run, frame, self.scene)

    def _wanted(self, event: Any) -> None:
        run = self.linked.film.get("label", self.desk.run)
        self.films.show(self.linked, run, int(event.new["frame"]), self.scene)


def _failing(told: dict[str, Any]) -> str:
    """Where the model fails, as a table."""
    rows = [
        (
            s["run"],
            *(f"{a:.4g} – {b:.4g}" for a, b in ([1e3 * q for q in s["t"]], [1e3 * q for q in s["x"]], s["v"])),
            f"{100 * s['share_of_error']:.0f} %",
        )
        for s in told.get("fails_at", [])
        if s.get("t")
    ]
    if not rows:
        return note("No single stretch stands out by itself.")
    return table(("run", "t / ms", "x / mm", "v / (m/s)", "share of the misfit"), rows, (1, 2, 3, 4))
