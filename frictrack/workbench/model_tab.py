"""Show the tab "Model": add, remove and bound effects, fit, and watch a search converge."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import panel as pn

from frictrack.effects import catalogue
from frictrack.flow import user_effects
from frictrack.plots.style import BLUE
from frictrack.report import mark_equation
from frictrack.workbench.effect_blocks import EffectBlocks
from frictrack.workbench.page_state import PageState
from frictrack.workbench.panel_plots import PanelPlots
from frictrack.workbench.plot_data import PlotData, line, plot
from frictrack.workbench.widgets import button, html, note

SEARCHES = ["varpro", "ga", "mga", "sa", "sga", "de", "da", "cmaes"]
MISFIT = re.compile(r"misfit ([-+.\deE]+)")


class ModelTab:
    """The tab: effects of the current model, and the settings of the fit.

    Parameters
    ----------
    state : PageState
        The study.

    """

    title = "3 Model"

    def __init__(self, state: PageState) -> None:
        self.state = state
        self.head = html("")
        self.blocks = EffectBlocks(state)
        self.choice = pn.widgets.Select(label="Effect", options=[], width=220)
        self.words = html("", width=520)
        self.search = pn.widgets.Select(label="Search", options=SEARCHES, width=120)
        self.over = pn.widgets.Select(label="Parameters", options=["all", "nonlinear"], width=120)
        self.seed = pn.widgets.IntInput(label="Seed", value=0, width=80)
        self.text = pn.widgets.TextInput(
            label="Another model", placeholder="tustin, atm1:2, or coulomb, viscous", width=260
        )
        self.chart = PanelPlots(width=640, visible=False)
        self.view = pn.Column(
            self.head,
            self.blocks.view,
            pn.FlexBox(
                self.choice,
                button("Add effect", self._add, "primary"),
                self.words,
                align_items="flex-end",
                gap="10px",
            ),
            pn.FlexBox(
                self.text,
                self.search,
                self.over,
                self.seed,
                button("Fit", self._fit, "primary"),
                align_items="flex-end",
                gap="10px",
            ),
            self.chart,
            sizing_mode="stretch_width",
        )
        self.choice.param.watch(lambda event: self._describe_choice(), "value")
        state.param.watch(self._draw_convergence, "progress")

    def refresh(self) -> None:
        """Show the current model."""
        model = self.state.model
        known = self._library()
        self.blocks.show(known)
        if model is None:
            self.head.object = note("No model is fitted yet. Fit the model of the study file or another one.")
            self.choice.options = []
            return
        self.head.object = f"<p class=ft-verdict>{mark_equation(model.equation)}</p>" + "".join(
            note(remark) for remark in model.summary.get("remarks", [])
        )
        names = model.summary["model"]
        options = [name for name in known if name not in names]
        chosen = self.choice.value if self.choice.value in options else options[0]
        self.choice.param.update(options=options, value=chosen)
        self._describe_choice()

    def _library(self) -> dict[str, dict[str, Any]]:
        """Catalogue entry of each effect by name, with the effects that the study defines."""
        tables = self.state.study.effects if self.state.study else ()
        return {e["name"]: e for e in catalogue(user_effects(tables))}

    def _describe_choice(self) -> None:
        """Describe the chosen effect."""
        found = self._library().get(self.choice.value)
        if found:
            seen = f"Looks like {found['looks_like']}." if found["looks_like"] else found["what"]
            self.words.object = note(f"{found['equation']}. {seen}")

    def _add(self) -> None:
        if self.choice.value:
            self.state.start_job("add", effect=self.choice.value)

    def _fit(self) -> None:
        self.chart.visible = False
        how = {"search": self.search.value, "over": self.over.value, "seed": self.seed.value}
        self.state.start_job("fit", model=(self.text.value or "").strip() or None, **how)

    def _draw_convergence(self, event: Any) -> None:
        """Draw the misfit over the generations of the running search."""
        job = self.state.job
        if job is None or event.new.get("do") != "fit":
            return
        lines = [(line["done"], MISFIT.search(line["what"])) for line in job.progress]
        found = np.array([(k, np.log10(float(m[1]))) for k, m in lines if m])
        if len(found):
            columns = {"generation": found[:, 0], "misfit": found[:, 1]}
            falls = plot(
                "Convergence of the search",
                ("generation", "generation"),
                "log10 misfit",
                line("misfit", BLUE),
                brush="x",
            )
            self.chart.draw(PlotData(len(found), columns, [falls]))
            self.chart.visible = True
