"""Show the tab "Motion": x, v, a and F with their bands, the cut-off frequency and the free section."""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
import panel as pn

from frictrack import plots
from frictrack.errors import FrictrackError
from frictrack.flow import preview_motion
from frictrack.results import RunResults
from frictrack.workbench import plot_data
from frictrack.workbench.page_state import PageState
from frictrack.workbench.panel_plots import PanelPlots
from frictrack.workbench.plots_with_film import OpenFilms, PlotsWithFilm
from frictrack.workbench.widgets import button, figure, html, note


class MotionTab:
    """The tab: smoothed motion of one run, with its cut-off frequency and free section.

    Parameters
    ----------
    state : PageState
        The study.
    films : OpenFilms
        Its films.

    """

    title = "2 Motion"

    def __init__(self, state: PageState, films: OpenFilms) -> None:
        self.state, self.plots_with_film = state, PlotsWithFilm(state, films, PanelPlots(sizing_mode="stretch_width"))
        self.cutoff = pn.widgets.DiscreteSlider(
            label="Preview of a plain low-pass: cut-off / Hz", options=[1.0], width=420
        )
        self.cost = html("")
        self.text = html("")
        self.trade = pn.Column(sizing_mode="stretch_width")
        self.separate = button("Separate trend, vibrations and events instead", lambda: self._edit("cutoff", None))
        self.detect = button("Detect the free section", lambda: self._edit("free", None))
        self.use = button("Use this cut-off", self._use_cutoff)
        self.view = pn.Column(
            self.text,
            pn.FlexBox(
                pn.Column(self.cutoff, self.cost),
                self.use,
                self.separate,
                self.detect,
                button("Update this study", lambda: state.start_job("measure", stage="friction"), "primary"),
                align_items="flex-end",
                gap="10px",
            ),
            self.plots_with_film.linked,
            self.trade,
            sizing_mode="stretch_width",
        )
        self._preview_cutoff: float | None = None  # cut-off that is previewed, Hz
        self._filling = self._is_previewing = False
        self.cutoff.param.watch(self._on_cutoff_moved, "value")
        self.plots_with_film.linked.on_change("moved", self._on_section_moved)

    def refresh(self) -> None:
        """Show the selected run."""
        run = self.state.run_results
        self._preview_cutoff = None
        self.plots_with_film.draw(plot_data.motion_plots(run) if run else plot_data.PlotData(), self.state.run)
        self.use.visible = self.cutoff.visible = run is not None and run.cutoff is not None
        self.separate.visible = self.detect.visible = run is not None
        if run is None:
            self.text.object = note("This run is not processed yet. Press Update this study.")
            self.trade.objects, self.cost.object = [], ""
            return
        free = run.friction.reason if run.friction else "no force without a mass"
        self.text.object = note(f"Free section: {free}. Drag its green handles to change it.") + note(
            f"Smoothed by {run.filtered.reason}. The axes of acceleration and force are scaled to the free section; "
            "zoom out (shift and wheel) to see the motion before it."
        )
        self.trade.objects = []
        self.cost.object = note("Press Update this study to choose a cut-off.")
        if run.cutoff is not None:
            asked = run.settings.get("cutoff")
            near = asked or run.cutoff.chosen
            self._filling = True  # not a move by the user
            self.cutoff.options = [float(np.round(f, 1)) for f in run.cutoff.frequency]
            self.cutoff.value = min(self.cutoff.options, key=lambda f: abs(f - near))
            self._filling = False
            self._show_cost(run)
            self.trade.objects = [figure(plots.cutoff(run.name, run.cutoff, run.mass))]
            if asked and not (run.filtered.asked and np.isclose(run.filtered.cutoff, asked)):
                self._request_preview(float(asked))  # in the study file, but not computed yet

    def _show_cost(self, run: RunResults) -> None:
        """Show the noise that passes the cut-off and the signal that it removes."""
        assert run.cutoff is not None
        noise, lost = run.cutoff.at(float(self.cutoff.value))
        factor, unit = (run.mass, "N") if run.mass else (1.0, "m/s²")
        self.cost.object = note(
            f"noise that passes: {noise * factor:.3g} {unit}; signal lost: {lost * factor:.3g} {unit}; total error "
            f"with trend, vibrations and events separated: {run.cutoff.structural * factor:.3g} {unit}"
        )

    # --- the preview

    def _on_cutoff_moved(self, event: Any) -> None:
        run = self.state.run_results
        if self._filling or run is None or run.cutoff is None:
            return
        self._show_cost(run)
        self._request_preview(float(self.cutoff.value))

    def _request_preview(self, cutoff: float) -> None:
        """Draw velocity and acceleration for a cut-off in the background."""
        self._preview_cutoff = cutoff
        if not self._is_previewing:
            pn.state.execute(self._run_previews)

    async def _run_previews(self) -> None:
        """Compute previews in another thread, one at a time; of several requests only the last is drawn."""
        shown, self._is_previewing = None, True
        try:
            while self._preview_cutoff is not None and (wanted := (self.state.run, self._preview_cutoff)) != shown:
                run = self.state.run_results
                if run is None:
                    return
                found = await asyncio.to_thread(preview_motion, run, wanted[1])
                if self._preview_cutoff is not None and self.state.run_results is run:  # type: ignore[redundant-expr]  # may change meanwhile
                    self.plots_with_film.draw(plot_data.motion_plots(run, found, f"at {wanted[1]:.3g} Hz"))
                    shown = wanted
        except FrictrackError as e:
            self.state.notify(str(e), is_error=True)
        finally:
            self._is_previewing = False

    # --- changes of the study file

    def _use_cutoff(self) -> None:
        self._edit("cutoff", f"{self.cutoff.value:g} Hz")

    def _edit(self, key: str, value: Any) -> None:
        self.state.apply_change("edit", table="run", which=self.state.run, key=key, value=value)

    def _on_section_moved(self, handle: dict[str, Any]) -> None:
        begin, end = (f"{v:.4g} ms" for v in handle["span"])
        self._edit("free", [begin, end])
