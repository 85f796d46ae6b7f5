"""Tab 3, the model: its effects as blocks with their equation; add, remove, fix, bound; watch a search converge."""

from __future__ import annotations

import re
from html import escape
from typing import Any

import numpy as np
import panel as pn

from frictrack import plots
from frictrack.effects import catalogue
from frictrack.flow import own_effects
from frictrack.plots import number
from frictrack.plots.style import BLUE
from frictrack.report.numbers import formula
from frictrack.workbench.desk import Desk
from frictrack.workbench.linked import Linked
from frictrack.workbench.scenes import Scene, line, plot
from frictrack.workbench.widgets import button, html, note

SEARCHES = ["varpro", "ga", "mga", "sa", "sga", "de", "da", "cmaes"]
MISFIT = re.compile(r"misfit ([-+.\deE]+)")


class ModelTab:
    """Blocks of the current model, and how it is fitted."""

    title = "3 Model"

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self.head = html("")
        self.blocks = pn.FlexBox(gap="12px", sizing_mode="stretch_width")
        self.choice = pn.widgets.Select(label="Effect", options=[], width=220)
        self.words = html("", width=520)
        self.search = pn.widgets.Select(label="Search", options=SEARCHES, width=120)
        self.over = pn.widgets.Select(label="looks for", options=["all", "nonlinear"], width=120)
        self.seed = pn.widgets.IntInput(label="Seed", value=0, width=80)
        self.text = pn.widgets.TextInput(
            label="Another model", placeholder="tustin, atm1:2, or coulomb, viscous", width=260
        )
        self.chart = Linked(width=640, visible=False)
        self.view = pn.Column(
            self.head,
            self.blocks,
            pn.FlexBox(
                self.choice,
                button("Add it", self._add, "primary"),
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
        self.choice.param.watch(lambda event: self._told(), "value")
        desk.param.watch(self._converging, "busy")

    def refresh(self) -> None:
        """Show the model that is current now."""
        model = self.desk.model
        known = self._library()
        if model is None:
            self.head.object = note("No model was fitted yet. Fit the one of the study file, or another one.")
            self.blocks.objects = []
            self.choice.options = []
            return
        self.head.object = f"<p class=ft-verdict>{formula(model.equation)}</p>" + "".join(
            note(remark) for remark in model.summary.get("remarks", [])
        )
        names = model.summary["model"]
        self.blocks.objects = [self._block(name, known.get(name.split(":")[0], {})) for name in names]
        self.choice.options = [name for name in known if name not in names]
        self.choice.value = self.choice.options[0]
        self._told()

    def _library(self) -> dict[str, dict[str, Any]]:
        """Every effect that can be chosen, the study's own among them."""
        tables = self.desk.study.effects if self.desk.study else ()
        return {e["name"]: e for e in catalogue(own_effects(tables))}

    def _written(self, effect: str, key: str) -> dict[str, Any]:
        """What the study file says of an effect's parameters."""
        tables = self.desk.study.effects if self.desk.study else ()
        return next((dict(getattr(t, key)) for t in tables if t.effect == effect), {})

    def _block(self, name: str, told: dict[str, Any]) -> pn.Column:
        """One effect: its equation, and every parameter with what is known of it."""
        rows: list[Any] = []
        assert self.desk.model is not None
        for full, value in self.desk.model.summary["parameters"].items():
            effect, _, parameter = full.rpartition(".")
            if effect == name and "[" not in parameter:
                rows.append(self._parameter(name, parameter, value, told))
        return pn.Column(
            html(f"<h3 class=ft-h>{escape(name)}</h3>" + f"<p class=ft-note>{formula(told.get('equation', ''))}</p>"),
            *rows,
            button(f"Remove {name}", lambda: self.desk.start("remove", effect=name)),
            width=400,
            styles={"border": "1px solid #c8c8c8", "border-top": "5px solid #0072b2", "padding": "8px"},
        )

    def _parameter(self, effect: str, name: str, value: dict[str, Any], told: dict[str, Any]) -> pn.Column:
        """A value with its standard deviation; a number in `fixed at` holds it, two in `between` bound it."""
        held, bounds = (self._written(effect, key).get(name) for key in ("fix", "bounds"))
        default = next((p["bounds"] for p in told.get("parameters", []) if p["name"] == name), None)
        fix = pn.widgets.TextInput(label="fixed at", value="" if held in (None, False) else f"{held:g}", width=90)
        low, high = (
            pn.widgets.TextInput(label=label, value="" if bounds is None else f"{bounds[i]:g}", width=90)
            for i, label in enumerate(("at least", "at most"))
        )
        fix.param.watch(lambda e: self._set(effect, "fix", name, _floats(e.new)), "value")
        for box in (low, high):
            box.param.watch(lambda e: self._bound(effect, name, (low.value, high.value), default), "value")
        said = number(value["value"]) if value["value"] is not None else "not determined"
        error = f" ± {number(value['std'], 2)}" if value.get("std") else ""
        reason = f" ({value['reason']})" if value.get("reason") else ""
        return pn.Column(
            html(f"<b>{formula(name)}</b> = {said}{error} {escape(plots.unit(value['unit']))}{escape(reason)}"),
            pn.Row(fix, low, high),
        )

    def _bound(self, effect: str, name: str, written: tuple[str | None, str | None], default: Any) -> None:
        """Both bounds together; one that is left empty is the library's."""
        sides = [_floats(text) for text in written]
        if all(side is None for side in sides):
            return self._set(effect, "bounds", name, None)
        wide = default or [None, None]
        filled = [side if side is not None else wide[i] for i, side in enumerate(sides)]
        if any(side is None for side in filled):
            return self.desk.tell(f"give both bounds of {effect}.{name}: it has none of its own on that side")
        return self._set(effect, "bounds", name, filled)

    def _set(self, effect: str, key: str, name: str, value: Any) -> None:
        """What the study file says of one parameter; the next fit heeds it."""
        old = self._written(effect, key)
        new = {**old, name: value} if value is not None else {k: v for k, v in old.items() if k != name}
        if new != old:
            plain = {k: list(v) if isinstance(v, tuple) else v for k, v in new.items()}
            self.desk.do("edit", table="effect", which=effect, key=key, value=plain or None)

    def _told(self) -> None:
        """What the chosen effect is."""
        found = self._library().get(self.choice.value)
        if found:
            self.words.object = note(f"{found['equation']}. Looks like {found['looks_like']}.")

    def _add(self) -> None:
        if self.choice.value:
            self.desk.start("add", effect=self.choice.value)

    def _fit(self) -> None:
        self.chart.visible = False
        how = {"search": self.search.value, "over": self.over.value, "seed": self.seed.value}
        self.desk.start("fit", model=(self.text.value or "").strip() or None, **how)

    def _converging(self, event: Any) -> None:
        """Draw on what the work says of its generations."""
        job = self.desk.job
        if job is None or event.new.get("do") != "fit":
            return
        lines = [(told["done"], MISFIT.search(told["what"])) for told in job.progress]
        found = np.array([(k, np.log10(float(m[1]))) for k, m in lines if m])
        if len(found):
            columns = {"generation": found[:, 0], "misfit": found[:, 1]}
            falls = plot(
                "How the search converges",
                ("generation", "generation"),
                "log10 misfit",
                line("misfit", BLUE),
                brush="x",
            )
            self.chart.draw(Scene(len(found), columns, [falls]))
            self.chart.visible = True


def _floats(text: str | None) -> float | None:
    """A number, or none."""
    try:
        return float(text or "")
    except ValueError:
        return None
