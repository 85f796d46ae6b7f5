"""Describe the models tried: errors, verdicts; parameters, settings and diagnosis of the current one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

from frictrack.base.glossary import symbols_in
from frictrack.base.number_format import describe_change, format_number, format_p_value, upper_first
from frictrack.effects import catalogue
from frictrack.flow import ResultsReader, effect_of_formula, user_effects
from frictrack.present import plots
from frictrack.present.plots import has_law, residual_unit
from frictrack.present.report import mark_code, study_verdict
from frictrack.results import ModelResults, Results, to_builtins, verdicts
from frictrack.results.candidates import CandidateRow, candidate_rows, held_out_error, numbered_name, parameter_row
from frictrack.search import METHODS
from frictrack.study import EffectTable, Study
from frictrack.workbench.plot_data import RESIDUAL_TITLES, PlotData, candidate_columns
from frictrack.workbench.summaries.snapshot import Snapshot

OUTDATED = {
    "track": "The track of {} is outdated",
    "motion": "The motion of {} is outdated",
    "model": "The model {} is outdated",
    "diagnosis": "The diagnosis of {} is outdated",
    "report": "The report is outdated",
}


def list_outdated(snapshot: Snapshot) -> list[dict[str, Any]]:
    """List everything that is outdated.

    Parameters
    ----------
    snapshot
        The study as its files are.

    Returns
    -------
    list of dict
        what ("track", "motion", "model", "diagnosis" or "report"), name of the run or of the model's group, reason (a
        sentence), and the job that brings it up to date: `update` with "do" and "arguments".

    """
    return [
        {
            "what": part.what,
            "name": part.name,
            "reason": f"{OUTDATED[part.what].format(part.name)}: {part.reason}.",
            "update": {"do": part.command, "arguments": part.arguments},
        }
        for part in (snapshot.results.outdated_parts if snapshot.results else ())
    ]


def report_state(snapshot: Snapshot) -> dict[str, Any]:
    """Return whether the report exists, and why it is outdated (None if it is not)."""
    exists = snapshot.results is not None and (snapshot.results.output / "report.html").exists()
    return {"exists": exists, "outdated": _why_outdated(snapshot, "report") if exists else None}


def _why_outdated(snapshot: Snapshot, what: str, name: str = "") -> str | None:
    return next((one["reason"] for one in list_outdated(snapshot) if (one["what"], one["name"]) == (what, name)), None)


SETTINGS = ("fix", "bounds", "prior", "tie", "per_run")


def list_models(snapshot: Snapshot) -> list[dict[str, Any]]:
    """List the models in the order in which they were tried, each with its errors and its verdict."""
    if (results := snapshot.results) is None:
        return []
    return [
        {
            "group": model.name,
            "label": numbered_name(model.name),
            "current": model.current,
            "effects": list(model.summary["model"]),
            "errors": model_errors(model),
            "equation": model.equation,
            "outdated": _why_outdated(snapshot, "model", model.name),
            "has_law": has_law(model),
            "diagnosis": verdict_of(results, model),
        }
        for model in results.models
    ]


def model_errors(model: ModelResults) -> dict[str, Any]:
    """Select the errors of a model that the page shows: of the residual, and of predicted frames or runs."""
    errors, unit = model.summary["errors"], residual_unit(model)
    rms = errors.get("rms_displacement_um" if unit == "µm" else "rms_N")
    held_out = dict(zip(("heldout", "heldout_unit"), held_out_error(errors), strict=True))
    return {"reduced_chi2": errors.get("reduced_chi2"), "rms": rms, "rms_unit": unit, **held_out}


# --- the current model


def current_model(snapshot: Snapshot) -> dict[str, Any] | None:
    """Describe the current model with its parameters and their settings; None before a fit.

    Parameters
    ----------
    snapshot
        The study as its files are.

    Returns
    -------
    dict
        group, label, equation, symbols (what else stands in it), remarks, has_search (whether a
        global search can be drawn), and effects: name, equation, what, and parameters with name, unit, values (text by
        run, "" for all runs), settings (fix, low, high, prior, tie, per_run) and bounds.

    """
    model = snapshot.results.current if snapshot.results else None
    if model is None or snapshot.study is None:
        return None
    library, misfit = _library(snapshot.study.effects), model.summary.get("misfit")
    return {
        "group": model.name,
        "label": numbered_name(model.name),
        "equation": model.equation,
        "symbols": symbols_in(model.equation),
        "remarks": [*model.summary.get("remarks", []), *([f"† {misfit['words']}."] if misfit else [])],
        "has_search": bool(model.convergence),
        "effects": [_effect(name, library, model, snapshot.study) for name in model.summary["model"]],
    }


def effect_library(study: Study | None) -> list[dict[str, Any]]:
    """Return the catalogue of effects, with those that the study defines, if there is one."""
    return list(_library(study.effects if study else ()).values())


def searches(study: Study | None) -> dict[str, Any]:
    """Return the settings of every search by name, each with its default, and the study file's search and `over`."""
    own: dict[str, Any] = {"search": "varpro", "over": "all", "settings": {}}
    own |= study.search.request if study and study.search else {}
    known: dict[str, Any] = {"varpro": {}} | {name: kind.describe_settings() for name, kind in METHODS.items()}
    for name, value in own["settings"].items():
        known[own["search"]][name]["default"] = value
    return {"known": known, "search": own["search"], "over": own["over"]}


def _library(tables: Sequence[EffectTable]) -> dict[str, dict[str, Any]]:
    """Return the entry of the catalogue by name of the effect."""
    return _catalogue(tuple(table.model_dump_json() for table in tables))


@lru_cache(maxsize=8)
def _catalogue(tables: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    own = user_effects([EffectTable.model_validate_json(table) for table in tables])
    return {entry["name"]: entry for entry in catalogue(own)}


def _effect(name: str, library: Mapping[str, Any], model: ModelResults, study: Study) -> dict[str, Any]:
    entry = library.get(name) or library.get(name.split(":", maxsplit=1)[0], {})
    given = {parameter["name"]: parameter for parameter in entry.get("parameters", [])}
    values, own = _values(model, name), next((table for table in study.effects if table.effect == name), None)
    parameters = []
    for parameter in dict.fromkeys((*values, *given)):
        about, fitted = given.get(parameter), values.get(parameter, {})
        settings = {key: getattr(own, key).get(parameter) if own else None for key in SETTINGS}
        low, high = settings.pop("bounds") or (None, None)
        parameters.append(
            {
                "name": parameter,
                "unit": about["unit"] if about else next(iter(fitted.values()))["unit"],
                "values": {run: value_text(value) for run, value in fitted.items()},
                "settings": settings | {"low": low, "high": high},
                "bounds": about["bounds"] if about else None,
            }
        )
    return {"name": name, "parameters": parameters} | {key: entry.get(key, "") for key in ("equation", "what")}


def _values(model: ModelResults, effect: str) -> dict[str, dict[str, Any]]:
    """Return the fitted values of an effect: by parameter, then by run ("" for all runs)."""
    out: dict[str, dict[str, Any]] = {}
    for full, value in model.summary["parameters"].items():
        address, _, run = full.partition("[")
        owner, _, parameter = address.rpartition(".")
        if owner == effect:
            out.setdefault(parameter, {})[run.rstrip("]")] = value
    return out


def value_text(value: Mapping[str, Any]) -> str:
    """Write a fitted value with its standard deviation, and why it is not determined."""
    row = parameter_row(value)
    remark = row.remark.replace("µ = ", "µ =\N{NO-BREAK SPACE}").replace(" ± ", "\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}")
    return f"{row.short}{', ' * bool(remark)}{remark}"


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
    about = {"name": effect, "errors": error_change(results.current, tried), "fitted": True}
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
    left, steps = verdicts.force_without_effect(found) or {}, verdicts.next_experiments(found)
    useful = [step for step in steps if step.separates]
    return _verdict(results, found) | {
        "candidates": [_card(row, results, snapshot.attempted.get(row.effect)) for row in candidate_rows(found)],
        "formulas": [_formula(one, study) for one in left.get("formulas", [])[:MAX_FORMULAS]],
        "unexplained": f"{upper_first(verdicts.describe_unexplained(left))}." if left else None,
        "next": [{"title": _plain(step.what), "words": f"{upper_first(_plain(step.words))}."} for step in useful],
        "next_words": [_plain(step.what) for step in steps if not step.separates],
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
    chi2, p = format_number(found["reduced_chi2"]), format_p_value(found["p_lack_of_fit"])
    repeats = [one["axis"] for one in found.get("repeats") or [] if one["holds"]]
    numbers = [f"Reduced chi-squared {chi2}; lack of fit: p {p}.", found.get("repeats_words")]
    return {
        "verdict": found["verdict"],
        "title": headline,
        "brief": headline if verdict.kind == "undetermined" else headline.partition(": ")[0],  # for the bar
        "sentences": [str(sentence.striptags()) for sentence in verdict.sentences],
        "numbers": [line for line in numbers if line],
        "complete": found.get("complete", True),  # False while only the verdict is known
        "rests_on_repairs": found.get("rests_on_repairs") or None,
        # where the model fails most: over the axis along which the misfit repeats
        "plot": next((PLOT_OVER[axis] for axis in repeats if axis in PLOT_OVER), RESIDUAL_TITLES[0]),
    }


def _plain(text: str) -> str:
    """Return a text without the marks of code in it."""
    return str(mark_code(text).striptags())


def _card(row: CandidateRow, results: Results, tried: ModelResults | None) -> dict[str, Any]:
    errors = None
    if tried is not None and results.current is not None and not row.added_to:
        errors = error_change(results.current, tried)
    elif row.held_out:
        errors = {"now": row.before, "with": row.after, "unit": row.unit, "words": f"Held-out error {row.held_out}."}
    return {
        "name": row.effect,
        "rank": row.standing,
        "passes": row.passes,
        **{key: _plain(row.source["words"].get(key, "")) for key in ("what", "looks_like", "here", "confirm")},
        "rivals": row.rivals,
        "numbers": [*row.parameters, *row.numbers],
        "fitted": tried is not None,
        "error_with": row.held_out or None,
        "errors": errors,
        "has_scan": bool(plots.has_scan(results.figures.get(row.effect, {}))),
    }


def _formula(found: Mapping[str, Any], study: Study) -> dict[str, Any]:
    """Describe a formula that can be added to the model as an effect of the study."""
    effect = effect_of_formula(found, [table.effect for table in study.effects])
    words = "; ".join([verdicts.formula_evidence(found), *verdicts.describe_formula(found)])
    return {"formula": found["formula"], "words": words, "effect": effect, "needs": list(found.get("beside", []))}
