"""Describe the diagnosis of the current model: verdict, candidates, formulas, next experiments, where it fails."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from frictrack.base.number_format import describe_change, format_change, format_number
from frictrack.flow import ResultsReader, effect_of_formula
from frictrack.present import plots
from frictrack.present.plots.style import BAND_SIGMAS
from frictrack.present.report import (
    CandidateCard,
    candidate_cards,
    inseparable,
    mark_code,
    separating_experiments,
    study_verdict,
)
from frictrack.records import Array
from frictrack.results import ModelResults, Results, to_builtins
from frictrack.results.candidates import CandidateRow, candidate_rows
from frictrack.results.motion_axes import AXES
from frictrack.results.verdicts import describe_formula, force_without_effect
from frictrack.study import Study
from frictrack.workbench.plot_data import (
    FORCE_TITLES,
    RESIDUAL_TITLES,
    PlotData,
    candidate_columns,
    compared_runs,
    comparison_plots,
)
from frictrack.workbench.summaries.models import model_errors
from frictrack.workbench.summaries.snapshot import Snapshot

BINS = 40  # of the horizontal axis of a plot
MIN_COMMON_POWER = 0.05  # of the noise of a frame; a smaller change is hardly seen in any plot
AXES_OF_PLOTS = {
    **dict(zip(RESIDUAL_TITLES, ("t", "x", "v"), strict=True)),
    **dict(zip(FORCE_TITLES, ("t", "v"), strict=True)),
}  # title of a plot -> column of its horizontal axis


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
        `extra`: name, plot (title of the plot in which the curves differ most), errors and fitted. None if the job
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
        "plot": most_changed_plot(results, results.current, columns),
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


def most_changed_plot(results: Results, model: ModelResults, columns: Mapping[str, Array]) -> str:
    """Find the plot in which a candidate changes the picture most.

    The change is averaged over bins of the plot's horizontal axis, run by run, in units of the noise of one frame. What
    counts is the part that the runs have in common: the mean product of the sums of two runs in the same bin. A
    change that belongs to places is common to all runs over the place, and cancels over the time. If no axis has such
    a part, or there is one run, the largest change of the averages counts.

    Parameters
    ----------
    results, model
        The study and its current model.
    columns
        "with" and "F_with"; see `candidate_curves`.

    Returns
    -------
    str
        Title of the plot.

    """
    now = comparison_plots(results, model).columns
    runs = compared_runs(results.runs, model)
    noise, force_noise = now["noise_high"] / BAND_SIGMAS, _force_noise(results, model)
    in_noise = {
        RESIDUAL_TITLES: (columns["with"] - now["left"]) / noise,
        FORCE_TITLES: (columns["F_with"] - now["F_model"]) / force_noise,
    }
    number = np.repeat(np.arange(len(runs)), [len(run.motion) for run in runs])
    changes = {
        title: _binned_change(now[AXES_OF_PLOTS[title]], change, number)
        for titles, change in in_noise.items()
        for title in titles
    }
    for k in (0, 1):
        best = max(changes, key=lambda title: changes[title][k])
        if changes[best][k] > MIN_COMMON_POWER:
            return best
    return RESIDUAL_TITLES[0]


def _force_noise(results: Results, model: ModelResults) -> Array:
    """Standard deviation of the measured force (rows,), N; NaN where no force is known."""
    parts = [
        np.full(len(run.motion), np.nan) if run.friction is None else run.friction.sigma_F
        for run in compared_runs(results.runs, model)
    ]
    return np.concatenate(parts) if parts else np.zeros(0)


def _binned_change(axis: Array, change: Array, run: NDArray[np.int64]) -> tuple[float, float]:
    """Average a change in units of the noise (rows,) over bins of an axis: the power that runs share, and that of each.

    With the sum s of a run in a bin and the count n of all runs there, sum_ij s_i s_j = (sum s)^2 - sum s^2 for i != j.
    """
    known = np.isfinite(axis) & np.isfinite(change)
    if not known.any():
        return 0.0, 0.0
    axis, change, run = axis[known], change[known], run[known]
    bins = np.minimum((BINS * (axis - axis.min()) / (np.ptp(axis) or 1.0)).astype(np.int64), BINS - 1)
    sums, counts = np.zeros((2, int(run.max()) + 1, BINS))
    np.add.at(sums, (run, bins), change)
    np.add.at(counts, (run, bins), 1.0)
    pairs = np.sum(sums, axis=0) ** 2 - np.sum(sums**2, axis=0)
    common = np.sum(pairs / np.maximum(np.sum(counts, axis=0), 1.0))
    return float(common / len(change)), float(np.sum(sums**2 / np.maximum(counts, 1.0)) / len(change))


MAX_FORMULAS = 3


class VerdictSummary(TypedDict):
    """The verdict on one model.

    Attributes
    ----------
    verdict, title, brief
        The kind of verdict, the headline, and its beginning for the bar.
    sentences, numbers
        The paragraph of the report, and the statistics, as sentences.
    complete
        False while only the verdict is known.
    rests_on_repairs
        How far the verdict rests on repaired frames; None if it does not.
    plot
        Title of the plot in which the model fails most.

    """

    verdict: str
    title: str
    brief: str
    sentences: list[str]
    numbers: list[str]
    complete: bool
    rests_on_repairs: str | None
    plot: str


class DiagnosisSummary(VerdictSummary):
    """The diagnosis of the current model.

    Attributes
    ----------
    candidates, formulas
        Candidate effects as cards; formulas for a force that no effect explains.
    unexplained
        A sentence on that force; None if everything is explained.
    next, next_words
        Experiments that would settle it; sentences on effects that no experiment separates.

    """

    candidates: list[dict[str, Any]]
    formulas: list[dict[str, Any]]
    unexplained: str | None
    next: list[dict[str, Any]]
    next_words: list[str]


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
    left = force_without_effect(found) or {}
    summary: DiagnosisSummary = to_builtins(
        DiagnosisSummary(
            **_verdict(results, found),
            candidates=_candidates(results, found, snapshot.attempted),
            formulas=[_formula(one, study) for one in left.get("formulas", [])[:MAX_FORMULAS]],
            unexplained=_unexplained(left),
            next=[_experiment(step) for step in separating_experiments(found)],
            next_words=[_plain(line) for line in inseparable(found)],
        )
    )
    return summary


def verdict_of(results: Results, model: ModelResults) -> VerdictSummary | None:
    """Describe the verdict on a model that was tried; None if it was not diagnosed."""
    if model.diagnosis is None:
        return None
    models = tuple(replace(one, current=one is model) for one in results.models)
    return _verdict(replace(results, models=models, diagnosis=model.diagnosis), model.diagnosis)


def _verdict(results: Results, found: Mapping[str, Any]) -> VerdictSummary:
    """Describe the verdict on the current model of `results`."""
    verdict = study_verdict(results)
    return VerdictSummary(
        verdict=found["verdict"],
        title=verdict.headline,
        brief=verdict.headline.partition(": these runs cannot")[0],
        sentences=[str(sentence.striptags()) for sentence in verdict.sentences],
        numbers=_numbers(found),
        complete=found.get("complete", True),
        rests_on_repairs=found.get("rests_on_repairs") or None,
        plot=_failing_plot(found),
    )


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
        **{key: str(text.striptags()) for key, text in card.words.items()},
        "rivals": list(card.rivals),
        "numbers": list(card.numbers),
        "fitted": tried is not None,
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


# --- next experiments


def _experiment(step: Mapping[str, Any]) -> dict[str, Any]:
    evidence = step["expected_delta_bic"]
    expected = f"; expected delta BIC at least {format_number(evidence, 2)}" if evidence is not None else ""
    return {
        "title": _plain(step["what"]),
        "words": f"Distinguishes {_plain(step['tells'])}{expected}.",
    }
