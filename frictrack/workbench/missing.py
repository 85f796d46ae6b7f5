"""Tab 5, what is missing: candidates as cards with their evidence; try one, add it, see the error fall."""

from __future__ import annotations

import tomllib
from functools import partial
from typing import Any

import panel as pn
from markupsafe import Markup, escape

from frictrack import plots
from frictrack.plots import gain, number
from frictrack.report import settle
from frictrack.report.numbers import typed
from frictrack.report.tables import Card, cards
from frictrack.words import verdict
from frictrack.workbench import scenes
from frictrack.workbench.desk import Desk
from frictrack.workbench.films import Bench, Films
from frictrack.workbench.linked import Linked
from frictrack.workbench.widgets import button, figure, grid, heading, html, note

CARDS = 6
FORMULAS = 3


class MissingTab:
    """The verdict on the current model, and the way on from it."""

    title = "5 What is missing?"

    def __init__(self, desk: Desk, films: Films) -> None:
        self.desk, self.bench = desk, Bench(desk, films, Linked(sizing_mode="stretch_width"))
        self.head = html("")
        self.cards = pn.FlexBox(gap="12px", sizing_mode="stretch_width")
        self.falls = pn.Column(sizing_mode="stretch_width")
        self.left = pn.Column(sizing_mode="stretch_width")
        self.next = html("")
        self._made: object = None  # what the cards were made from
        self.diagnose = button("Find what is missing", lambda: desk.start("diagnose"), "primary")
        self.view = pn.Column(
            pn.FlexBox(self.diagnose, gap="10px"),
            self.head,
            self.bench.linked,
            self.left,
            self.cards,
            self.next,
            self.falls,
            sizing_mode="stretch_width",
        )

    def refresh(self) -> None:
        """Show the verdict on the current model."""
        results, model, told = self.desk.results, self.desk.model, self.desk.diagnosis
        self.diagnose.disabled = model is None
        models = results.models if results else ()
        made = (told, [(m.name, m.current, m.summary["errors"]) for m in models])
        new, self._made = made != self._made, made
        if new:
            self.falls.objects = [figure(plots.history(models))] if models else []
        if results is None or model is None or told is None:
            self.head.object = note("The current model was not diagnosed yet.")
            self.left.objects, self.cards.objects, self.next.object = [], [], ""
            self.bench.draw(scenes.Scene())
            return
        self.head.object = _verdict(told)
        if new:  # cards stay while they hold: nobody's click meets one that is being replaced
            figures = results.figures
            self.cards.objects = [self._card(card, figures.get(card.name, {})) for card in cards(told)[:CARDS]]
            self.left.objects = self._unexplained(told.get("unexplained") or {})
            self.next.object = _next(told)
        self.bench.draw(scenes.residual(results, model, self.desk.ghost))

    def _unexplained(self, left: dict[str, Any]) -> list[Any]:
        """The force that no effect explains, and the formulas that may be taken into the law."""
        if not left:
            return []
        parts: list[Any] = [figure(plots.unexplained(left))]
        for formula in left["formulas"][:FORMULAS]:
            share = f"{100 * formula['share']:.1f} % of what is left, evidence {gain(formula['delta_bic'])}"
            beside = formula.get("beside", [])
            after = note(f"beside {', '.join(beside)}: add that first") if beside else ""
            take = button("Take it into the law", partial(self._take, formula["toml"]), disabled=bool(beside))
            parts.append(pn.Row(take, html(note(f"{formula['formula']}: {share}") + after)))
        return parts

    def _take(self, toml: str) -> None:
        """Write a formula into the study file and fit with it."""
        effect = tomllib.loads(toml)["effect"][0]
        assert self.desk.study is not None
        taken = {table.effect for table in self.desk.study.effects}
        names = (f"{effect['effect']}{mark}" for mark in ("", *(f"_{k}" for k in range(2, len(taken) + 3))))
        effect["effect"] = next(name for name in names if name not in taken)
        if self.desk.do("define", effect=effect):
            self.desk.start("add", effect=effect["effect"])

    def _card(self, card: Card, curves: dict[str, Any]) -> pn.Column:
        """A candidate: how sure, what it is, where it shows, how to confirm it."""
        about = {
            "Looks like": card.words["looks_like"],
            "Here": card.words["here"],
            "To confirm": card.words["confirm"],
            "Not told apart from": ", ".join(card.rivals) if card.passes else "",
        }
        lines = [
            Markup("<b>{}</b>").format(card.rank),
            card.words["what"],
            *(Markup("<i>{}</i>: {}").format(head, words) for head, words in about.items() if words),
            Markup("<small>{}</small>").format(Markup("; ").join(card.numbers)),
        ]
        weak = "" if card.passes else " weak"
        words = Markup("<br>").join(filter(None, lines))
        parts: list[Any] = [html(f"<div class='ft-card{weak}'><h3>{escape(card.name)}</h3>{words}</div>")]
        if card.passes and plots.scanned(curves):
            parts.append(figure(plots.scan(card.name, curves, width=5.0)))
        name, kind = card.name, "primary" if card.passes else "default"
        parts.append(
            pn.Row(
                button(f"Try {name}", lambda: self.desk.start("attempt", effect=name)),
                button(f"Add {name}", lambda: self.desk.start("add", effect=name), kind),
            )
        )
        return pn.Column(*parts, width=400)


def _verdict(told: dict[str, Any]) -> str:
    """The verdict in words, and where the failure repeats."""
    said = verdict(told)
    fit = f"reduced chi-squared {number(told['reduced_chi2'])}, p of the lack of fit {number(told['p_lack_of_fit'], 1)}"
    more = [fit, told.get("repeats_words") or "", (told.get("unexplained") or {}).get("words", "")]
    head = f"<p class=ft-verdict>{escape(said[:1].upper() + said[1:])}</p>"
    return head + "".join(note(words) for words in more if words)


def _next(told: dict[str, Any]) -> str:
    """The runs that would settle what these cannot, and what no run can."""
    steps, words = settle.shown(told), "".join(note(typed(line)) for line in settle.hopeless(told))
    menu = grid(settle.experiments(steps)) if steps else ""
    return heading("The next experiment") + menu + words if menu or words else ""
