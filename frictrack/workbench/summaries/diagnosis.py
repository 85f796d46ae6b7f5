"""Describe the diagnosis of the current model: verdict, candidates, formulas, next experiments, where it fails."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypedDict

from frictrack import plots
from frictrack.candidates import CandidateRow, candidate_rows
from frictrack.flow import effect_of_formula
from frictrack.motion_axes import AXES
from frictrack.number_format import format_change, format_interval, format_number, format_share
from frictrack.report import mark_code, study_verdict
from frictrack.report.tables import CandidateCard, candidate_cards, inseparable, separating_experiments
from frictrack.results import ModelResults, Results, to_builtins
from frictrack.study import Study
from frictrack.verdicts import describe_formula, describe_verdict, force_without_effect
from frictrack.workbench.plot_data import RESIDUAL_TITLES
from frictrack.workbench.summaries.candidates import error_change
from frictrack.workbench.summaries.repairs import rests_on_repairs
from frictrack.workbench.summaries.snapshot import Snapshot

MAX_FORMULAS = 3


class DiagnosisSummary(TypedDict):
    """The diagnosis of the current model.

    Attributes
    ----------
    verdict, title, words
        The kind of verdict, the headline, and the verdict as one sentence that names the effects.
    sentences, numbers
        The paragraph of the report, and the statistics, as sentences.
    complete
        False while only the verdict is known.
    rests_on_repairs
        How far the verdict rests on repaired frames; None if it does not.
    plot
        Title of the plot in which the model fails most.
    candidates, formulas
        Candidate effects as cards; formulas for a force that no effect explains.
    unexplained
        A sentence on that force; None if everything is explained.
    next, next_words
        Experiments that would settle it; sentences on effects that no experiment separates.
    fails_at
        Spans of time in which the model fails.

    """

    verdict: str
    title: str
    words: str
    sentences: list[str]
    numbers: list[str]
    complete: bool
    rests_on_repairs: str | None
    plot: str
    candidates: list[dict[str, Any]]
    formulas: list[dict[str, Any]]
    unexplained: str | None
    next: list[dict[str, Any]]
    next_words: list[str]
    fails_at: list[dict[str, Any]]


def summarise_diagnosis(snapshot: Snapshot) -> DiagnosisSummary | None:
    """Describe the diagnosis of the current model in the words of the report; None before it is made.

    Parameters
    ----------
    snapshot
        The study as its files are.

    """
    results, study = snapshot.results, snapshot.study
    if results is None or results.diagnosis is None or study is None:
        return None
    found = results.diagnosis
    verdict = study_verdict(results)
    left = force_without_effect(found) or {}
    summary: DiagnosisSummary = to_builtins(
        DiagnosisSummary(
            verdict=found["verdict"],
            title=verdict.headline,
            words=_capitalised(describe_verdict(found)),
            sentences=[str(sentence.striptags()) for sentence in verdict.sentences],
            numbers=_numbers(found),
            complete=found.get("complete", True),
            rests_on_repairs=rests_on_repairs(found),
            plot=_failing_plot(found),
            candidates=_candidates(results, found, snapshot.attempted),
            formulas=[_formula(one, study) for one in left.get("formulas", [])[:MAX_FORMULAS]],
            unexplained=_unexplained(left),
            next=[_experiment(step) for step in separating_experiments(found)],
            next_words=[_plain(line) for line in inseparable(found)],
            fails_at=[_span(span) for span in found.get("fails_at") or [] if span.get("t")],
        )
    )
    return summary


def _capitalised(text: str) -> str:
    return text[:1].upper() + text[1:]


def _plain(text: str) -> str:
    """Return a text without the marks of code in it."""
    return str(mark_code(text).striptags())


def _numbers(found: Mapping[str, Any]) -> list[str]:
    chi2, p = format_number(found["reduced_chi2"]), format_number(found["p_lack_of_fit"], 1)
    repeats = found.get("repeats_words")
    return [f"Reduced chi-squared {chi2}; p of the lack of fit {p}.", *([repeats] if repeats else [])]


# --- candidates


def _candidates(
    results: Results, found: Mapping[str, Any], attempted: Mapping[str, ModelResults]
) -> list[dict[str, Any]]:
    cards = candidate_cards(candidate_rows(found))
    return [_card(card, results, tried=attempted.get(card.row.effect)) for card in cards]


def _card(card: CandidateCard, results: Results, *, tried: ModelResults | None) -> dict[str, Any]:
    row = card.row
    return {
        "name": row.effect,
        "rank": row.standing,
        "passes": row.passes,
        "acts_on": card.acts_on,
        **{key: str(text.striptags()) for key, text in card.words.items()},
        "rivals": list(card.rivals),
        "numbers": list(card.numbers),
        "fitted": tried is not None,
        "delta_bic": row.delta_bic,
        "p": row.source["p"],
        "error_with": row.held_out or None,
        "errors": _errors(row, results, tried),
        "has_scan": bool(plots.has_scan(results.figures.get(row.effect, {}))),
    }


def _errors(row: CandidateRow, results: Results, tried: ModelResults | None) -> dict[str, Any] | None:
    """Return the error now and with a candidate: of the fit that was tried, else of the diagnosis; None if unknown.

    A fit that was tried has this effect alone; one found in addition to others has the error of the diagnosis.
    """
    if tried is not None and results.current is not None and not row.added_to:
        return error_change(results.current, tried)
    if not row.held_out:
        return None
    return {"now": row.before, "with": row.after, "unit": row.unit, "words": f"Held-out error {row.held_out}."}


def _failing_plot(found: Mapping[str, Any]) -> str:
    """Return the title of the plot in which the model fails most: over the axis along which the misfit repeats."""
    repeats = [one["axis"] for one in found.get("repeats") or [] if one["holds"]]
    over = dict(zip(("t", "x", "v"), RESIDUAL_TITLES, strict=True))
    return next((over[axis] for axis in repeats if axis in over), RESIDUAL_TITLES[0])


# --- a force that no effect explains


def _unexplained(left: Mapping[str, Any]) -> str | None:
    if not left:
        return None
    if left.get("words"):
        return f"{_capitalised(left['words'])}."
    return f"A force that no effect of the library explains repeats best with {AXES[left['axis']].name}."


def _formula(found: Mapping[str, Any], study: Study) -> dict[str, Any]:
    """Describe a formula that can be added to the model as an effect of the study."""
    effect = effect_of_formula(found, [table.effect for table in study.effects])
    share = f"{100 * found['share']:.1f} % of the misfit, evidence {format_change(found['delta_bic'])}"
    words = "; ".join([share, *describe_formula(found)])
    return {"formula": found["formula"], "words": words, "effect": effect, "needs": list(found.get("beside", []))}


# --- next experiments, and where the model fails


def _experiment(step: Mapping[str, Any]) -> dict[str, Any]:
    evidence = step["expected_delta_bic"]
    expected = f"; expected delta BIC at least {format_number(evidence, 2)}" if evidence is not None else ""
    return {
        "title": _plain(step["what"]),
        "words": f"Distinguishes {_plain(step['tells'])}{expected}.",
        "separates": list(step["separates"]),
        "kind": step["kind"],
    }


def _span(span: Mapping[str, Any]) -> dict[str, Any]:
    """Describe one span of time in which the model fails."""
    x = span.get("x")
    where = f", x = {format_interval(x, 1e3)} mm" if x else ""
    share = format_share(span["share_of_error"])
    return {
        "run": span["run"],
        "t_ms": [1e3 * end for end in span["t"]],
        "x_mm": [1e3 * end for end in x] if x else None,
        "share": span["share_of_error"],
        "words": f"{span['run']}, {format_interval(span['t'], 1e3)} ms{where}: {share} of the misfit",
    }
