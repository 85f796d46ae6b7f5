"""Describe the diagnosis of the current model: verdict, candidates, formulas, next experiments, where it fails."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from frictrack.base.number_format import describe_change, format_change, format_number, upper_first
from frictrack.flow import ResultsReader, effect_of_formula
from frictrack.present import plots
from frictrack.present.report import (
    CandidateCard,
    candidate_cards,
    inseparable,
    mark_code,
    separating_experiments,
    study_verdict,
)
from frictrack.results import ModelResults, Results, to_builtins
from frictrack.results.candidates import candidate_rows
from frictrack.results.names import AXES
from frictrack.results.verdicts import describe_formula, force_without_effect
from frictrack.study import Study
from frictrack.workbench.plot_data import RESIDUAL_TITLES, PlotData, candidate_columns
from frictrack.workbench.summaries.models import model_errors
from frictrack.workbench.summaries.snapshot import Snapshot

PLOT_OVER = dict(zip(("t", "x", "v"), RESIDUAL_TITLES, strict=True))  # title of the plot over each axis
MAX_FORMULAS = 3


def candidate_curves(snapshot: Snapshot, effect: str) -> PlotData | None:
    """Prepare the curves of the current model with one more effect; nothing is fitted.

    Parameters
    ----------
    snapshot
        The study as its files are.
    effect
        Name of the effect.

    Returns
    -------
    PlotData or None
        The columns "with" (residual) and "F_with" (force, N) for the rows of `comparison_plots`, without plots; in
        `extra`: name, errors and fitted. None if the job
        "attempt" has not fitted the current model with this effect.

    """
    results = snapshot.results
    if snapshot.study is None or results is None or results.current is None:
        return None
    tried = snapshot.attempted.get(effect)
    tried = tried or ResultsReader().attempts(snapshot.study, [effect]).get(effect)  # any effect can be tried
    if tried is None:
        return None
    columns = candidate_columns(results.runs, results.current, tried)
    about = {
        "name": effect,
        "errors": error_change(results.current, tried),
        "fitted": True,
    }
    return PlotData(len(columns["with"]), columns, [], [], to_builtins(about))


def error_change(now: ModelResults, tried: ModelResults) -> dict[str, Any]:
    """Compare the errors of two models: held out if both were predicted, else of the fit.

    Parameters
    ----------
    now, tried
        The current model, and the one with one more effect.

    Returns
    -------
    dict
        "now", "with", "unit" and "words", a sentence.

    """
    before, after = model_errors(now), model_errors(tried)
    predicted = None not in (before["heldout"], after["heldout"]) and before["heldout_unit"] == after["heldout_unit"]
    key, unit, name = ("heldout", "heldout_unit", "Held-out error") if predicted else ("rms", "rms_unit", "Residual")
    first, second = before[key], after[key]
    chi2 = describe_change(before["reduced_chi2"], after["reduced_chi2"])
    words = f"{name} {describe_change(first, second, before[unit])}; reduced chi-squared {chi2}."
    return {"now": first, "with": second, "unit": before[unit], "words": words}


def summarise_diagnosis(snapshot: Snapshot) -> dict[str, Any] | None:
    """Describe the diagnosis of the current model in the words of the report; None before it is made.

    Parameters
    ----------
    snapshot
        The study as its files are.

    Returns
    -------
    dict or None
        Its verdict (see `verdict_of`); candidates as cards; formulas for a force that no effect explains, and a
        sentence on that force (`unexplained`); experiments that would settle it (`next`), and sentences on effects
        that no experiment separates (`next_words`).

    """
    results, study = snapshot.results, snapshot.study
    if results is None or results.diagnosis is None or study is None:
        return None
    found = results.diagnosis
    left = force_without_effect(found) or {}
    cards = candidate_cards(candidate_rows(found))
    return _verdict(results, found) | {
        "candidates": [_card(card, results, snapshot.attempted.get(card.row.effect)) for card in cards],
        "formulas": [_formula(one, study) for one in left.get("formulas", [])[:MAX_FORMULAS]],
        "unexplained": _unexplained(left),
        "next": [_experiment(step) for step in separating_experiments(found)],
        "next_words": [_plain(line) for line in inseparable(found)],
    }


def verdict_of(results: Results, model: ModelResults) -> dict[str, Any] | None:
    """Describe the verdict on a model that was tried; None if it was not diagnosed."""
    if model.diagnosis is None:
        return None
    models = tuple(replace(one, current=one is model) for one in results.models)
    return _verdict(replace(results, models=models, diagnosis=model.diagnosis), model.diagnosis)


def _verdict(results: Results, found: Mapping[str, Any]) -> dict[str, Any]:
    """Describe the verdict on the current model of `results`."""
    verdict = study_verdict(results)
    headline = verdict.headline
    chi2, p = format_number(found["reduced_chi2"]), format_number(found["p_lack_of_fit"], 1)
    repeats = [one["axis"] for one in found.get("repeats") or [] if one["holds"]]
    return {
        "verdict": found["verdict"],
        "title": headline,
        "brief": headline if verdict.kind == "undetermined" else headline.partition(": ")[0],  # for the bar
        "sentences": [str(sentence.striptags()) for sentence in verdict.sentences],
        "numbers": [
            f"Reduced chi-squared {chi2}; p of the lack of fit {p}.",
            *filter(None, [found.get("repeats_words")]),
        ],
        "complete": found.get("complete", True),  # False while only the verdict is known
        "rests_on_repairs": found.get("rests_on_repairs") or None,
        # where the model fails most: over the axis along which the misfit repeats
        "plot": next((PLOT_OVER[axis] for axis in repeats if axis in PLOT_OVER), RESIDUAL_TITLES[0]),
    }


def _plain(text: str) -> str:
    """Return a text without the marks of code in it."""
    return str(mark_code(text).striptags())


def _card(card: CandidateCard, results: Results, tried: ModelResults | None) -> dict[str, Any]:
    row = card.row
    errors = None
    if tried is not None and results.current is not None and not row.added_to:
        errors = error_change(results.current, tried)
    elif row.held_out:
        errors = {"now": row.before, "with": row.after, "unit": row.unit, "words": f"Held-out error {row.held_out}."}
    return {
        "name": row.effect,
        "rank": row.standing,
        "passes": row.passes,
        **{key: str(text.striptags()) for key, text in card.words.items()},
        "rivals": list(card.rivals),
        "numbers": list(card.numbers),
        "fitted": tried is not None,
        "error_with": row.held_out or None,
        "errors": errors,
        "has_scan": bool(plots.has_scan(results.figures.get(row.effect, {}))),
    }


def _unexplained(left: Mapping[str, Any]) -> str | None:
    """A sentence on the force that no effect explains."""
    if not left:
        return None
    if left.get("words"):
        return f"{upper_first(left['words'])}."
    return f"A force that no effect of the library explains repeats best with {AXES[left['axis']].name}."


def _formula(found: Mapping[str, Any], study: Study) -> dict[str, Any]:
    """Describe a formula that can be added to the model as an effect of the study."""
    effect = effect_of_formula(found, [table.effect for table in study.effects])
    share = f"{100 * found['share']:.1f} % of the misfit, evidence {format_change(found['delta_bic'])}"
    words = "; ".join([share, *describe_formula(found)])
    return {"formula": found["formula"], "words": words, "effect": effect, "needs": list(found.get("beside", []))}


def _experiment(step: Mapping[str, Any]) -> dict[str, Any]:
    evidence = step["expected_delta_bic"]
    expected = f"; expected delta BIC at least {format_number(evidence, 2)}" if evidence is not None else ""
    return {"title": _plain(step["what"]), "words": f"Distinguishes {_plain(step['tells'])}{expected}."}
