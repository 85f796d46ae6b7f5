"""Select the experiments that a diagnosis proposes, and build their table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from frictrack.number_format import format_number
from frictrack.report.markup import mark_code
from frictrack.report.tables.text_table import TextTable, make_table

DEFAULTS: dict[str, Any] = {"expected_delta_bic": None, "expected_if_true": {}, "key": "", "kind": "film"}


def separating_experiments(diagnosis: Mapping[str, Any] | None) -> list[Mapping[str, Any]]:
    """Select the proposed experiments that would distinguish effects, best first.

    Parameters
    ----------
    diagnosis : mapping or None
        A diagnosis; None before one was made.

    Returns
    -------
    list of mappings
        The experiments. Keys that an older file lacks have default values.

    """
    steps = [step for step in (diagnosis or {}).get("next_experiment") or [] if step["separates"]]
    return [DEFAULTS | {"tells": f"{', '.join(step['separates'])} apart"} | dict(step) for step in steps]


def with_expected_evidence(steps: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Select the experiments whose expected evidence is known, so that it can be drawn."""
    return [step for step in steps if step["expected_if_true"]]


def inseparable(diagnosis: Mapping[str, Any] | None) -> list[str]:
    """Describe the effects that no run can distinguish, and what else can.

    Parameters
    ----------
    diagnosis : mapping or None
        A diagnosis; None before one was made.

    """
    return [step["what"] for step in (diagnosis or {}).get("next_experiment") or [] if not step["separates"]]


def experiment_table(steps: Sequence[Mapping[str, Any]]) -> TextTable:
    """Table of the proposed experiments, best first.

    Parameters
    ----------
    steps : sequence of mappings
        Experiments from `separating_experiments`.

    """
    rows = [
        (f"{k}.", mark_code(step["what"]), step["tells"], format_number(step["expected_delta_bic"], 2))
        for k, step in enumerate(steps, 1)
    ]
    return make_table(("", "what to do", "distinguishes", "expected delta BIC, at least"), rows, (3,))
