"""Build the tables of fitted parameters: shared values, intervals, and values per run."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from frictrack.number_format import DASH, format_number, format_quantity, format_size, format_unit
from frictrack.report.tables.text_table import TextTable, code_cell, make_table
from frictrack.results import ModelResults

PER_RUN_NAME = re.compile(r"^(?P<name>.+)\[(?P<run>.+)\]$")  # "vibration.phase[v3]"
MAX_FIRST_PARAMETERS = 8  # of the first screen
UNITS_WITH_SCALE_ERROR = ("N", "N s", "m", "m/s")  # in N s/m and N/m the error of the scale cancels


def parameter_table(model: ModelResults, scale_error: float = 0.0) -> TextTable:
    """Table of the parameters that all runs share.

    If the model is rejected, a column marked with a dagger gives the standard deviation that includes the misfit.

    Parameters
    ----------
    model : ModelResults
        The fitted model.
    scale_error : float
        Relative standard deviation of the scale. A column gives its contribution to each parameter.

    """
    rejected = any("std_misfit" in p for p in model.summary["parameters"].values())
    unresolved = {f"{c['effect']}.width" for c in model.summary.get("collisions", []) if not c["resolved"]}
    rows = [
        (
            code_cell(name),
            format_quantity(p["value"], p["std"], p["unit"]),
            *([format_size(p["std_misfit"], p["unit"]) if "std_misfit" in p else ""] if rejected else []),
            _scale_contribution(p, scale_error),
            _remark(p, unresolved=name in unresolved),
        )
        for name, p in model.summary["parameters"].items()
        if not PER_RUN_NAME.match(name)
    ]
    heads = ("parameter", "value", *(["† ± with the misfit"] if rejected else []), "± of the scale", "")
    return make_table(heads, rows, (1, 2, 3) if rejected else (1, 2))


def short_parameter_table(model: ModelResults) -> TextTable:
    """Table of the first shared parameters with one ± each, for the first screen of the report.

    Where the model is rejected, ± includes the effect of the misfit and is marked with a dagger.

    Parameters
    ----------
    model : ModelResults
        The fitted model.

    """
    rows = [
        (
            code_cell(name),
            format_quantity(p["value"], p.get("std_misfit", p["std"]), p["unit"]) + (" †" if "std_misfit" in p else ""),
            _short_remark(p),
        )
        for name, p in shared_parameters(model).items()
    ][:MAX_FIRST_PARAMETERS]
    return make_table(("parameter", "value ± std", ""), rows, (1,))


def shared_parameters(model: ModelResults) -> dict[str, Mapping[str, Any]]:
    """Parameters that all runs share, those that were not fixed first."""
    shared = {name: p for name, p in model.summary["parameters"].items() if not PER_RUN_NAME.match(name)}
    return dict(sorted(shared.items(), key=lambda item: item[1].get("reason") == "fixed"))


def _short_remark(p: Mapping[str, Any]) -> str:
    """The remark as far as it fits into a line; what settles a parameter is in the full table."""
    return _remark(p).split(";")[0].split(":")[0]


def _scale_contribution(p: Mapping[str, Any], scale_error: float) -> str:
    """Error that the common error of the scale causes in a parameter that is proportional to the scale."""
    value = p["value"]
    if not (scale_error and value) or p["unit"] not in UNITS_WITH_SCALE_ERROR or p.get("reason") == "fixed":
        return ""
    return format_size(abs(value) * scale_error, p["unit"])


def _remark(p: Mapping[str, Any], *, unresolved: bool = False) -> str:
    if unresolved:
        return "not resolved: the impulse is known, the peak force is not"
    if p.get("reason"):
        return str(p["reason"])
    if p.get("at_bound"):
        return "at its bound: the true value may lie beyond"
    mu = p.get("mu")
    return "" if mu is None else f"µ = {format_quantity(mu['value'], mu['std'], '1')}"


def interval_table(model: ModelResults) -> TextTable:
    """Table of the standard deviation, the profile interval and the bootstrap interval of every parameter.

    Parameters
    ----------
    model : ModelResults
        The fitted model, with profiles or a bootstrap; parameters with neither are left out.

    """
    summary = model.summary
    profiles, bootstrap = summary.get("profiles", {}), summary.get("bootstrap", {}).get("parameters", {})
    rows = [
        (
            code_cell(name),
            format_quantity(p["value"], p["std"], p["unit"]),
            _interval(profiles[name]["low"], profiles[name]["high"], p["unit"]) if name in profiles else "",
            _interval(bootstrap[name]["interval"][0], bootstrap[name]["interval"][1], p["unit"])
            if name in bootstrap
            else "",
            format_size(bootstrap[name]["std"], p["unit"]) if name in bootstrap else "",
            "; ".join(profiles.get(name, {})[key] for key in ("why_low", "why_high") if key in profiles.get(name, {})),
        )
        for name, p in summary["parameters"].items()
        if (name in profiles or name in bootstrap) and not PER_RUN_NAME.match(name)
    ]
    heads = ("parameter", "value ± std", "95 % by profile", "95 % by bootstrap", "std of the draws", "")
    return make_table(heads, rows, (1, 2, 3, 4))


def _interval(low: float | None, high: float | None, unit: str) -> str:
    """Format an interval whose ends may be open."""
    if low is None and high is None:
        return "any"
    if low is None or high is None:
        return f"below {format_size(high, unit)}" if high is not None else f"above {format_size(low or 0.0, unit)}"
    return f"{format_number(low, 4)} to {format_number(high, 4)} {format_unit(unit)}".strip()


def run_table(model: ModelResults) -> TextTable:
    """Table of the runs of a fit: friction level, noise, errors, and the parameters that differ between runs.

    Parameters
    ----------
    model : ModelResults
        The fitted model.

    """
    per_run: dict[str, dict[str, str]] = {}
    for name, p in model.summary["parameters"].items():
        m = PER_RUN_NAME.match(name)
        if m:
            per_run.setdefault(m["name"], {})[m["run"]] = format_quantity(p["value"], p["std"], p["unit"])
    rows = [
        (
            row["run"],
            "" if row["role"] == "fit" else "predicted, not fitted",
            format_number(row["level"]),
            format_number(row.get("noise_um")),
            format_number(row["errors"].get("rms_displacement_um")),
            format_number(row["errors"].get("free_run_rms_um")),
            format_number(_percent(row["errors"].get("relative_force_error"))),
            str(row["segments"]),
            *(values.get(row["run"], DASH) for values in per_run.values()),
        )
        for row in model.summary["per_run"]
    ]
    errors = ("residual / µm", "free run / µm", "force error / %")
    heads = ("run", "", "friction level", "noise / µm", *errors, "segments", *per_run)
    return make_table(heads, rows, range(2, len(heads)))


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share
