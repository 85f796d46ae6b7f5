"""The tab "Motion": x, v, a and F with their bands, the cut-off frequency and the free section."""

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
    """The smoothed motion of one run, and the two choices that it rests on."""

    title = "2 Motion"

    def __init__(self, state: PageState, films: OpenFilms) -> None:
        self.state, self.plots_with_film = state, PlotsWithFilm(state, films, PanelPlots(sizing_mode="stretch_width"))
        self.cutoff = pn.widgets.DiscreteSlider(
            label="Preview a plain low-pass, cut-off / Hz", options=[1.0], width=420
        )
        self.price = html("")
        self.words = html("")
        self.trade = pn.Column(sizing_mode="stretch_width")
        self.part = button("Part trend, vibrations and events instead", lambda: self._edit("cutoff", None))
        self.find = button("Find the free section by itself", lambda: self._edit("free", None))
        self.use = button("Use this cut-off", self._use_cutoff)
        self.view = pn.Column(
            self.words,
            pn.FlexBox(
                pn.Column(self.cutoff, self.price),
                self.use,
                self.part,
                self.find,
                button("Bring up to date", lambda: state.start("measure", stage="friction"), "primary"),
                align_items="flex-end",
                gap="10px",
            ),
            self.plots_with_film.linked,
            self.trade,
            sizing_mode="stretch_width",
        )
        self._ghost: float | None = None  # cut-off that is previewed, Hz
        self._filling = self._busy = False
        self.cutoff.param.watch(self._on_cutoff_moved, "value")
        self.plots_with_film.linked.on_change("moved", self._on_section_moved)

    def refresh(self) -> None:
        """Show the run that is looked at."""
        run = self.state.measured
        self._ghost = None
        self.plots_with_film.draw(plot_data.motion(run) if run else plot_data.PlotData(), self.state.run)
        self.use.visible = self.cutoff.visible = run is not None and run.cutoff is not None
        self.part.visible = self.find.visible = run is not None
        if run is None:
            self.words.object = note("This run is not measured to its end yet: bring it up to date.")
            self.trade.objects, self.price.object = [], ""
            return
        free = run.friction.reason if run.friction else "without a mass there is no force"
        self.words.object = note(f"Free section: {free}. Drag its green handles to change it.") + note(
            f"Smoothed by {run.filtered.reason}. Acceleration and force are drawn to the scale of the free section; "
            "zoom out (shift and wheel) to see what comes before it."
        )
        self.trade.objects = []
        self.price.object = note("Bring up to date to choose a cut-off.")
        if run.cutoff is not None:
            asked = run.settings.get("cutoff")
            near = asked or run.cutoff.chosen
            self._filling = True  # nobody has moved it
            self.cutoff.options = [float(np.round(f, 1)) for f in run.cutoff.frequency]
            self.cutoff.value = min(self.cutoff.options, key=lambda f: abs(f - near))
            self._filling = False
            self._show_cost(run)
            self.trade.objects = [figure(plots.cutoff(run.name, run.cutoff, run.mass))]
            if asked and not (run.filtered.asked and np.isclose(run.filtered.cutoff, asked)):
                self._request_preview(float(asked))  # set in the study, not computed yet

    def _show_cost(self, run: RunResults) -> None:
        """What a cut-off costs: noise that it lets pass, detail that it takes away."""
        assert run.cutoff is not None
        noise, lost = run.cutoff.at(float(self.cutoff.value))
        factor, unit = (run.mass, "N") if run.mass else (1.0, "m/s²")
        self.price.object = note(
            f"lets {noise * factor:.3g} {unit} of noise pass and takes {lost * factor:.3g} {unit} of detail; trend, "
            f"vibrations and events parted: {run.cutoff.structural * factor:.3g} {unit} in all"
        )

    # --- the preview

    def _on_cutoff_moved(self, event: Any) -> None:
        run = self.state.measured
        if self._filling or run is None or run.cutoff is None:
            return
        self._show_cost(run)
        self._request_preview(float(self.cutoff.value))

    def _request_preview(self, cutoff: float) -> None:
        """Have the ghosts of a cut-off drawn."""
        self._ghost = cutoff
        if not self._busy:
            pn.state.execute(self._run_previews)

    async def _run_previews(self) -> None:
        """One at a time, beside the server's loop; of those asked for meanwhile the last one counts."""
        shown, self._busy = None, True
        try:
            while self._ghost is not None and (wanted := (self.state.run, self._ghost)) != shown:
                run = self.state.measured
                if run is None:
                    return
                found = await asyncio.to_thread(preview_motion, run, wanted[1])
                if self._ghost is not None and self.state.measured is run:
                    self.plots_with_film.draw(plot_data.motion(run, found, f"at {wanted[1]:.3g} Hz"))
                    shown = wanted
        except FrictrackError as e:
            self.state.notify(str(e), is_error=True)
        finally:
            self._busy = False

    # --- what is put into the study

    def _use_cutoff(self) -> None:
        self._edit("cutoff", f"{self.cutoff.value:g} Hz")

    def _edit(self, key: str, value: Any) -> None:
        self.state.do("edit", table="run", which=self.state.run, key=key, value=value)

    def _on_section_moved(self, handle: dict[str, Any]) -> None:
        begin, end = (f"{v:.4g} ms" for v in handle["span"])
        self._edit("free", [begin, end])
