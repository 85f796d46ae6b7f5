"""Tab 5, what is missing: candidates as cards with their evidence; try one, add it, see the error fall."""

from __future__ import annotations

from html import escape
from typing import Any

import panel as pn

from frictrack import plots
from frictrack.plots import gain, number
from frictrack.workbench import scenes
from frictrack.workbench.desk import Desk
from frictrack.workbench.films import Films
from frictrack.workbench.linked import Linked
from frictrack.workbench.widgets import button, figure, heading, html, note, table

CARDS = 6
VERDICTS = {
    "complete": "Complete: nothing that the library knows is missing, as far as these runs can show.",
    "missing": "Missing: {names}.",
    "ambiguous": "Something is missing; these runs cannot tell which of a group: {names}.",
    "unexplained": "Something is missing that no effect of the library explains.",
}


class MissingTab:
    """The verdict on the current model, and the way on from it."""

    title = "5 What is missing?"

    def __init__(self, desk: Desk, films: Films) -> None:
        self.desk, self.films = desk, films
        self.head = html("")
        self.cards = pn.FlexBox(gap="12px", sizing_mode="stretch_width")
        self.linked = Linked(sizing_mode="stretch_width")
        self.scene = scenes.Scene()
        self.falls = pn.Column(sizing_mode="stretch_width")
        self.next = html("")
        self.diagnose = button("Find what is missing", lambda: desk.start("diagnose"), "primary")
        self.view = pn.Column(
            pn.FlexBox(self.diagnose, gap="10px"),
            self.head,
            self.linked,
            self.cards,
            self.next,
            self.falls,
            sizing_mode="stretch_width",
        )
        self.linked.param.watch(self._selected, "selection")
        self.linked.param.watch(self._wanted, "want")

    def refresh(self) -> None:
        """Show the verdict on the current model."""
        results, model, told = self.desk.results, self.desk.model, self.desk.diagnosis
        self.diagnose.disabled = model is None
        self.falls.objects = [figure(plots.history(results.models))] if results and results.models else []
        if results is None or model is None or told is None:
            self.head.object = note("The current model was not diagnosed yet.")
            self.cards.objects, self.next.object = [], ""
            self.linked.draw(scenes.Scene())
            self.linked.film = {}
            return
        self.head.object = _verdict(told)
        figures = results.figures
        self.cards.objects = [self._card(c, figures.get(c["effect"], {})) for c in told["candidates"][:CARDS]]
        self.next.object = _next(told)
        self.scene = scenes.residual(results, model, self.desk.ghost)
        self.linked.draw(self.scene)

    def _card(self, c: dict[str, Any], curves: dict[str, Any]) -> pn.Column:
        """A candidate: how sure, what it is, where it shows, how to confirm it."""
        words, good = c.get("words", {}), plots.passes(c)
        held = c.get("heldout_rms_before_um"), c.get("heldout_rms_after_um")
        fall = f"held-out error {number(held[0])} → {number(held[1])} µm" if None not in held else ""
        rivals = ", ".join(c["indistinguishable_from"])
        lines = [
            f"<h3>{escape(c['effect'])}</h3>",
            f"<b>evidence {gain(c['delta_bic'])}</b> (delta BIC), p = {number(c['p'], 1)}"
            + (f"; {fall}" if fall else ""),
            escape(words.get("what", "")),
            f"<i>Looks like</i> {escape(words['looks_like'])}" if words.get("looks_like") else "",
            f"<i>To confirm</i>: {escape(words['confirm'])}" if words.get("confirm") else "",
            f"<i>Cannot be told apart from</i> {escape(rivals)}" if rivals else "",
        ]
        parts: list[Any] = [
            html(f"<div class='ft-card{'' if good else ' weak'}'>{'<br>'.join(part for part in lines if part)}</div>")
        ]
        if good and plots.scanned(curves):
            parts.append(figure(plots.scan(c["effect"], curves, width=5.0)))
        name = c["effect"]
        parts.append(
            pn.Row(
                button(f"Try {name}", lambda: self.desk.start("attempt", effect=name)),
                button(f"Add {name}", lambda: self.desk.start("add", effect=name), "primary" if good else "default"),
            )
        )
        return pn.Column(*parts, width=400)

    def _selected(self, event: Any) -> None:
        if event.new.get("middle") is not None:
            run, frame = self.scene.place(int(event.new["middle"]))
            self.films.show(self.linked, run, frame, self.scene)

    def _wanted(self, event: Any) -> None:
        self.films.show(self.linked, self.linked.film["label"], int(event.new["frame"]), self.scene)


def _verdict(told: dict[str, Any]) -> str:
    """The verdict in words, and where the failure repeats."""
    group = told["missing"] or []
    rivals = told["candidates"][0]["indistinguishable_from"] if told["candidates"] else []
    names = ", ".join([*group, *(r for r in rivals if told["verdict"] == "ambiguous" and r not in group)])
    said = VERDICTS[told["verdict"]].format(names=names)
    fit = f"reduced chi-squared {number(told['reduced_chi2'])}, p of the lack of fit {number(told['p_lack_of_fit'], 1)}"
    more = [fit, told.get("repeats_words") or "", (told.get("unexplained") or {}).get("words", "")]
    return f"<p class=ft-verdict>{escape(said)}</p>" + "".join(note(words) for words in more if words)


def _next(told: dict[str, Any]) -> str:
    """The runs that would settle what these cannot."""
    rows = [
        (e["what"], ", ".join(e.get("separates", [])), number(e.get("expected_delta_bic")))
        for e in told.get("next_experiment") or []
    ]
    if not rows:
        return ""
    return heading("The next experiment") + table(("run", "tells apart", "expected evidence"), rows, (2,))
