"""Tab 2, the motion: x, v, a and F with their bands, the cut-off with its price, the free section by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import panel as pn

from frictrack import plots
from frictrack.workbench import scenes
from frictrack.workbench.desk import Desk
from frictrack.workbench.films import Bench, Films
from frictrack.workbench.linked import Linked
from frictrack.workbench.widgets import button, figure, html, note


class MotionTab:
    """The smoothed motion of one run, and the two choices that it rests on."""

    title = "2 Motion"

    def __init__(self, desk: Desk, films: Films) -> None:
        self.desk, self.bench = desk, Bench(desk, films, Linked(sizing_mode="stretch_width"))
        self.cutoff = pn.widgets.DiscreteSlider(label="Cut-off of a plain low-pass / Hz", options=[1.0], width=420)
        self.price = html("")
        self.words = html("")
        self.trade = pn.Column(sizing_mode="stretch_width")
        self.view = pn.Column(
            self.words,
            pn.FlexBox(
                pn.Column(self.cutoff, self.price),
                button("Use this cut-off", self._cut),
                button("Trend, vibrations and events by themselves", lambda: self._edit("cutoff", None)),
                button("Find the free section by itself", lambda: self._edit("free", None)),
                button("Bring up to date", lambda: desk.start("measure", stage="friction"), "primary"),
                align_items="flex-end",
                gap="10px",
            ),
            self.bench.linked,
            self.trade,
            sizing_mode="stretch_width",
        )
        self.cutoff.param.watch(lambda event: self._priced(), "value")
        self.bench.linked.listen("moved", self._moved)

    def refresh(self) -> None:
        """Show the run that is looked at."""
        run = self.desk.measured
        self.bench.draw(scenes.motion(run) if run else scenes.Scene(), self.desk.run)
        if run is None:
            self.words.object = note("This run is not measured to its end yet: bring it up to date.")
            self.trade.objects = []
            return
        free = run.friction.reason if run.friction else "without a mass there is no force"
        self.words.object = note(f"Free section: {free}. {run.filtered.reason}. Drag its green handles to change it.")
        if run.cutoff is not None:
            self.cutoff.options = [float(np.round(f, 1)) for f in run.cutoff.frequency]
            wanted = run.settings.get("cutoff") or run.cutoff.chosen
            self.cutoff.value = min(self.cutoff.options, key=lambda f: abs(f - wanted))
            self._priced()
            self.trade.objects = [figure(plots.cutoff(run.name, run.cutoff, run.mass))]

    def _priced(self) -> None:
        """What a cut-off costs: noise that it lets pass, detail that it takes away."""
        run = self.desk.measured
        if run is None or run.cutoff is None:
            return
        noise, lost = run.cutoff.at(float(self.cutoff.value))
        factor, unit = (run.mass, "N") if run.mass else (1.0, "m/s²")
        self.price.object = note(
            f"noise that passes {noise * factor:.3g} {unit}, detail that is lost {lost * factor:.3g} {unit}; parted by "
            f"themselves: {run.cutoff.structural * factor:.3g} {unit} in all"
        )

    def _cut(self) -> None:
        self._edit("cutoff", f"{self.cutoff.value:g} Hz")

    def _edit(self, key: str, value: Any) -> None:
        self.desk.do("edit", table="run", which=self.desk.run, key=key, value=value)

    def _moved(self, handle: dict[str, Any]) -> None:
        begin, end = (f"{v:.4g} ms" for v in handle["span"])
        self._edit("free", [begin, end])
