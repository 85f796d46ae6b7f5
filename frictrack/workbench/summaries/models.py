"""Describe the models tried: their errors, and the parameters and settings of the current one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

from frictrack.base.glossary import symbols_in
from frictrack.effects import catalogue
from frictrack.flow import user_effects
from frictrack.present.plots import has_law, residual_unit
from frictrack.results import ModelResults, Results
from frictrack.results.names import numbered_name
from frictrack.results.rows import held_out_error, parameter_row
from frictrack.search import METHODS
from frictrack.study import EffectTable, Study
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


def list_models(snapshot: Snapshot, verdict_of: Callable[[Results, ModelResults], Any]) -> list[dict[str, Any]]:
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
    heldout, heldout_unit = held_out_error(errors)
    return {
        "reduced_chi2": errors.get("reduced_chi2"),
        "rms": errors.get("rms_displacement_um" if unit == "µm" else "rms_N"),
        "rms_unit": unit,
        "heldout": heldout,
        "heldout_unit": heldout_unit,
    }


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
    return {
        "name": name,
        "equation": entry.get("equation", ""),
        "what": entry.get("what", ""),
        "parameters": parameters,
    }


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
