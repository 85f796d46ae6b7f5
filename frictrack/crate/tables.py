"""Write the parameters of all models, and the uncertainty budget of every run, as CSV with codes of the units.

References
----------
JCGM 100:2008, Guide to the expression of uncertainty in measurement (GUM), sections 5 and 6.2.

"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from typing import Any

from frictrack.crate.unit_codes import unit_code
from frictrack.results import Results

COVERAGE_FACTOR = 2  # of the expanded uncertainty: about 95 % of a normal distribution
TOTAL = "total"  # source of the last row of `frictrack.error_budget`
PARAMETERS, BUDGET = "parameters.csv", "uncertainty_budget.csv"
PARAMETER_COLUMNS = (
    *("model", "current", "parameter", "value", "standard_uncertainty", "standard_uncertainty_misfit"),
    *("interval_low", "interval_high", "unit", "ucum", "qudt", "reason"),
)
BUDGET_COLUMNS = (
    *("run", "quantity", "estimate_N", "source", "input_standard_uncertainty", "input_unit", "input_ucum"),
    *("contribution_mean_N", "share_of_variance_mean", "contribution_frame_N", "share_of_variance_frame"),
    *("common_to", "known_from"),
)


def parameter_rows(results: Results) -> Iterator[dict[str, Any]]:
    """Yield one row per parameter of every model.

    Parameters
    ----------
    results
        Results of a study.

    """
    for model in results.models:
        for name, found in model.summary["parameters"].items():
            code = unit_code(found["unit"])
            low, high = found.get("interval") or (None, None)
            yield {
                "model": model.name,
                "current": model.current,
                "parameter": name,
                "value": found["value"],
                "standard_uncertainty": found["std"],
                "standard_uncertainty_misfit": found.get("std_misfit"),
                "interval_low": low,
                "interval_high": high,
                "unit": found["unit"],
                "ucum": code.ucum,
                "qudt": code.address,
                "reason": found["reason"],
            }


def budget_rows(results: Results) -> Iterator[dict[str, Any]]:
    """Yield the budget of every run: one row per source, then combined and expanded uncertainty; empty is unknown.

    Parameters
    ----------
    results
        Results of a study.

    """
    for run in results.runs:
        for row in run.budget.get("rows", ()):
            common = {"run": run.name, "quantity": "friction force", "estimate_N": run.budget["force_N"]}
            if row["source"] == TOTAL:
                yield common | {"source": "combined standard uncertainty"} | _contributions(row, 1)
                expanded = f"expanded uncertainty, k = {COVERAGE_FACTOR}"
                yield common | {"source": expanded} | _contributions(row, COVERAGE_FACTOR)
                continue
            yield (
                common
                | {
                    "source": row["source"],
                    "input_standard_uncertainty": row["size"],
                    "input_unit": row["unit"],
                    "input_ucum": unit_code(row["unit"]).ucum,
                    "share_of_variance_mean": row["share_mean"],
                    "share_of_variance_frame": row["share_frame"],
                    "common_to": row["common"],
                    "known_from": row["told"],
                }
                | _contributions(row, 1)
            )


def _contributions(row: Mapping[str, Any], factor: int) -> dict[str, Any]:
    """Return the effect on the mean friction force and on the force of one frame, N."""
    parts = {"contribution_mean_N": row["mean_N"], "contribution_frame_N": row["frame_N"]}
    return {name: None if size is None else factor * size for name, size in parts.items()}


def table_files(results: Results) -> dict[str, bytes]:
    """Return the tables by file name, as CSV in UTF-8.

    Parameters
    ----------
    results
        Results of a study.

    """
    tables = {PARAMETERS: (PARAMETER_COLUMNS, parameter_rows(results)), BUDGET: (BUDGET_COLUMNS, budget_rows(results))}
    return {name: _csv(columns, rows) for name, (columns, rows) in tables.items()}


def _csv(columns: tuple[str, ...], rows: Iterator[dict[str, Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()
