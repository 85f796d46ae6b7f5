"""What would settle it: the experiments that a diagnosis proposes, as a table and a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from frictrack.number_format import format_number
from frictrack.report.markup import mark_code
from frictrack.report.tables import TextTable, table

DEFAULTS: dict[str, Any] = {"expected_delta_bic": None, "expected_if_true": {}, "key": "", "kind": "film"}


def separating_experiments(diagnosis: Mapping[str, Any] | None) -> list[Mapping[str, Any]]:
    """Experiments that would part something, best first; none before a diagnosis.

    One that was stored with less than is told today is filled up.
    """
    steps = [step for step in (diagnosis or {}).get("next_experiment") or [] if step["separates"]]
    return [DEFAULTS | {"tells": f"{', '.join(step['separates'])} apart"} | dict(step) for step in steps]


def drawable(steps: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Those whose evidence can be drawn."""
    return [step for step in steps if step["expected_if_true"]]


def inseparable(diagnosis: Mapping[str, Any] | None) -> list[str]:
    """What no run can part, and what else does, in words."""
    return [step["what"] for step in (diagnosis or {}).get("next_experiment") or [] if not step["separates"]]


def experiment_table(steps: Sequence[Mapping[str, Any]]) -> TextTable:
    """One row per experiment, best first."""
    rows = [
        (
            f"{k}.",
            mark_code(step["what"]),
            step["tells"],
            f"{format_number(step['expected_delta_bic'], 2)}",
        )
        for k, step in enumerate(steps, 1)
    ]
    return table(("", "what to do", "tells", "expected delta BIC, at least"), rows, (3,))
