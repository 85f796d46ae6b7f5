"""Show the tab "Compare": model and measurement in linked plots, next to the film."""

from __future__ import annotations

from typing import Any

import panel as pn

from frictrack import plots
from frictrack.report.tables import failing_span_table
from frictrack.workbench import plot_data
from frictrack.workbench.page_state import PageState
from frictrack.workbench.panel_plots import PanelPlots
from frictrack.workbench.plots_with_film import OpenFilms, PlotsWithFilm
from frictrack.workbench.widgets import grid, html, note

NONE = "none"


class CompareTab:
    """The tab: residual and force of one model, with another model in the background.

    Parameters
    ----------
    state : PageState
        The study.
    films : OpenFilms
        Its films.

    """

    title = "4 Compare"

    def __init__(self, state: PageState, films: OpenFilms) -> None:
        self.state, self.plots_with_film = state, PlotsWithFilm(state, films, PanelPlots(sizing_mode="stretch_width"))
        self.model = pn.widgets.Select(label="Model", options=[], width=300)
        self.background = pn.widgets.Select(label="Background", options=[NONE], width=300)
        self.spans = html("")
        self._filling = False
        self.view = pn.Column(
            pn.FlexBox(self.model, self.background, gap="10px"),
            html(
                note(
                    "Drag over points to select them in all plots. Shift and drag zooms; a double click resets "
                    "the zoom. The film shows the middle frame of the selection. Bars at the bottom mark where the "
                    "model fails."
                )
            ),
            self.plots_with_film.linked,
            self.spans,
            sizing_mode="stretch_width",
        )
        self.model.param.watch(self._draw, "value")
        self.background.param.watch(self._draw, "value")

    def refresh(self) -> None:
        """Show the current model, with the last attempted model in the background."""
        models = self.state.results.models if self.state.results else ()
        names = {plots.numbered_name(m.name): m.name for m in models}
        current = self.state.model
        attempt = {"attempted": "attempted"} if self.state.attempted else {}
        self._filling = True  # the change of each selection would draw once more
        self.model.param.update(options=names, value=current.name if current else None)
        self.background.param.update(options={NONE: "", **names, **attempt}, value="attempted" if attempt else "")
        self._filling = False
        self._draw()

    def _draw(self, *events: Any) -> None:
        if self._filling:
            return
        results = self.state.results
        model = next((m for m in (results.models if results else ()) if m.name == self.model.value), None)
        if results is None or model is None:
            self.plots_with_film.draw(plot_data.PlotData())
            self.spans.object = note("No model is fitted yet. Fit one in the tab Model.")
            return
        others = {m.name: m for m in results.models if m is not model}
        background = self.state.attempted if self.background.value == "attempted" else others.get(self.background.value)
        self.plots_with_film.draw(plot_data.comparison_plots(results, model, background), self.state.run)
        self.spans.object = _failing_table(model.diagnosis or (results.comparison if model.current else None) or {})


def _failing_table(diagnosis: dict[str, Any]) -> str:
    """Table of the spans where the model fails, as HTML."""
    found = [s for s in diagnosis.get("fails_at", []) if s.get("t")]
    return grid(failing_span_table(found)) if found else note("No single span is significant.")
