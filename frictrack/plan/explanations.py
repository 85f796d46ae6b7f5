"""List the explanations between which the next run should decide: effects near the best, and a formula in its place."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

from frictrack import effects
from frictrack.diagnose.experiments import Explanation, make_explanation
from frictrack.effects import Effect
from frictrack.errors import FrictrackError
from frictrack.fit.least_squares import Solution
from frictrack.fit.stepwise import add_effect, refine_to_end

MAX_BIC_NEAR = 60.0  # from the best, within which an explanation is compared
MAX_EXPLANATIONS = 4
FORMULA_NAME = "formula:1"  # as in `frictrack add STUDY formula:1`


def list_explanations(solution: Solution, diagnosis: Mapping[str, Any]) -> list[Explanation]:
    """List the explanations of what a diagnosis with effects found leaves open.

    Parameters
    ----------
    solution
        The fit that was diagnosed.
    diagnosis
        JSON of its diagnosis.

    Returns
    -------
    list of Explanation
        The largest gain first; empty if the effects found have no rival.

    """
    listed = {c["effect"]: c for c in diagnosis["candidates"]}
    missing = diagnosis["missing"]
    formula = _rival_formula(diagnosis) if len(missing) == 1 else None
    doubtful = next((n for n in missing if listed[n]["indistinguishable_from"]), missing[0] if formula else None)
    if doubtful is None:
        return []
    for name in missing:
        if name != doubtful:
            solution = refine_to_end(add_effect(solution, effects.get(name)))
    rivals = listed[doubtful]["indistinguishable_from"]
    best = listed[doubtful]["delta_bic"]
    near = [n for n, c in listed.items() if c["delta_bic"] is not None and best - c["delta_bic"] < MAX_BIC_NEAR]
    names = [doubtful, *rivals, *(n for n in near if n not in rivals and n != doubtful)]
    names = [n for n in names if n not in solution.problem.model]
    tried = ([FORMULA_NAME] if formula else []) + names[: 2 * MAX_EXPLANATIONS]
    own = [formula] if formula else []
    return sorted(_fitted(solution, tried, own), key=lambda e: -e.gain)[:MAX_EXPLANATIONS]


def _rival_formula(diagnosis: Mapping[str, Any]) -> Effect | None:
    """The formula that may be the cause in place of the effect found, as an effect; None if there is none."""
    unexplained = diagnosis["unexplained"] or {}
    if not unexplained.get("rival"):
        return None
    table = tomllib.loads(unexplained["formulas"][0]["toml"])["effect"][0]
    return replace(effects.definitions([effects.read_settings(table)])[0], name=FORMULA_NAME)


def _fitted(solution: Solution, tried: Sequence[str], formulas: Sequence[Effect]) -> Iterator[Explanation]:
    """Explanation by every effect that is known here, and under which a motion can be integrated."""
    for name in tried:
        with suppress(FrictrackError):
            effect = next((e for e in formulas if e.name == name), None) or effects.get(name)
            yield make_explanation(name, refine_to_end(add_effect(solution, effect)), solution)
