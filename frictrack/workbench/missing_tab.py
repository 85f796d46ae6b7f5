"""Show the tab "What is missing?": candidate effects as cards, to try and to add."""

from __future__ import annotations

import tomllib
from functools import partial
from typing import Any

import panel as pn
from markupsafe import Markup, escape

from frictrack import plots
from frictrack.number_format import format_change, format_number
from frictrack.report import mark_code
from frictrack.report.tables import (
    CandidateCard,
    candidate_cards,
    experiment_table,
    inseparable,
    separating_experiments,
)
from frictrack.verdicts import VERDICT_ONLY, describe_verdict
from frictrack.workbench import plot_data
from frictrack.workbench.page_state import PageState
from frictrack.workbench.panel_plots import PanelPlots
from frictrack.workbench.plots_with_film import OpenFilms, PlotsWithFilm
from frictrack.workbench.widgets import button, figure, grid, heading, html, note

MAX_CARDS = 6
MAX_FORMULAS = 3


class MissingTab:
    """The tab: verdict on the current model, candidates, next experiment, held-out errors.

    Parameters
    ----------
    state : PageState
        The study.
    films : OpenFilms
        Its films.

    """

    title = "5 What is missing?"

    def __init__(self, state: PageState, films: OpenFilms) -> None:
        self.state, self.plots_with_film = state, PlotsWithFilm(state, films, PanelPlots(sizing_mode="stretch_width"))
        self.head = html("")
        self.cards = pn.FlexBox(gap="12px", sizing_mode="stretch_width")
        self.history = pn.Column(sizing_mode="stretch_width")
        self.unexplained = pn.Column(sizing_mode="stretch_width")
        self.next_experiment = html("")
        self._shown: object = None  # what the cards were made from
        self.diagnose = button("Find what is missing", lambda: state.start_job("diagnose"), "primary")
        self.view = pn.Column(
            pn.FlexBox(self.diagnose, gap="10px"),
            self.head,
            self.plots_with_film.linked,
            self.unexplained,
            self.cards,
            self.next_experiment,
            self.history,
            sizing_mode="stretch_width",
        )

    def refresh(self) -> None:
        """Show the verdict on the current model."""
        results, model, diagnosis = self.state.results, self.state.model, self.state.diagnosis
        self.diagnose.disabled = model is None
        models = results.models if results else ()
        made = (diagnosis, [(m.name, m.current, m.summary["errors"]) for m in models])
        new, self._shown = made != self._shown, made
        if new:
            self.history.objects = [figure(plots.history(models))] if models else []
        if results is None or model is None or diagnosis is None:
            self.head.object = note("The current model is not diagnosed yet.")
            self.unexplained.objects, self.cards.objects, self.next_experiment.object = [], [], ""
            self.plots_with_film.draw(plot_data.PlotData())
            return
        self.head.object = _verdict_html(diagnosis)
        if new:  # unchanged cards are not replaced: a click could be lost
            figures = results.figures
            self.cards.objects = [
                self._card(card, figures.get(card.name, {})) for card in candidate_cards(diagnosis)[:MAX_CARDS]
            ]
            self.unexplained.objects = self._formula_rows(diagnosis.get("unexplained") or {})
            self.next_experiment.object = _next_experiment_html(diagnosis)
        self.plots_with_film.draw(plot_data.residual_plots(results, model, self.state.attempted))

    def _formula_rows(self, left: dict[str, Any]) -> list[Any]:
        """The force that no effect explains, and formulas that can be added to the model."""
        if not left:
            return []
        parts: list[Any] = [figure(plots.unexplained(left))]
        for formula in left["formulas"][:MAX_FORMULAS]:
            share = f"{100 * formula['share']:.1f} % of the misfit, evidence {format_change(formula['delta_bic'])}"
            also_needed = formula.get("beside", [])
            after = note(f"needs {', '.join(also_needed)}: add it first") if also_needed else ""
            take = button(
                "Add it to the model", partial(self._add_formula, formula["toml"]), disabled=bool(also_needed)
            )
            parts.append(pn.Row(take, html(note(f"{formula['formula']}: {share}") + after)))
        return parts

    def _add_formula(self, toml: str) -> None:
        """Write a formula into the study file and fit with it."""
        effect = tomllib.loads(toml)["effect"][0]
        assert self.state.study is not None
        taken = {table.effect for table in self.state.study.effects}
        names = (f"{effect['effect']}{mark}" for mark in ("", *(f"_{k}" for k in range(2, len(taken) + 3))))
        effect["effect"] = next(name for name in names if name not in taken)
        if self.state.apply_change("define", effect=effect):
            self.state.start_job("add", effect=effect["effect"])

    def _card(self, card: CandidateCard, curves: dict[str, Any]) -> pn.Column:
        """Card of a candidate: its rank, what it is, where it shows, how to confirm it."""
        about = {
            "Looks like": card.words["looks_like"],
            "Here": card.words["here"],
            "To confirm": card.words["confirm"],
            "Not distinguished from": ", ".join(card.rivals) if card.passes else "",
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
        if card.passes and plots.has_scan(curves):
            parts.append(figure(plots.scan(card.name, curves, width=5.0)))
        name, kind = card.name, "primary" if card.passes else "default"
        parts.append(
            pn.Row(
                button(f"Try {name}", lambda: self.state.start_job("attempt", effect=name)),
                button(f"Add {name}", lambda: self.state.start_job("add", effect=name), kind),
            )
        )
        return pn.Column(*parts, width=400)


def _verdict_html(diagnosis: dict[str, Any]) -> str:
    """The verdict, and with what the misfit repeats, as HTML."""
    message = describe_verdict(diagnosis)
    chi2, p = format_number(diagnosis["reduced_chi2"]), format_number(diagnosis["p_lack_of_fit"], 1)
    fit = f"reduced chi-squared {chi2}, p of the lack of fit {p}"
    more = [fit, diagnosis.get("repeats_words") or "", (diagnosis.get("unexplained") or {}).get("words", "")]
    if not diagnosis.get("complete", True):
        more.append(mark_code(VERDICT_ONLY))
    head = f"<p class=ft-verdict>{escape(message[:1].upper() + message[1:])}</p>"
    return head + "".join(note(words) for words in more if words)


def _next_experiment_html(diagnosis: dict[str, Any]) -> str:
    """The proposed experiments as HTML."""
    steps = separating_experiments(diagnosis)
    words = "".join(note(mark_code(line)) for line in inseparable(diagnosis))
    menu = grid(experiment_table(steps)) if steps else ""
    return heading("Next experiments") + menu + words if menu or words else ""
